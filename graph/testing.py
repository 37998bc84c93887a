"""For tests of operators, anybody's: run one on hand-made messages; hold a recording against its text reference.

A pytest plugin, found by pytest once retracer is installed:

    @pytest.mark.replay("recordings/corridor.mcap")
    def test_corridor(replayed): ...

fails unless every operator of the recording says again what it said, and recordings/corridor.txt says the same in
words; `pytest --update-references` writes the text.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from xxhash import xxh3_128

from graph.codec import decode, encode
from graph.contract import Operator, kind_of, ports_of
from graph.errors import UserError
from graph.ledger import Ref
from graph.loading import load_class
from graph.node import Emission, Node
from graph.provenance import cpu_class, versions
from graph.recording import Recording
from graph.replay import replay
from graph.replay_report import Replay, lines
from graph.wiring import Input, NodeSpec

TOLERANCE = 1e-3  # of a field, where processor or versions are not those of the recording
DIGITS = 3  # significant digits in a reference


def run_operator(
    kind: type[Operator], messages: Iterable[tuple[str, msgspec.Struct]], config: Any = None
) -> list[tuple[str, Any]]:
    """Feed an operator (port, message) pairs, on_start first and on_end last; return what it says as such pairs.

    Messages go through the same encode and decode as on the wire. The stamp of a call is the message's `measured_at`,
    else that of the call before. Raises whatever the operator raises.
    """
    ports = ports_of(kind)
    name = kind.__name__.lower()
    inputs = tuple(Input(port, f"test/{port}", "test") for port in ports.inputs)
    spec = NodeSpec(
        name=name,
        order=0,
        run=f"{kind.__module__}:{kind.__qualname__}",
        root=".",
        config={},
        kind=kind_of(kind),
        inputs=inputs,
        outputs=tuple(ports.outputs),
        record=dict.fromkeys(ports.outputs, "full"),
        consumers=(),
        threads=1,
        restart="never",
        mode="lockstep",
        pace="max",
        duration=None,
        end=None,
        ahead=10**9,
    )
    node = Node(spec, kind(config))
    said: list[tuple[str, Any]] = []

    def emit(emission: Emission) -> None:
        said.append((emission.port, decode(emission.payload, ports.outputs[emission.port])))

    node.start(emit)
    stamp = 0
    for sequence, (port, message) in enumerate(messages):
        if port not in ports.inputs:
            raise KeyError(f"{kind.__name__} has no input '{port}'; it has {', '.join(ports.inputs) or 'none'}")
        stamp = int(getattr(message, "measured_at", stamp))
        node.feed(port, Ref(f"test/{port}", 0, sequence), encode(message), stamp, emit)
    node.finish(stamp, emit)
    return said


def reference(recording: Recording) -> str:
    """Say in words what a recording says: calls, messages, and the rounded mean of every number, topic by topic.

    Of topics that are kept as digests it gives a checksum over the bytes of all their messages.
    """
    steps: dict[str, int] = {}
    counts: dict[str, int] = {}
    sums: dict[str, list[float]] = {}
    ports = {f"{spec.name}/{port}": spec.record[port] for spec in recording.run.specs for port in spec.outputs}
    checksums: dict[str, xxh3_128] = {}
    types = {
        f"{name}/{port}": kind
        for name, entry in recording.graph.operators.items()
        for port, kind in ports_of(load_class(entry.run, recording.graph.root)).outputs.items()
    }
    for operator, _, step in recording.steps():
        steps[operator] = steps.get(operator, 0) + 1
        for item in step.emitted:
            topic = f"{operator}/{item.port}"
            counts[topic] = counts.get(topic, 0) + 1
            if ports[topic] == "digest":
                checksums.setdefault(topic, xxh3_128()).update(item.digest)
    for entry in recording.messages():
        message = decode(entry.payload, types[entry.topic])
        for field in message.__struct_fields__:
            if (number := _number(getattr(message, field))) is not None:
                sums.setdefault(f"{entry.topic}.{field}", []).append(number)
    sinks = {spec.name for spec in recording.run.specs if spec.kind == "sink"}
    text = [f"{recording.verdict.verdict} after {recording.verdict.end / 1e9:g} s"]
    text += [f"{name}: {count} steps" for name, count in steps.items() if name not in sinks]
    text += [
        f"{topic}: {count} messages" + (f", checksum {checksums[topic].hexdigest()[:16]}" if topic in checksums else "")
        for topic, count in counts.items()
    ]
    text += [f"{field}: mean {np.mean(values):.{DIGITS}g}" for field, values in sorted(sums.items())]
    text += [f"{name} summary: {_rounded(summary)}" for name, summary in sorted(recording.summaries().items())]
    return "\n".join(text) + "\n"


def _number(value: Any) -> float | None:
    """Reduce a field to one number: its value, or the mean of an array that has any."""
    if isinstance(value, np.ndarray):
        return float(np.mean(value, dtype=np.float64)) if value.size else 0.0
    return float(value) if isinstance(value, (int, float)) else None


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def tolerable(report: Replay, tolerance: float = TOLERANCE) -> bool:
    """Say whether a replay is equal to the bit, or, on other processors or versions, within a tolerance."""
    if report.equal:
        return True
    near = all(item.unjudged == 0 and item.largest <= tolerance for item in report.operators)
    return bool(report.warnings) and near


def elsewhere(recording: Recording) -> bool:
    """Say whether a recording that holds digests comes from other processors or versions: other bits."""
    digests = any("digest" in spec.record.values() for spec in recording.run.specs)
    return digests and (recording.run.cpu != cpu_class() or recording.run.versions != versions())


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add --update-references."""
    group = parser.getgroup("retracer")
    group.addoption("--update-references", action="store_true", help="write the text references of recordings anew")


def pytest_configure(config: pytest.Config) -> None:
    """Make the marker known."""
    config.addinivalue_line("markers", "replay(recording): the recording says again what it said")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Let the marker do without the fixture by name."""
    for item in items:
        names = getattr(item, "fixturenames", None)
        if item.get_closest_marker("replay") and names is not None and "replayed" not in names:
            names.append("replayed")


@pytest.fixture
def replayed(request: pytest.FixtureRequest) -> Replay:
    """Replay the recording that the marker names and hold it against its reference; return the report."""
    marker = request.node.get_closest_marker("replay")
    if marker is None or not marker.args:
        pytest.fail('the fixture replayed wants @pytest.mark.replay("recordings/NAME.mcap")')
    path = request.config.rootpath / marker.args[0]
    try:
        recording = Recording(path)
        report = replay(recording)
    except UserError as error:
        pytest.fail(str(error), pytrace=False)
    if not tolerable(report):
        told = "\n".join(lines(report))
        if elsewhere(recording):
            pytest.skip(f"what is kept as digests cannot be held within a tolerance: {told}")
        pytest.fail(told, pytrace=False)
    text, written = reference(recording), Path(path).with_suffix(".txt")
    if request.config.getoption("--update-references"):
        written.write_text(text)
    assert written.exists(), f"{written} is missing; pytest --update-references writes it"
    assert text == written.read_text(), f"{written} says something else; pytest --update-references writes it anew"
    return report
