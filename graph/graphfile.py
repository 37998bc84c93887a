"""The graph file: which operators run, what feeds them, and what ends the run.

clock: {mode: lockstep, end: simulator}
operators:
  simulator:
    run: operators.simulator:Simulator
    inputs: {tick: timer/10hz, drive: {from: planner/drive, delay: 100ms}}
    config: {seed: 1}
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from graph.durations import DURATION, PERIOD, SPAN, duration_text, nanoseconds, timer_period
from graph.errors import UserError
from graph.suggest import Fault, KeyPath, faults, given, suggestion, wants
from graph.yamlfile import Place, Tree, YamlError, dump, read_text

TIMER = "timer"
TAKEN = (TIMER, "clock")  # words that no operator can be named: both mean something in a graph or in --set

DEFAULT_QUEUE = 10  # messages that wait in realtime

_NAME = r"[A-Za-z_][A-Za-z0-9_]*"

Level = Literal["full", "digest"]
Record = Level | dict[str, Level]
Restart = Literal["never", "on-failure"]
Queue = Annotated[int, msgspec.Meta(ge=1)] | Literal["latest"]
Mode = Literal["lockstep", "realtime"]
Pace = Literal["max", "realtime"]


class Edge(msgspec.Struct, frozen=True):
    """What feeds one input: the producer's port, or a timer (`operator="timer", port="10hz"`)."""

    operator: str
    port: str
    delay: int = 0  # ns
    queue: int | Literal["latest"] = DEFAULT_QUEUE

    @property
    def source(self) -> str:
        """Return `operator/port`, as in the graph file."""
        return f"{self.operator}/{self.port}"

    @property
    def period(self) -> int | None:
        """Return the period of a timer in ns; None for an operator's port."""
        return timer_period(self.port) if self.operator == TIMER else None


class OperatorEntry(msgspec.Struct):
    """One operator of a graph, one process of a run."""

    run: str  # module:Class
    inputs: dict[str, Edge] = {}
    config: dict[str, Any] = {}
    threads: int = 1
    restart: Restart = "never"
    record: Record = "full"


class Clock(msgspec.Struct):
    """How time passes in a run, and what ends it. Times in ns."""

    mode: Mode = "lockstep"
    pace: Pace = "max"
    duration: int | None = None
    end: str | None = None
    ahead: int = 1_000_000_000


class Graph(msgspec.Struct):
    """A graph with nothing left to look up; the operators are in the order of the file."""

    clock: Clock
    operators: dict[str, OperatorEntry]
    name: str  # stem of the file
    root: str  # absolute folder of the file; relative paths of configs start there


# What may be written in the file. The structs above are what it means.

Duration = Annotated[
    Annotated[str, msgspec.Meta(pattern=f"^({DURATION})$")] | Annotated[float, msgspec.Meta(ge=0, le=1e9)],
    wants("a duration such as 100ms, 1.5s or 2min, or a number of seconds"),
]
Span = Annotated[
    Annotated[str, msgspec.Meta(pattern=f"^{SPAN}$")] | Annotated[float, msgspec.Meta(ge=1e-9, le=1e9)],
    wants("a duration above zero such as 100ms, 1.5s or 2min, or a number of seconds"),
]
From = Annotated[
    str,
    wants(
        "operator/port (such as simulator/frame) or a timer (such as timer/10hz, timer/0.5hz or timer/100ms)",
        pattern=f"^(timer/{PERIOD}|(?!timer/){_NAME}/{_NAME})$",
    ),
]
OperatorName = Annotated[
    str,
    wants(
        f"names of letters, digits and _ that begin with no digit and are neither {' nor '.join(TAKEN)}",
        pattern=f"^(?!({'|'.join(TAKEN)})$){_NAME}$",
    ),
]
Keys = Annotated[dict[str, Any], wants("a mapping of key to value")]


class EdgeFile(msgspec.Struct, forbid_unknown_fields=True, rename={"source": "from"}):
    """An input with more to say than where it comes from."""

    source: From
    delay: Annotated[Duration, msgspec.Meta(description="what the edge adds to a stamp; every cycle wants one")] = 0.0
    queue: Annotated[Queue, wants("a whole number of at least 1, or 'latest'")] = DEFAULT_QUEUE


class OperatorFile(msgspec.Struct, forbid_unknown_fields=True):
    """One operator, one process."""

    run: Annotated[
        str,
        wants(
            "module:Class (such as operators.planner:Planner)", pattern=rf"^{_NAME}(\.{_NAME})*:{_NAME}(\.{_NAME})*$"
        ),
    ]
    inputs: Annotated[dict[str, From | EdgeFile], wants("a mapping of port to operator/port")] = {}
    config: Keys = {}
    threads: Annotated[int, wants("a whole number of at least 1", ge=1)] = 1
    restart: Annotated[Restart, msgspec.Meta(description="in realtime: bring it back after a failure")] = "never"
    record: Annotated[Record, wants("full, digest, or a mapping of port to one of the two")] = "full"


class ClockFile(msgspec.Struct, forbid_unknown_fields=True):
    """How time passes in a run, and what ends it."""

    mode: Annotated[Mode, msgspec.Meta(description="lockstep: the same bits every time; realtime: a real robot")] = (
        "lockstep"
    )
    pace: Annotated[Pace, msgspec.Meta(description="of lockstep: as fast as it can, or at real time")] = "max"
    duration: Annotated[Span, msgspec.Meta(description="the run ends at this stamp")] | None = None
    end: Annotated[str, wants("the name of an operator that returns End")] | None = None
    ahead: Annotated[Span, msgspec.Meta(description="how far a producer may run ahead of its consumers")] = "1s"


class GraphFile(msgspec.Struct, forbid_unknown_fields=True):
    """A graph of operators."""

    operators: Annotated[
        dict[OperatorName, OperatorFile], wants("a mapping of name to operator, with at least one", min_length=1)
    ]
    clock: ClockFile = msgspec.field(default_factory=ClockFile)


class Mistake(msgspec.Struct, frozen=True):
    """One mistake in a graph: where it stands (from 1; 0 if in no line) and what it is."""

    line: int
    column: int
    text: str
    source: str = ""  # the file, or the option of the command line at fault

    def __str__(self) -> str:
        where = f"{self.source}:{self.line}" if self.line else self.source
        return f"{where}: {self.text}" if where else self.text


class GraphError(UserError):
    """A graph with mistakes: all of them, one a line."""

    def __init__(self, mistakes: Sequence[Mistake]) -> None:
        self.mistakes = sorted(mistakes, key=lambda mistake: (mistake.line == 0, mistake.line, mistake.column))
        super().__init__("\n".join(str(mistake) for mistake in self.mistakes))


class Draft:
    """A graph file as read, mistakes included; what is not faulty is in `graph`, for further checks."""

    def __init__(self, path: str | Path, sets: Sequence[str] = (), swaps: Sequence[str] = ()) -> None:
        self.file = Path(path)
        self.mistakes: list[Mistake] = []
        self.graph: Graph | None = None
        self.data: dict[str, Any] = {}  # the file with overrides, as written
        self._options: dict[KeyPath, str] = {}  # what an option of the command line has set
        self._tree: Tree | None = None
        try:
            self._tree = Tree(read_text(self.file))
        except YamlError as error:
            self.mistakes.append(Mistake(error.place.line, error.place.column, str(error), str(self.file)))
            return
        for place, text in self._tree.flaws:
            self.mistakes.append(Mistake(place.line, place.column, text, str(self.file)))
        if self._tree.empty:
            self.add((), "the file is empty; a graph has operators and a clock")
        elif not isinstance(self._tree.data, dict):
            self.add((), f"a graph is a mapping with operators and a clock; this is {given(self._tree.data)}")
        else:
            self.data = self._tree.data
            self._override(sets, swaps)
            found = list(faults(self.data, GraphFile, shown=shown))
            for fault in found:
                self.add(fault.path, fault.text, key=fault.key)
            self.graph = _resolve(_pruned(self.data, {fault.path for fault in found}), self.file)

    @classmethod
    def of(cls, graph: Graph) -> Draft:
        """Return the draft of a graph that was never a file; its mistakes stand in no line."""
        draft = cls.__new__(cls)
        draft.file, draft.mistakes, draft.graph, draft.data = Path(graph.name), [], graph, to_dict(graph)
        draft._options, draft._tree = {}, None
        return draft

    def mistake(self, path: KeyPath, text: str, *, key: bool = False) -> Mistake:
        """Return a mistake at a path of the file, or at the option that has set it."""
        for end in range(len(path), 0, -1):
            if (option := self._options.get(path[:end])) is not None:
                return Mistake(0, 0, text, option)
        place = self._tree.place(path, key=key) if self._tree else Place(0, 0)
        return Mistake(place.line, place.column, text, str(self.file))

    def swapped(self, name: str) -> KeyPath | None:
        """Return the path of an operator's class if `--swap` has set it."""
        path = ("operators", name, "run")
        return path if self.told(path) else None

    def told(self, path: KeyPath) -> bool:
        """Say whether an option of the command line has set what stands at a path."""
        return path in self._options

    def add(self, path: KeyPath, text: str, *, key: bool = False) -> None:
        """Note a mistake at a path, unless the file says there what cannot even be read."""
        if self._tree is not None and path in self._tree.flawed:
            return
        self.mistakes.append(self.mistake(path, text, key=key))

    def _override(self, sets: Sequence[str], swaps: Sequence[str]) -> None:
        operators = self.data.get("operators")
        known = (
            [name for name, entry in operators.items() if isinstance(entry, dict)]
            if isinstance(operators, dict)
            else []
        )
        for option, texts, form in (("--set", sets, "operator.key=value"), ("--swap", swaps, "operator=module:Class")):
            for text in texts:
                source = f"{option} {text}"
                left, equals, right = text.partition("=")
                owner, *keys = left.strip().split(".")
                if not equals or not all((owner, *keys)) or (not keys if option == "--set" else bool(keys)):
                    self.mistakes.append(Mistake(0, 0, f"{option} wants {form}", source))
                    continue
                if owner not in known and not (owner == "clock" and option == "--set"):
                    names = [*known, "clock"] if option == "--set" else known
                    self.mistakes.append(
                        Mistake(0, 0, f"there is no operator '{owner}'{suggestion(owner, names)}", source)
                    )
                    continue
                path: KeyPath = ("operators", owner) if owner != "clock" else ()
                path += ("run",) if option == "--swap" else ("config" if path else "clock", *keys)
                try:
                    tree = Tree(right) if option == "--set" else None
                except YamlError as error:
                    self.mistakes.append(Mistake(0, 0, str(error), source))
                    continue
                self.mistakes += [Mistake(0, 0, flaw, source) for _, flaw in (tree.flaws if tree else [])]
                if (blocked := _put(self.data, path, tree.data if tree else right.strip())) is not None:
                    self.mistakes.append(Mistake(0, 0, f"{shown(blocked)} is no mapping", source))
                self._options[path] = source


def shown(path: KeyPath) -> str:
    """Name a path in a graph file as people do: `planner.max_speed`, `clock.end`."""
    if path[:1] != ("operators",) or len(path) == 1:
        return ".".join(path) or "a graph"
    return ".".join((path[1], *(path[3:] if path[2:3] in (("config",), ("inputs",)) and len(path) > 3 else path[2:])))


def _put(data: dict[str, Any], path: KeyPath, value: Any) -> KeyPath | None:
    """Put a value into nested mappings; return what stands in the way if it is no mapping."""
    for depth, key in enumerate(path[:-1], 1):
        data = data.setdefault(key, {})
        if not isinstance(data, dict):
            return path[:depth]
    data[path[-1]] = value
    return None


def _pruned(value: Any, bad: set[KeyPath], path: KeyPath = ()) -> Any:
    if isinstance(value, dict):
        return {key: _pruned(item, bad, (*path, key)) for key, item in value.items() if (*path, key) not in bad}
    if isinstance(value, list):
        return [_pruned(item, bad, (*path, str(index))) for index, item in enumerate(value)]
    return value


def _resolve(data: dict[str, Any], file: Path) -> Graph:
    """Turn what is written into what it means; missing keys that are mistakes become empty."""
    clock = dict(data.get("clock", {}))
    for key in ("duration", "ahead"):
        if clock.get(key) is not None:
            clock[key] = nanoseconds(clock[key])
    operators = {name: dict(entry) for name, entry in data.get("operators", {}).items()}
    for entry in operators.values():
        entry["run"] = entry.get("run", "")
        edges = ((port, _edge(written)) for port, written in entry.get("inputs", {}).items())
        entry["inputs"] = {port: edge for port, edge in edges if edge is not None}
    resolved = {"clock": clock, "operators": operators, "name": file.stem, "root": str(file.parent.resolve())}
    return msgspec.convert(resolved, Graph)


def _edge(written: str | dict[str, Any]) -> dict[str, Any] | None:
    edge = {"from": written} if isinstance(written, str) else dict(written)
    if "from" not in edge:
        return None
    operator, port = edge.pop("from").split("/")
    return edge | {"operator": operator, "port": port, "delay": nanoseconds(edge.get("delay", 0))}


def read_graph(path: str | Path, *, sets: Sequence[str] = (), swaps: Sequence[str] = ()) -> Graph:
    """Read a graph file; classes are not loaded (see `graph.check`). Raises GraphError with all mistakes.

    sets: `operator.key=value` overrides a config, `clock.key=value` the clock. swaps: `operator=module:Class`.
    """
    draft = Draft(path, sets, swaps)
    if draft.mistakes or draft.graph is None:
        raise GraphError(draft.mistakes)
    return draft.graph


def to_dict(graph: Graph) -> dict[str, Any]:
    """Return a graph as builtins that JSON can hold, for recordings."""
    return msgspec.to_builtins(graph)


def from_dict(data: dict[str, Any]) -> Graph:
    """Return the graph of `to_dict`. Raises UserError that names unknown, missing and wrong fields."""

    def known(part: Any, kind: Any, path: KeyPath) -> Iterable[Fault]:
        return faults(part, kind, path, shown=lambda inner: "the graph's " + ".".join(inner) if inner else "a graph")

    if found := list(known(data, Graph, ())):
        raise UserError("; ".join(fault.text for fault in found))
    graph = msgspec.convert(data, Graph)
    try:
        for entry in graph.operators.values():
            _ = [edge.period for edge in entry.inputs.values()]
    except ValueError as error:
        raise UserError(f"the graph's timers: {error}") from error
    return graph


def to_yaml(graph: Graph) -> str:
    """Write a graph as a graph file; reading that gives an equal graph, but for name and root: the file's."""
    clock = _changed(graph.clock, ClockFile())
    for key in clock.keys() & {"duration", "ahead"}:
        clock[key] = duration_text(clock[key])
    if graph.clock.ahead == Clock().ahead:
        clock.pop("ahead")
    operators = {}
    for name, entry in graph.operators.items():
        operators[name] = _changed(entry, OperatorFile(run=""))
        if entry.inputs:
            operators[name]["inputs"] = {port: _written(edge) for port, edge in entry.inputs.items()}
    return dump(({"clock": clock} if clock else {}) | {"operators": operators})


def _changed(part: msgspec.Struct, default: msgspec.Struct) -> dict[str, Any]:
    return {key: value for key, value in msgspec.to_builtins(part).items() if value != getattr(default, key)}


def _written(edge: Edge) -> str | dict[str, Any]:
    more: dict[str, Any] = {"delay": duration_text(edge.delay)} if edge.delay else {}
    more |= {"queue": edge.queue} if edge.queue != DEFAULT_QUEUE else {}
    return {"from": edge.source} | more if more else edge.source


def json_schema() -> dict[str, Any]:
    """Return the JSON Schema of graph files, for editors."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | msgspec.json.schema(GraphFile)
