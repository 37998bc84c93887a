"""Two recordings against each other, in everything but the wall clock."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import zip_longest

import msgspec

from graph.codec import CodecError, decode
from graph.compare import differences
from graph.contract import ports_of
from graph.errors import UserError
from graph.loading import load_class
from graph.recording import Entry, Recording
from graph.shard import STEP, SUMMARY


class OperatorDiff(msgspec.Struct):
    """What two recordings say of one operator."""

    operator: str
    messages: int = 0  # compared
    steps: int = 0
    different: int = 0
    first: str = ""  # the first difference, in words


class Diff(msgspec.Struct):
    """What two recordings have in common."""

    equal: bool
    operators: list[OperatorDiff]


def compare(one: Recording, two: Recording) -> Diff:
    """Compare all messages, steps and summaries of two recordings, operator by operator; sinks are left out."""
    specs = {spec.name: spec for spec in (*one.run.specs, *two.run.specs)}
    reports = {name: OperatorDiff(name) for name, spec in specs.items() if spec.kind != "sink"}
    for first, second in _paired(one, two, set(reports)):
        entry = first or second
        assert entry is not None
        report = reports[entry.operator]
        if entry.port == STEP:
            report.steps += 1
        else:
            report.messages += 1
        if (words := _difference(one, first, second)) is not None:
            report.different += 1
            report.first = report.first or words
    return Diff(all(report.different == 0 for report in reports.values()), list(reports.values()))


def _paired(one: Recording, two: Recording, names: set[str]) -> Iterator[tuple[Entry | None, Entry | None]]:
    """Pair the entries of two recordings, operator by operator, in the order of the files."""
    waiting: dict[str, tuple[list[Entry], list[Entry]]] = {name: ([], []) for name in names}
    for pair in zip_longest(one.entries(), two.entries()):
        for side, entry in enumerate(pair):
            if entry is None or entry.operator not in names:
                continue
            queues = waiting[entry.operator]
            queues[side].append(entry)
            if queues[1 - side]:
                yield queues[0].pop(0), queues[1].pop(0)
    for left, right in waiting.values():
        yield from zip_longest(left, right)


def _difference(recording: Recording, first: Entry | None, second: Entry | None) -> str | None:
    """Say in words how two entries differ; None if they do not."""
    if first is None or second is None:
        entry = first or second
        assert entry is not None
        side = "first" if first else "second"
        return f"{entry.topic} number {entry.sequence} at {entry.stamp / 1e9:.3f} s is only in the {side}"
    where = f"{first.topic} number {first.sequence} at {first.stamp / 1e9:.3f} s"
    if first[:5] != second[:5]:
        return f"{where} meets {second.topic} number {second.sequence} at {second.stamp / 1e9:.3f} s"
    if first.port == STEP:
        old, new = first.step(), second.step()
        if old.facts() == new.facts():
            return None
        names = ("index", "port", "stamp", "consumed", "skipped", "emitted", "ended", "late")
        name, was, now = next(item for item in zip(names, old.facts(), new.facts(), strict=True) if item[1] != item[2])
        return f"{where}: {name} was {was}, is {now}"
    if first.payload == second.payload:
        return None
    return f"{where}: {_fields(recording, first, second)}"


def _fields(recording: Recording, first: Entry, second: Entry) -> str:
    if first.port == SUMMARY:
        values = (msgspec.msgpack.decode(entry.payload) for entry in (first, second))
        return "; ".join(map(str, differences(*values)))
    try:
        entry = recording.graph.operators[first.operator]
        kind = ports_of(load_class(entry.run, recording.graph.root)).outputs[first.port]
        return (
            "; ".join(map(str, differences(decode(first.payload, kind), decode(second.payload, kind)))) or "other bytes"
        )
    except (UserError, CodecError, KeyError):
        return "other bytes"
