"""A recorded operator as a source: it says again what it said, at the same stamps.

`run: graph.playback:operators.simulator.Simulator` is the playback of that class: a Source with the same outputs.
"""

from __future__ import annotations

import copy
import importlib
from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import msgspec

from graph.codec import decode
from graph.contract import End, Operator, Source, ports_of
from graph.errors import UserError
from graph.evolution import require_schema
from graph.graphfile import Graph, OperatorEntry
from graph.node import END
from graph.recording import Recording
from graph.shard import STEP, SUMMARY
from graph.suggest import suggestion


class Playback(Source):
    """Say again what an operator said in a recording; what it said at one stamp is one call."""

    class Config(msgspec.Struct):
        recording: Path
        operator: str  # its name in the recording

    def stream(self) -> Iterator[tuple[int, Any]]:
        recording = Recording(self.config.recording)
        name, types = self.config.operator, ports_of(type(self)).outputs
        for port, kind in types.items():
            if f"{name}/{port}" in recording.types:
                require_schema(recording, f"{name}/{port}", kind)
        own = (entry for entry in recording.entries() if entry.operator == name and entry.port != SUMMARY)
        for stamp, entries in groupby(own, key=lambda entry: entry.stamp):
            said: list[Any] = []
            for entry in entries:
                if entry.port == STEP:
                    step = entry.step()
                    if step.ended is not None:
                        said.append(End(step.ended))
                    elif step.port == END and not any(isinstance(item, End) for item in said):
                        said.append(End("the recording ends"))
                else:
                    message = decode(entry.payload, types[entry.port])
                    said.append(self.Outputs(**{entry.port: message}))
            if said:
                yield stamp, said


_classes: dict[type[Operator], type[Playback]] = {}


def playback_of(kind: type[Operator]) -> type[Playback]:
    """Return the class that plays back an operator class; the same one each time."""
    if kind not in _classes:
        _classes[kind] = type(
            f"PlaybackOf{kind.__name__}", (Playback,), {"Outputs": kind.Outputs, "__module__": __name__}
        )
    return _classes[kind]


class _Place:
    """A step on the way from `graph.playback` to a class in another module: what `operators.simulator` names here."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, part: str) -> Any:
        return _find(self._name, part)


def _find(parent: str, part: str) -> Any:
    if parent:
        try:
            found = getattr(importlib.import_module(parent), part, None)
        except ImportError as error:
            raise AttributeError(part) from error
        if isinstance(found, type) and issubclass(found, Operator):
            return playback_of(found)
    return _Place(f"{parent}.{part}".lstrip("."))


def __getattr__(part: str) -> Any:
    if part.startswith("__"):
        raise AttributeError(part)
    return _find("", part)


def stand_in(graph: Graph, source: Path, names: Sequence[str]) -> Graph:
    """Return the graph with some operators replaced by what they said in a recording.

    Raises UserError if the recording is none, has no such operator, or holds its messages as digests only.
    """
    recording = Recording(source)
    recorded = {spec.name: spec for spec in recording.run.specs}
    graph = copy.deepcopy(graph)
    for name in names:
        for where, known in ((graph.name, list(graph.operators)), (str(source), list(recorded))):
            if name not in known:
                raise UserError(f"there is no operator '{name}' in {where}{suggestion(name, known)}")
        if "digest" in recorded[name].record.values():
            raise UserError(f"{source} holds messages of {name} as digests only: they cannot be played back")
        entry = graph.operators[name]
        graph.operators[name] = OperatorEntry(
            run=f"graph.playback:{entry.run.replace(':', '.')}",
            config={"recording": str(source.resolve()), "operator": name},
            threads=entry.threads,
            record=entry.record,
        )
    return graph
