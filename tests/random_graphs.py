"""Random graphs, and two ways to run them: a plain sequential simulator, and the rules of lockstep on a wild network.

The network has a first-in, first-out link for each topic, for each operator's marks and for its reports upstream: more
freedom than any wire takes. The reference is a twin of the runtime: one heap, one thread, no watermarks.
"""

from __future__ import annotations

import heapq
import random
from collections import deque
from collections.abc import Callable
from typing import Any

from hypothesis import HealthCheck, reject, settings
from hypothesis import strategies as st

from graph.graphfile import Clock, Edge, Graph, OperatorEntry
from graph.ledger import INFINITY, Step
from graph.lockstep import Arrival, Lockstep
from graph.node import STREAM, Emission, Node, build_operator
from graph.wiring import NodeSpec, wire
from graph.worker import FLOW_PARTS

CALLS = 300  # of a run; a loop that says two numbers for each one it hears would never end
PATIENCE = 50_000  # acts of the model after which such a run goes round in circles

TRIALS = "tests.trial_operators"
FIXED = settings(derandomize=True, deadline=None, database=None, suppress_health_check=list(HealthCheck))

Ledger = dict[str, list[tuple[object, ...]]]


# random graphs; nanoseconds are single digits, so that stamps meet


@st.composite
def graphs(draw: st.DrawFn) -> Graph:
    """Draw a graph that check accepts: delayed cycles, several rates, sporadic inputs, sources, sinks, both ends."""
    count = draw(st.integers(1, 5))
    names = [f"op{index}" for index in range(count)]
    ending = draw(st.sampled_from([None, *names]))
    sources = {name for name in names if draw(st.integers(0, 4)) == 0}
    operators = {
        name: _source(draw, name == ending) if name in sources else _mixer(draw, names, index, ending)
        for index, name in enumerate(names)
    }
    if draw(st.booleans()):
        operators["screen"] = OperatorEntry(
            "tests.sample_operators:Screen", {"count": Edge(draw(st.sampled_from(names)), "x")}
        )
    duration = draw(st.integers(1, 25)) if ending is None or draw(st.booleans()) else None
    ahead = draw(st.sampled_from([1, 2, 3, 7, 20, 1000]))
    items = list(operators.items())
    order = draw(st.permutations(items))
    return Graph(Clock(duration=duration, end=ending, ahead=ahead), dict(order), "random", ".")


def _config(draw: st.DrawFn, ends_run: bool) -> dict[str, Any]:
    return {
        "seed": draw(st.integers(0, 99)),
        "share": draw(st.sampled_from([10, 50, 90, 100])),
        "starts": draw(st.booleans()),
        "ends": draw(st.booleans()),
        "last": draw(st.integers(1, 8)) if ends_run else None,
    }


def _source(draw: st.DrawFn, ends_run: bool) -> OperatorEntry:
    stamps = sorted(draw(st.sets(st.integers(0, 25), max_size=10)))
    return OperatorEntry(f"{TRIALS}:MixerSource", {}, _config(draw, ends_run) | {"stamps": stamps})


def _mixer(draw: st.DrawFn, names: list[str], index: int, ending: str | None) -> OperatorEntry:
    """Draw an operator; edges from later operators, from itself, and into the one that ends the run have a delay."""
    name = names[index]
    inputs = {}
    for port in ("a", "b", "c", "d"):
        if draw(st.integers(0, 2)):
            continue
        producer = draw(st.integers(0, len(names) - 1))
        least = 1 if producer >= index or name == ending else 0
        delay = draw(st.integers(least, 9)) if least or draw(st.booleans()) else 0
        inputs[port] = Edge(names[producer], draw(st.sampled_from("xy")), delay)
    kind = draw(st.sampled_from(["Mixer", "Mixer", "Listener"]))
    for port, periods in (("slow", [4, 5, 7]), ("fast", [1, 2, 3])):
        needed = port == "slow" and (not inputs or name == ending)  # else it might never be called
        if needed or draw(st.integers(0, 2)) == 0:
            inputs[port] = Edge("timer", f"{draw(st.sampled_from(periods))}ns", draw(st.sampled_from([0, 0, 2])))
    return OperatorEntry(f"{TRIALS}:{kind}", inputs, _config(draw, name == ending))


# the twin: one heap, one thread


def reference(graph: Graph) -> Ledger:
    """Run a graph as a plain sequential simulation: (arrival, rank, port, sequence) in one heap."""
    specs = {spec.name: spec for spec in wire(graph) if spec.kind != "sink"}
    nodes = {name: Node(spec, build_operator(spec)) for name, spec in specs.items()}
    ranks = _ranks(specs)
    ledger: Ledger = {name: [] for name in specs}
    heap: list[tuple[int, int, int, int, Arrival]] = []
    end = INFINITY if graph.clock.duration is None else graph.clock.duration

    def push(name: str, arrival: Arrival) -> None:
        heapq.heappush(heap, (arrival.time, ranks[name], arrival.port, arrival.sequence, arrival))

    def deliver(name: str, emissions: list[Emission]) -> None:
        for emission in emissions:
            for other in specs.values():
                for port, edge in enumerate(other.inputs):
                    if edge.topic == f"{name}/{emission.port}":
                        time = emission.stamp + edge.delay
                        push(other.name, Arrival(time, port, emission.sequence, 0, emission.payload))

    for name, spec in specs.items():
        emissions: list[Emission] = []
        ledger[name].append(nodes[name].start(emissions.append).facts())
        deliver(name, emissions)
        for port, edge in enumerate(spec.inputs):
            if edge.period is not None:
                push(name, Arrival(edge.delay, port, 0, 0, None))
        if spec.kind == "source":
            end = _peek(graph, nodes[name], push, end, 0)
    by_rank = sorted(ranks, key=lambda name: ranks[name])
    finished = 0
    while finished < len(by_rank):
        if sum(map(len, ledger.values())) > CALLS:
            reject()
        if not heap or heap[0][:2] > (end, finished):
            name, emissions = by_rank[finished], []
            ledger[name].append(nodes[name].finish(end, emissions.append).facts())
            deliver(name, emissions)
            finished += 1
            continue
        time, rank, port, sequence, arrival = heapq.heappop(heap)
        name, emissions = by_rank[rank], []
        step = nodes[name].handle(arrival, time, emissions.append)
        ledger[name].append(step.facts())
        deliver(name, emissions)
        if port >= 0 and (period := specs[name].inputs[port].period) is not None:
            push(name, Arrival(time + period, port, sequence + 1, 0, None))
        if step.ended is not None and graph.clock.end == name:
            end = min(end, time)
        if step.port == STREAM:
            end = _peek(graph, nodes[name], push, end, time)
    return ledger


def _peek(graph: Graph, node: Node, push: Callable[[str, Arrival], None], end: int, now: int) -> int:
    """Queue the next item of a source; one that runs dry ends the run, if that is for it to end. Returns the end."""
    if (stamp := node.peek()) is not None:
        push(node.spec.name, Arrival(stamp, -1, 0, 0, None))
        return end
    return min(end, now) if graph.clock.end == node.spec.name else end


def _ranks(specs: dict[str, NodeSpec]) -> dict[str, int]:
    """Order operators so that no undelayed edge goes backwards; the one that ends the run is before all others."""
    ranks: dict[str, int] = {}

    def visit(name: str) -> None:
        if name in ranks:
            return
        if specs[name].end not in (None, name):
            visit(specs[name].end or "")
        for edge in specs[name].inputs:
            if edge.period is None and edge.delay == 0:
                visit(edge.producer)
        ranks[name] = len(ranks)

    for name in specs:
        visit(name)
    return ranks


# the model: Lockstep on a network that delivers when it pleases


class Station:
    """One operator of the model: what graph.worker does, without a wire."""

    def __init__(self, spec: NodeSpec) -> None:
        self.spec, self.schedule = spec, Lockstep(spec)
        self.node = Node(spec, build_operator(spec))
        self.steps: list[Step] = []
        self.flowed = -1


class Network:
    """Random choices of who goes next and which link gives its oldest."""

    def __init__(self, graph: Graph, chance: random.Random) -> None:
        self.chance = chance
        self.stations = {spec.name: Station(spec) for spec in wire(graph) if spec.kind != "sink"}
        self.links: dict[tuple[str, str, str], deque[Any]] = {}  # (from, to, topic or kind)
        self.worst_lead = 0

    def send(self, sender: str, to: str, kind: str, content: Any) -> None:
        self.links.setdefault((sender, to, kind), deque()).append(content)

    def receive(self, key: tuple[str, str, str]) -> None:
        sender, to, kind = key
        content = self.links[key].popleft()
        if not self.links[key]:
            del self.links[key]
        schedule = self.stations[to].schedule
        if kind == "mark":
            schedule.mark(sender, content)
        elif kind == "flow":
            schedule.consumer_at(sender, content)
        else:
            schedule.deliver(kind, *content)

    def emit(self, station: Station, emission: Emission) -> None:
        topic = f"{station.spec.name}/{emission.port}"
        for other in self.stations.values():
            if any(edge.topic == topic for edge in other.spec.inputs):
                self.send(
                    station.spec.name, other.spec.name, topic, (0, emission.sequence, emission.stamp, emission.payload)
                )

    def promise(self, station: Station) -> bool:
        name = station.spec.name
        mark, through = station.schedule.news(tuple(station.node.counts.values())), station.schedule.through()
        if mark is not None:
            for other in self.stations.values():
                if name in other.spec.producers or other.spec.end == name:
                    self.send(name, other.spec.name, "mark", mark)
        flows = through > station.flowed and through >= station.flowed + station.spec.ahead // FLOW_PARTS
        if flows:
            station.flowed = through
            for producer in station.spec.producers:
                self.send(name, producer, "flow", through)
        return mark is not None or flows

    def act(self, station: Station) -> bool:
        """Let a station do one thing; say whether there was one."""
        schedule, node = station.schedule, station.node

        def emit(emission: Emission) -> None:
            self.emit(station, emission)

        if not schedule.started:
            station.steps.append(node.start(emit))
            schedule.started = True
            self.fetch(station)
        elif (arrival := schedule.next()) is not None:
            self.check_lead(station, arrival.time)
            step = node.handle(arrival, arrival.time, emit)
            station.steps.append(step)
            if step.ended is not None and station.spec.end == station.spec.name:
                schedule.finish_at(arrival.time)
            if step.port == STREAM:
                self.promise(station)
                self.fetch(station)
        elif schedule.complete():
            station.steps.append(node.finish(schedule.end, emit))
            schedule.finished = True
        else:
            return self.promise(station)
        self.promise(station)
        return True

    def fetch(self, station: Station) -> None:
        if station.spec.kind == "source":
            stamp = station.node.peek()
            station.schedule.offer(INFINITY if stamp is None else stamp)

    def check_lead(self, station: Station, time: int) -> None:
        """Hold an operator against the flow rule: each consumer is complete through time - ahead."""
        for name in station.spec.consumers:
            if name != station.spec.name:
                lead = time - self.stations[name].schedule.through()
                assert lead <= station.spec.ahead, f"{station.spec.name} is {lead} ns ahead of {name}"

    def run(self) -> dict[str, list[Step]]:
        """Go on until all have finished. Fails on a deadlock, and where nothing but watermarks go round."""
        for _ in range(PATIENCE):
            if all(station.schedule.finished for station in self.stations.values()):
                return {name: station.steps for name, station in self.stations.items()}
            choices: list[Any] = [*self.links, *self.stations.values()]
            for choice in self.chance.sample(choices, len(choices)):
                if isinstance(choice, tuple):
                    self.receive(choice)
                    break
                if not choice.schedule.finished and self.act(choice):
                    break
            else:
                raise AssertionError("deadlock")
        raise AssertionError("no end in sight")
