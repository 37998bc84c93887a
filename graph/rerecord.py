"""A recording made of another one: replayed operators say what they say now, all others what they said then."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec

from graph.ledger import Step
from graph.merge import merge
from graph.node import Emission
from graph.recording import Recording, Run, Verdict
from graph.run import Paths
from graph.shard import STEP, SUMMARY, Schemas, Shard, schemas_of
from graph.wiring import NodeSpec


class Rerecorder:
    """Collects the calls of a replay in shards and merges them with what was not replayed.

    out: the new recording, which must not exist. specs: of the graph as replayed. replayed: operators that run again.
    """

    def __init__(self, recording: Recording, out: Path, run: Run, replayed: Iterable[str]) -> None:
        self.recording, self.run = recording, run
        self.paths = Paths.choose(out.stem, out)
        self.replayed = set(replayed)
        self.specs = {spec.name: spec for spec in run.specs}
        self.shards: dict[tuple[str, int], Shard] = {}
        self.types: dict[str, dict[str, type[msgspec.Struct]]] = {}

    def __enter__(self) -> Self:
        self.paths.shards.mkdir(parents=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for shard in self.shards.values():
            shard.close()
        self.shards.clear()
        shutil.rmtree(self.paths.shards, ignore_errors=True)

    def _shard(self, name: str, incarnation: int) -> Shard:
        if (name, incarnation) not in self.shards:
            spec = self.specs[name]
            if name in self.replayed:
                from graph.contract import ports_of
                from graph.loading import load_class

                schemas: Schemas = schemas_of(ports_of(load_class(spec.run, spec.root)).outputs)
            else:
                schemas = {
                    port: self.recording.types[f"{name}/{port}"]
                    for port in spec.outputs
                    if f"{name}/{port}" in self.recording.types
                }
            path = self.paths.shards / f"{name}.{incarnation}.mcap"
            self.shards[name, incarnation] = Shard(path, spec, schemas, incarnation)
        return self.shards[name, incarnation]

    def keep(self, operator: str, incarnation: int, emissions: list[Emission], step: Step, summary: Any) -> None:
        """Take one call of a replayed operator."""
        self._shard(operator, incarnation).write(emissions, step, summary)

    def finish(self) -> Verdict:
        """Copy what was not replayed, and merge."""
        waiting: dict[tuple[str, int], tuple[list[Emission], dict[str, Any] | None]] = {}
        for entry in self.recording.entries():
            if entry.operator in self.replayed or self.specs[entry.operator].kind == "sink":
                continue
            key = (entry.operator, entry.incarnation)
            emissions, summary = waiting.get(key, ([], None))
            if entry.port == STEP:
                self._shard(*key).write(emissions, entry.step(), summary)
                emissions, summary = [], None
            elif entry.port == SUMMARY:
                summary = msgspec.msgpack.decode(entry.payload)
            else:
                emissions = [*emissions, Emission(entry.port, entry.sequence, entry.stamp, entry.payload)]
            waiting[key] = (emissions, summary)
        paths = []
        for (name, incarnation), shard in self.shards.items():
            shard.close()
            paths.append(self.paths.shards / f"{name}.{incarnation}.mcap")
        self.shards.clear()
        reasons = [f"{', '.join(sorted(self.replayed))} replayed on {self.recording.path.name}: not one run"]
        return merge(
            paths, self.paths.recording, self.run, reasons=reasons, wall_seconds=self.recording.verdict.wall_seconds
        )


def run_for(recording: Recording, graph: dict[str, Any], specs: Iterable[NodeSpec]) -> Run:
    """Describe the run of a replay: the recorded one, with the graph as changed."""
    return msgspec.structs.replace(recording.run, graph=graph, specs=tuple(specs))
