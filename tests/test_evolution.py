"""Messages of another time: read if only fields with defaults came or went, else refused by the name of the field."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import msgspec
import pytest

from graph.arrays import Array, array, unit
from graph.check import require
from graph.codec import schema
from graph.diff import compare
from graph.errors import UserError
from graph.evolution import mismatch
from graph.inprocess import launch_in_process
from graph.playback import stand_in
from graph.recording import Recording
from graph.replay import replay


class Then(msgspec.Struct):
    """As it was."""

    value: int
    points: Annotated[Array, array("float32", "n", 3, unit="m")]
    speed: Annotated[float, unit("m/s")] = 0.0
    note: str | None = None


def now(**fields: object) -> str:
    """Return today's schema: that of Then with some fields changed, added or, by None, taken away."""
    kept: dict[str, tuple[object, ...]] = {
        "value": (int,),
        "points": (Annotated[Array, array("float32", "n", 3, unit="m")],),
        "speed": (Annotated[float, unit("m/s")], 0.0),
        "note": (str | None, None),
    }
    changed = {name: item for name, item in (kept | fields).items() if item is not None}
    return schema(msgspec.defstruct("Then", [(name, *item) for name, item in changed.items()], kw_only=True))  # type: ignore[misc]


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"more": (int, 3)},
        {"more": (list[int], msgspec.field(default_factory=list)), "less": (str | None, None)},
        {"note": None},
        {"speed": None, "note": None},
        {"value": (Annotated[int, msgspec.Meta(description="in words")],)},
    ],
    ids=range(6),
)
def test_fields_with_defaults_may_come_and_go(changes: dict[str, object]) -> None:
    assert mismatch(schema(Then), now(**changes)) is None


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"more": (int,)}, "Then.more is not in the recording, and has no default"),
        ({"value": None}, "Then.value is in the recording and not in this version"),
        ({"value": (float,)}, "Then.value was integer and is number now"),
        ({"speed": (Annotated[float, unit("km/h")], 0.0)}, "Then.speed was number m/s and is number km/h now"),
        (
            {"points": (Annotated[Array, array("float64", "n", 3, unit="m")],)},
            "Then.points was float32 ('n', 3) m and is float64 ('n', 3) m now",
        ),
        (
            {"points": (Annotated[Array, array("float32", "n", 4, unit="m")],)},
            "Then.points was float32 ('n', 3) m and is float32 ('n', 4) m now",
        ),
        ({"note": (int | None, None)}, "Then.note was string or null and is integer or null now"),
    ],
    ids=range(7),
)
def test_any_other_change_is_named(changes: dict[str, object], reason: str) -> None:
    assert mismatch(schema(Then), now(**changes)) == reason


MODULE = """
from __future__ import annotations
import msgspec
from graph import Operator
from graph.messages import Message, Tick


class Note(Message, frozen=True, kw_only=True, eq=False):
    value: int
    FIELD


class Outputs(msgspec.Struct):
    note: Note | None = None


class Maker(Operator):
    Outputs = Outputs

    def on_tick(self, tick: Tick) -> Outputs:
        return Outputs(Note(measured_at=tick.measured_at, value=tick.index))


class Reader(Operator):
    Outputs = Outputs

    def on_note(self, note: Note) -> Outputs:
        return Outputs(Note(measured_at=note.measured_at, value=note.value + 1))
"""

GRAPH = """
clock: {duration: 1s}
operators:
  maker: {run: evolving:Maker, inputs: {tick: timer/10hz}}
  reader: {run: evolving:Reader, inputs: {note: maker/note}}
"""


@pytest.fixture
def version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Path]:
    """Write the module of the operators with a field more, and forget the one that was imported."""
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(sys, "path", list(sys.path))
    path = tmp_path / "graph.yaml"
    path.write_text(GRAPH)

    def write(field: str) -> Path:
        (tmp_path / "evolving.py").write_text(MODULE.replace("FIELD", field))
        sys.modules.pop("evolving", None)
        return path

    return write


def recorded(version: Callable[[str], Path], field: str, name: str = "run.mcap") -> Recording:
    graph = require(version(field))
    return Recording(launch_in_process(graph, record=Path(graph.root) / name)[1])


def test_a_field_with_a_default_more_or_less_is_read_and_replays(version: Callable[[str], Path]) -> None:
    recording = recorded(version, "")
    version("extra: float = 0.5")
    assert replay(recording).equal
    later = recorded(version, "extra: float = 0.5", "later.mcap")
    version("")
    assert replay(later).equal
    assert not compare(recording, later).equal


def test_a_field_that_is_needed_and_not_there_is_named(version: Callable[[str], Path]) -> None:
    recording = recorded(version, "")
    version("extra: float")
    words = (
        r"run\.mcap: maker/note is of another version of Note: Note\.extra is not in the recording, and has no default"
    )
    with pytest.raises(UserError, match=words):
        replay(recording, operators=["reader"])


def test_what_is_played_back_must_be_readable_too(version: Callable[[str], Path], tmp_path: Path) -> None:
    recording = recorded(version, "extra: float = 0.5")
    graph = require(version("extra: int = 5"))
    played = stand_in(graph, recording.path, ["maker"])
    with pytest.raises(UserError, match=r"Note\.extra was number and is integer now"):
        launch_in_process(require(played), record=tmp_path / "played.mcap")


def test_another_ledger_is_refused(version: Callable[[str], Path]) -> None:
    recording = recorded(version, "")
    recording.types["maker/step"] = ("retracer.Step", "{}")  # as if of another time
    with pytest.raises(UserError, match="its ledger is of another version of retracer"):
        replay(recording)
