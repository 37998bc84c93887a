"""Check a graph before anything starts: every mistake at once, each with the line it stands on."""

from __future__ import annotations

import heapq
import itertools
import types
import typing
from collections.abc import Sequence
from pathlib import Path

import msgspec

from graph.codec import schema, type_name
from graph.contract import Operator, Ports, Sink, Source, method_hints, ports_of
from graph.durations import duration_text
from graph.errors import UserError
from graph.graphfile import TIMER, Draft, Edge, Graph, GraphError, Mistake, Record
from graph.loading import ConfigError, build_config, load_class
from graph.messages import Tick
from graph.suggest import suggestion

Feed = tuple[str, str, Edge]  # an operator, one of its ports, and what feeds it


class Report(msgspec.Struct):
    """What is wrong with a graph: mistakes keep it from running, warnings do not."""

    mistakes: list[Mistake]
    warnings: list[Mistake]
    graph: Graph | None  # None if mistakes keep it from being one


def check(graph_or_path: Graph | str | Path, sets: Sequence[str] = (), swaps: Sequence[str] = ()) -> Report:
    """Find all mistakes of a graph or a graph file, in the order of its lines; loads every operator's class."""
    draft = Draft.of(graph_or_path) if isinstance(graph_or_path, Graph) else Draft(graph_or_path, sets, swaps)
    readable = not draft.mistakes
    review = _Review(draft)
    if draft.graph is not None:
        review.look(draft.graph)
    order = sorted(draft.mistakes, key=lambda mistake: (mistake.line == 0, mistake.line, mistake.column))
    return Report(order, review.warnings, draft.graph if readable else None)


def require(graph_or_path: Graph | str | Path, sets: Sequence[str] = (), swaps: Sequence[str] = ()) -> Graph:
    """Return a graph without mistakes. Raises GraphError with all of them."""
    report = check(graph_or_path, sets, swaps)
    if report.mistakes or report.graph is None:
        raise GraphError(report.mistakes)
    return report.graph


def optional_inputs(kind: type[Operator]) -> frozenset[str]:
    """Name the ports that need not be wired: those whose parameter is annotated `Message | None`."""
    found = set()
    for port in ports_of(kind).inputs:
        hints = method_hints(kind, f"on_{port}")
        hints.pop("return", None)
        if any(types.NoneType in typing.get_args(hint) for hint in hints.values()):
            found.add(port)
    return frozenset(found)


def same_type(given: type[msgspec.Struct], wanted: type[msgspec.Struct]) -> bool:
    """Say whether messages of one type can be read as the other: one class, or one name and schema."""
    return given is wanted or (type_name(given) == type_name(wanted) and schema(given) == schema(wanted))


def _digests(record: Record) -> bool:
    return "digest" in (record.values() if isinstance(record, dict) else [record])


class _Review:
    """The checks that need the operators' classes and the whole graph."""

    def __init__(self, draft: Draft) -> None:
        self.draft = draft
        self.warnings: list[Mistake] = []
        self.kinds: dict[str, type[Operator]] = {}
        written = draft.data.get("operators")
        self.names: list[str] = list(written) if isinstance(written, dict) else []

    def look(self, graph: Graph) -> None:
        for name, entry in graph.operators.items():
            if entry.run:
                try:
                    self.kinds[name] = load_class(entry.run, graph.root)
                except UserError as error:
                    self.draft.add(("operators", name, "run"), f"{name}: {error}")
        for name, kind in self.kinds.items():
            if self.draft.swapped(name):
                self._let_go(graph, name, kind)
            self._look_at_config(graph, name, kind)
            self._look_at_ports(graph, name, kind)
        feeds = [(name, port, edge) for name, entry in graph.operators.items() for port, edge in entry.inputs.items()]
        for name, port, edge in feeds:
            self._look_at_edge(name, port, edge)
        feeds = [feed for feed in feeds if feed[2].operator in graph.operators]
        self._look_at_end(graph, feeds)
        self._look_at_cycles(graph, feeds)

    def _ports(self, name: str) -> Ports | None:
        return ports_of(self.kinds[name]) if name in self.kinds else None

    def _called(self, name: str) -> str:
        return f"{name} ({self.kinds[name].__qualname__})"

    def _let_go(self, graph: Graph, name: str, kind: type[Operator]) -> None:
        """Take from a swapped operator what the file told the class before it and this one does not know."""
        entry = graph.operators[name]
        fields = {field.encode_name for field in msgspec.structs.fields(kind.Config)}
        for section, known in (("config", fields), ("record", ports_of(kind).outputs.keys())):
            written = getattr(entry, section)
            for key in list(written) if isinstance(written, dict) else ():
                path = ("operators", name, section, key)
                if key not in known and not self.draft.told(path):
                    del written[key]
                    text = f"{section} {name}.{key} was the former class's; {self._called(name)} goes without"
                    self.warnings.append(self.draft.mistake(path, text, key=True))

    def _look_at_config(self, graph: Graph, name: str, kind: type[Operator]) -> None:
        entry = graph.operators[name]
        try:
            if isinstance(self.draft.data["operators"][name].get("config", {}), dict):
                config = build_config(kind, entry.config, graph.root, operator=name)
                if text := kind.missing(config, frozenset(entry.inputs)):
                    self.warnings.append(self.draft.mistake(("operators", name, "inputs"), f"{name}: {text}"))
        except ConfigError as error:
            for fault in error.faults:
                self.draft.add(("operators", name, "config", *fault.path), fault.text, key=fault.key)
        outputs = ports_of(kind).outputs
        for port in entry.record if isinstance(entry.record, dict) else ():
            if port not in outputs:
                text = f"{self._called(name)} has no output '{port}'{suggestion(port, outputs)}"
                self.draft.add(("operators", name, "record", port), text, key=True)
        if entry.restart == "on-failure" and graph.clock.mode == "lockstep":
            text = f"{name}: restart: on-failure acts in realtime only; in lockstep a failure ends the run"
            self.warnings.append(self.draft.mistake(("operators", name, "restart"), text))
        elif entry.restart == "on-failure" and _digests(entry.record):
            text = f"{name}: record: digest with restart: on-failure: what a failing call had said cannot be replayed"
            self.warnings.append(self.draft.mistake(("operators", name, "record"), text))

    def _look_at_ports(self, graph: Graph, name: str, kind: type[Operator]) -> None:
        ports, here = ports_of(kind), ("operators", name, "inputs")
        swap = self.draft.swapped(name)
        written = self.draft.data["operators"][name].get("inputs", {})
        wired = list(written) if isinstance(written, dict) else []
        if issubclass(kind, Source):
            if wired:
                self.draft.add(swap or here, f"{self._called(name)} is a Source, which takes no inputs", key=True)
            return
        if not ports.inputs:
            text = f"{self._called(name)} has no on_<port> method, so it would never run; only a Source needs none"
            self.draft.add(("operators", name, "run"), text)
            return
        for port in wired:
            if port not in ports.inputs:
                text = f"{self._called(name)} has no input '{port}'{suggestion(port, ports.inputs)}"
                self.draft.add(swap or (*here, port), text, key=True)
        if not isinstance(written, dict):
            return
        optional = optional_inputs(kind)
        missing = [port for port in ports.inputs if port not in wired and port not in optional]
        for port in missing:
            wanted = ports.inputs[port]
            text = f"{name}.{port} is not wired; it wants {wanted.__name__}{self._offers(wanted, name)}"
            self.draft.add(swap or here, text, key=True)
        if not wired and not missing:
            text = f"{name} has no inputs, so it would never run{suggestion('', ports.inputs)}"
            self.draft.add(here, text, key=True)

    def _offers(self, wanted: type[msgspec.Struct], consumer: str) -> str:
        """Say which outputs of the other operators have a type."""
        offers = [
            f"{name}/{port}"
            for name, kind in self.kinds.items()
            for port, given in ports_of(kind).outputs.items()
            if name != consumer and same_type(given, wanted)
        ]
        if same_type(Tick, wanted):
            offers.append("a timer (such as timer/10hz)")
        return f", as given by {', '.join(offers)}" if offers else ", which no other operator of this graph gives"

    def _look_at_edge(self, name: str, port: str, edge: Edge) -> None:
        own, given = self._ports(name), self._given(name, port, edge)
        wanted = own.inputs.get(port) if own else None
        if given is not None and wanted is not None and not same_type(given, wanted):
            alike = given.__name__ == wanted.__name__
            left, right = (type_name(wanted), type_name(given)) if alike else (wanted.__name__, given.__name__)
            swap = self.draft.swapped(edge.operator) or self.draft.swapped(name)
            path = swap or ("operators", name, "inputs", port)
            self.draft.add(path, f"{name}.{port} wants {left}; {edge.source} gives {right}")

    def _given(self, name: str, port: str, edge: Edge) -> type[msgspec.Struct] | None:
        """Return the type of the messages on an edge, or None and note why there is none."""
        here = ("operators", name, "inputs", port)
        if edge.operator == TIMER:
            return Tick
        if edge.operator not in self.names:
            text = f"{name}.{port} listens to '{edge.source}'; there is no operator '{edge.operator}'"
            self.draft.add(here, text + suggestion(edge.operator, self.names))
            return None
        ports = self._ports(edge.operator)
        if ports is None:
            return None
        called, swap = self._called(edge.operator), self.draft.swapped(edge.operator)
        if issubclass(self.kinds[edge.operator], Sink):
            self.draft.add(swap or here, f"{name}.{port} listens to {called}, a Sink, which has no outputs")
        elif edge.port not in ports.outputs:
            text = f"{name}.{port} listens to '{edge.source}'; {called} has no output '{edge.port}'"
            self.draft.add(swap or here, text + suggestion(edge.port, ports.outputs))
        else:
            return ports.outputs[edge.port]
        return None

    def _look_at_end(self, graph: Graph, feeds: list[Feed]) -> None:
        clock, here = graph.clock, ("clock", "end")
        lockstep = clock.mode == "lockstep"
        written = self.draft.data.get("clock", {})
        if lockstep and isinstance(written, dict) and written.get("duration") is None and written.get("end") is None:
            text = (
                "a lockstep graph wants an end: clock.duration (such as 60s) or clock.end (an operator that says End)"
            )
            self.draft.add(("clock",), text, key=True)
        if clock.end is None:
            return
        if clock.end not in self.names:
            text = f"clock.end names '{clock.end}'; there is no such operator{suggestion(clock.end, self.names)}"
            self.draft.add(here, text)
        elif clock.end in self.kinds and issubclass(self.kinds[clock.end], Sink):
            text = f"clock.end names {self._called(clock.end)}, a Sink, which holds back nobody and so ends nothing"
            self.draft.add(here, text)
        elif lockstep:
            for name, port, edge in feeds:
                if name == clock.end and edge.delay == 0 and edge.operator != name:
                    text = (
                        f"undelayed cycle {edge.operator} -> {name} -> {edge.operator}: clock.end names {name}, so"
                        f" every other operator waits for it at each stamp, yet {name}.{port} waits for {edge.source}"
                        f" of the same stamp; delay this edge, or end the run by clock.duration or another operator"
                    )
                    self.draft.add(("operators", name, "inputs", port), text)

    def _look_at_cycles(self, graph: Graph, feeds: list[Feed]) -> None:
        """Refuse cycles without a delay; warn where one comes round within a period of its own fastest timer."""
        undelayed = [feed for feed in feeds if feed[2].delay == 0]
        told: set[tuple[str, str]] = set()  # producer and consumer
        for name, port, edge in undelayed:
            found = None if (edge.operator, name) in told else _fastest_way(name, edge.operator, undelayed)
            if found is None:
                continue
            cycle = [*found[1], name]
            told.update(itertools.pairwise(cycle))
            text = f"undelayed cycle {' -> '.join(cycle)}: everyone waits for a message of the same stamp"
            self.draft.add(("operators", name, "inputs", port), f"{text}; give one of these edges a delay")
        seen: set[frozenset[str]] = set()
        for name, port, edge in feeds:
            found = _fastest_way(name, edge.operator, feeds) if edge.delay else None
            if found is None or frozenset(found[1]) in seen:
                continue
            seen.add(frozenset(found[1]))
            delay, cycle = edge.delay + found[0], [*found[1], name]
            timers = [e for member in found[1] for e in graph.operators[member].inputs.values() if e.period]
            fastest = min(timers, key=lambda timer: timer.period or 0, default=None)
            if fastest is not None and delay < (fastest.period or 0):
                text = (
                    f"the cycle {' -> '.join(cycle)} is delayed by {duration_text(delay)} in all, less than one period"
                    f" of its fastest timer, {fastest.source}"
                )
                self.warnings.append(self.draft.mistake(("operators", name, "inputs", port), text))


def _fastest_way(start: str, goal: str, feeds: Sequence[Feed]) -> tuple[int, list[str]] | None:
    """Return (delay, operators from start to goal) of the way with the least delay, then the fewest steps."""
    heap: list[tuple[int, int, list[str]]] = [(0, 1, [start])]
    done: set[str] = set()
    while heap:
        delay, steps, way = heapq.heappop(heap)
        if way[-1] == goal:
            return delay, way
        if way[-1] in done:
            continue
        done.add(way[-1])
        for name, _, edge in feeds:
            if edge.operator == way[-1]:
                heapq.heappush(heap, (delay + edge.delay, steps + 1, [*way, name]))
    return None
