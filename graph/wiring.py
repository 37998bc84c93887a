"""What one operator process must know of the graph: its ports, its neighbours, its clock."""

from __future__ import annotations

from typing import Any, Literal

import msgspec

from graph.contract import kind_of, ports_of
from graph.graphfile import TIMER, Graph
from graph.loading import load_class


class Input(msgspec.Struct, frozen=True):
    """An edge into an operator: the port, whom it listens to, and how."""

    port: str
    topic: str  # producer/port, or timer/10hz
    producer: str
    index: int = 0  # of the port among the producer's outputs
    delay: int = 0  # nanoseconds
    queue: int | Literal["latest"] = 10
    period: int | None = None  # nanoseconds, of a timer
    silent: bool = False  # nothing is ever emitted when something arrives here


class NodeSpec(msgspec.Struct, frozen=True):
    """One operator of a graph, resolved: enough to start its process without the others' classes."""

    name: str
    order: int  # in graph.yaml
    run: str
    root: str
    config: dict[str, Any]
    kind: Literal["operator", "source", "sink"]
    inputs: tuple[Input, ...]  # in the order in which they are handled
    outputs: tuple[str, ...]
    record: dict[str, Literal["full", "digest"]]
    consumers: tuple[str, ...]  # who holds this operator back: no sinks
    threads: int
    restart: str
    mode: Literal["lockstep", "realtime"]
    pace: Literal["max", "realtime"]
    duration: int | None
    end: str | None
    ahead: int
    heard: tuple[str, ...] = ()  # output ports that reach everyone who waits for this operator's marks

    @property
    def producers(self) -> tuple[str, ...]:
        """Name the operators whose messages this one consumes, each once."""
        return tuple(dict.fromkeys(edge.producer for edge in self.inputs if edge.period is None))


def wire(graph: Graph) -> list[NodeSpec]:
    """Resolve a checked graph into one NodeSpec an operator, in the order of the graph file."""
    classes = {name: load_class(entry.run, graph.root) for name, entry in graph.operators.items()}
    ports = {name: ports_of(kind) for name, kind in classes.items()}
    specs = []
    for order, (name, entry) in enumerate(graph.operators.items()):
        inputs = []
        for port in ports[name].inputs:
            if (edge := entry.inputs.get(port)) is None:
                continue
            topic = f"{edge.operator}/{edge.port}"
            index = 0 if edge.operator == TIMER else list(ports[edge.operator].outputs).index(edge.port)
            silent = port in ports[name].silent
            inputs.append(Input(port, topic, edge.operator, index, edge.delay, edge.queue, edge.period, silent))
        outputs = tuple(ports[name].outputs)
        record = {
            port: entry.record if isinstance(entry.record, str) else entry.record.get(port, "full") for port in outputs
        }
        wanted = {
            other: {edge.port for edge in wanting.inputs.values() if edge.operator == name}
            for other, wanting in graph.operators.items()
            if kind_of(classes[other]) != "sink"
        }
        consumers = tuple(other for other, mine in wanted.items() if mine)
        clock = graph.clock
        waiting = [mine for other, mine in wanted.items() if mine or (clock.end == name and other != name)]
        heard = tuple(port for port in outputs if all(port in mine for mine in waiting))
        specs.append(
            NodeSpec(
                name=name,
                order=order,
                run=entry.run,
                root=graph.root,
                config=entry.config,
                kind=kind_of(classes[name]),
                inputs=tuple(inputs),
                outputs=outputs,
                record=record,
                consumers=consumers,
                heard=heard,
                threads=entry.threads,
                restart=entry.restart,
                mode=clock.mode,
                pace=clock.pace,
                duration=clock.duration,
                end=clock.end,
                ahead=clock.ahead,
            )
        )
    return specs
