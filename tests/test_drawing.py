"""Drawings of graphs: everything in the graph is in the drawing, and the same each time."""

from __future__ import annotations

from graph.drawing import mermaid
from graph.graphfile import Clock, Edge, Graph, OperatorEntry

SAMPLES = "tests.sample_operators"


def _graph(**operators: OperatorEntry) -> Graph:
    return Graph(Clock(duration=10**9), operators, "drawn", ".")


def test_a_drawing_shows_operators_timers_ports_types_delays_and_queues() -> None:
    graph = _graph(
        scans=OperatorEntry(f"{SAMPLES}:Scans"),
        adder=OperatorEntry(
            f"{SAMPLES}:Adder", {"left": Edge("scans", "count"), "right": Edge("feedback", "count", queue="latest")}
        ),
        feedback=OperatorEntry(
            f"{SAMPLES}:Feedback", {"tick": Edge("timer", "0.5hz"), "back": Edge("feedback", "count", 2 * 10**9)}
        ),
        screen=OperatorEntry(f"{SAMPLES}:Screen", {"count": Edge("scans", "count")}),
    )
    assert mermaid(graph).splitlines() == [
        "flowchart LR",
        f'    scans[/"scans<br/>{SAMPLES}:Scans"/]',
        f'    adder["adder<br/>{SAMPLES}:Adder"]',
        f'    feedback["feedback<br/>{SAMPLES}:Feedback"]',
        f'    screen(["screen<br/>{SAMPLES}:Screen"])',
        '    timer-0_5hz(("0.5hz"))',
        '    scans -->|"count to left: Count"| adder',
        '    feedback -->|"count to right: Count<br/>queue latest"| adder',
        '    timer-0_5hz -->|"tick: Tick"| feedback',
        '    feedback -.->|"count to back: Count<br/>after 2s"| feedback',
        '    scans -->|"count: Count"| screen',
    ]


def test_words_of_mermaid_are_no_node_names() -> None:
    lines = mermaid(
        _graph(end=OperatorEntry(f"{SAMPLES}:Relay", {"count": Edge("graph", "count")}), graph=OperatorEntry("x:Y"))
    )
    assert lines.splitlines()[1:] == [
        f'    operator-end["end<br/>{SAMPLES}:Relay"]',
        '    operator-graph["graph<br/>x:Y"]',
        '    operator-graph -->|"count"| operator-end',
    ]
