"""A graph as a Mermaid flowchart: operators, timers, and on each arrow the port and the type of its messages."""

from __future__ import annotations

from graph.contract import Operator, kind_of, ports_of
from graph.durations import duration_text
from graph.errors import UserError
from graph.graphfile import DEFAULT_QUEUE, TIMER, Edge, Graph
from graph.loading import load_class

_KEYWORDS = "end graph subgraph flowchart style class classDef click default direction linkStyle".split()  # noqa: SIM905
_SHAPES = {"operator": ("[", "]"), "source": ("[/", "/]"), "sink": ("([", "])")}


def mermaid(graph: Graph) -> str:
    """Draw a graph as Mermaid text; operators whose class cannot be loaded are drawn without types.

    Plain operators are boxes, sources slanted, sinks round, timers circles; delayed arrows are dotted.
    """
    kinds: dict[str, type[Operator]] = {}
    for name, entry in graph.operators.items():
        try:
            kinds[name] = load_class(entry.run, graph.root)
        except UserError:
            continue
    lines = ["flowchart LR"]
    for name, entry in graph.operators.items():
        opening, closing = _SHAPES[kind_of(kinds[name]) if name in kinds else "operator"]
        lines.append(f'    {_node(name)}{opening}"{name}<br/>{entry.run}"{closing}')
    edges = [(name, port, edge) for name, entry in graph.operators.items() for port, edge in entry.inputs.items()]
    for timer in dict.fromkeys(edge.port for _, _, edge in edges if edge.operator == TIMER):
        lines.append(f'    {_timer(timer)}(("{timer}"))')
    for name, port, edge in edges:
        start = _timer(edge.port) if edge.operator == TIMER else _node(edge.operator)
        line = "-.->" if edge.delay else "-->"
        lines.append(f'    {start} {line}|"{_label(port, edge, kinds)}"| {_node(name)}')
    return "\n".join(lines) + "\n"


def _label(port: str, edge: Edge, kinds: dict[str, type[Operator]]) -> str:
    """Write `output to input: Type`, once if both have one name, then delay and queue if not the default."""
    words = port if edge.operator == TIMER or edge.port == port else f"{edge.port} to {port}"
    if edge.operator in kinds and (kind := ports_of(kinds[edge.operator]).outputs.get(edge.port)) is not None:
        words += f": {kind.__name__}"
    elif edge.operator == TIMER:
        words += ": Tick"
    if edge.delay:
        words += f"<br/>after {duration_text(edge.delay)}"
    if edge.queue != DEFAULT_QUEUE:
        words += f"<br/>queue {edge.queue}"
    return words


def _node(name: str) -> str:
    return f"operator-{name}" if name in _KEYWORDS else name  # no operator's name holds a hyphen


def _timer(port: str) -> str:
    return f"timer-{port.replace('.', '_')}"
