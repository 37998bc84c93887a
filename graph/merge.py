"""Shards to recording: one chunked, indexed file in the order (stamp, operator, port, sequence), with a verdict.

The verdict is arithmetic: on every edge, emitted = consumed + skipped + later + lost.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from mcap.records import Channel, Message, Schema
from mcap.writer import CompressionType, Writer

from graph.codec import digest
from graph.ledger import INFINITY, Step
from graph.recording import PROFILE, RUN, VERDICT, Channels, EdgeAccount, Entry, Run, Verdict, read_records, seal
from graph.shard import STEP, SUMMARY
from graph.wiring import NodeSpec

CHUNK_BYTES = 1 << 20


class ShardReader:
    """Reads one shard as far as it goes."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.cut = INFINITY  # index of the first call that is left out
        self.left_out = 0
        self.channels = Channels()

    def entries(self) -> Iterator[Entry]:
        """Iterate over what the operator wrote: the messages of a call, then its step. Stops at the first damage."""
        if self.cut == INFINITY:
            yield from self._written()
            return
        call: list[Entry] = []
        for entry in self._written():
            call.append(entry)
            if entry.port == STEP:
                if entry.step().index < self.cut:
                    yield from call
                else:
                    self.left_out += 1
                call.clear()

    def _written(self) -> Iterator[Entry]:
        try:
            with self.path.open("rb") as stream:
                for record in read_records(stream):
                    if isinstance(record, (Schema, Channel)):
                        self.channels.take(record)
                    elif isinstance(record, Message):
                        yield self.channels.entry(record)
        except Exception:  # whatever the half-written end of a killed process makes of itself
            return


def leave_out(readers: Sequence[ShardReader]) -> list[str]:
    """Cut from shards the last calls whose messages were never written; return sentences that say so.

    An operator puts its messages before it writes them. One that is killed in between leaves the others with calls
    that no replay could repeat.
    """
    steps: dict[ShardReader, list[Step]] = {reader: [] for reader in readers}
    there: set[tuple[str, int, int]] = set()  # topic, incarnation, sequence
    owners: dict[ShardReader, tuple[str, int]] = {}

    def said(reader: ShardReader, calls: Sequence[Step]) -> set[tuple[str, int, int]]:
        name, incarnation = owners[reader]
        return {(f"{name}/{item.port}", incarnation, item.sequence) for step in calls for item in step.emitted}

    for reader in readers:
        for entry in reader.entries():
            owners[reader] = (entry.operator, entry.incarnation)
            if entry.port == STEP:
                steps[reader].append(entry.step())
            elif entry.port != SUMMARY:
                there.add((entry.topic, entry.incarnation, entry.sequence))
        there |= said(reader, steps[reader]) if steps[reader] else set()
    again = True
    while again:
        again = False
        for reader, own in steps.items():
            for place, step in enumerate(own):
                wanted = [ref for ref in step.consumed if not ref.topic.startswith("timer/")]
                if all((ref.topic, ref.incarnation, ref.sequence) in there for ref in wanted):
                    continue
                reader.cut = step.index
                there -= said(reader, own[place:])
                del own[place:]
                again = True
                break
    return [
        f"calls of {owners[reader][0]} from number {reader.cut} on are left out: what they consumed was never written"
        for reader in readers
        if reader.cut < INFINITY
    ]


class Ledger:
    """What the steps say, summed up edge by edge."""

    def __init__(self, specs: dict[str, NodeSpec]) -> None:
        self.specs = specs
        self.emitted: Counter[tuple[str, str]] = Counter()  # (topic, consumer)
        self.consumed: Counter[tuple[str, str]] = Counter()
        self.skipped: Counter[tuple[str, str]] = Counter()
        self.unhandled: Counter[str] = Counter()
        self.emissions: dict[str, list[int]] = {}  # topic: stamps
        self.digests: dict[tuple[str, int, int], tuple[bytes, int]] = {}  # and stamps, while their step is to come
        self.mismatches: list[str] = []

    def message(self, entry: Entry) -> None:
        """Remember a message's digest until its step says what it should be."""
        self.digests[(entry.topic, entry.incarnation, entry.sequence)] = digest(entry.payload), entry.stamp

    def step(self, operator: str, incarnation: int, step: Step) -> None:
        """Count one call."""
        for item in step.emitted:
            topic = f"{operator}/{item.port}"
            self.emissions.setdefault(topic, []).append(step.stamp)
            written = self.digests.pop((topic, incarnation, item.sequence), None)
            if written is not None and written[0] != item.digest:
                self.mismatches.append(f"{topic} number {item.sequence} is not what its step says")
            elif written is None and self.specs[operator].record.get(item.port) == "full":
                self.mismatches.append(f"{topic} number {item.sequence} is missing")
        for ref in step.consumed:
            self.consumed[ref.topic, operator] += 1
        for skip in step.skipped:
            if skip.why == "unhandled":
                self.unhandled[operator] += 1
            self.skipped[skip.topic, operator] += 1

    def accounts(self, end: int) -> list[EdgeAccount]:
        """Balance every edge; `end` is the stamp after which nothing was handled."""
        for (topic, _, _), (_, stamp) in self.digests.items():  # of a call that failed after it had spoken
            self.emissions.setdefault(topic, []).append(stamp)
        self.digests.clear()
        accounts = []
        for consumer in self.specs.values():
            edges = [edge for edge in consumer.inputs if edge.period is None]
            for topic in dict.fromkeys(edge.topic for edge in edges):
                stamps = self.emissions.get(topic, [])
                delays = [edge.delay for edge in edges if edge.topic == topic]
                emitted = len(stamps) * len(delays)
                later = 0
                if consumer.mode == "lockstep":
                    later = sum(stamp + delay > end for stamp in stamps for delay in delays)
                consumed, skipped = self.consumed[topic, consumer.name], self.skipped[topic, consumer.name]
                lost = emitted - consumed - skipped - later
                accounts.append(EdgeAccount(topic, consumer.name, emitted, consumed, skipped, later, lost))
        return accounts


def merge(
    shards: Sequence[Path],
    out: Path,
    run: Run,
    *,
    reasons: Sequence[str] = (),
    crashed: bool = False,
    wall_seconds: float = 0.0,
    logs: Sequence[Path] = (),
) -> Verdict:
    """Merge shards into a recording; the file appears under its name only when it is whole.

    reasons: why the run is incomplete, as far as the launcher knows. crashed: some operators may have been killed
    between putting messages and writing them. Returns the verdict that the file carries.
    """
    by_name = {spec.name: spec for spec in run.specs}
    readers = [ShardReader(path) for path in shards]
    if crashed:
        reasons = [*reasons, *leave_out(readers)]
    part = out.with_name(out.name + ".part")
    ledger = Ledger(by_name)
    ended: set[str] = set()
    last = 0
    count = 0
    end_stamps: list[int] = []
    with part.open("wb") as stream:
        writer = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        writer.start(profile=PROFILE, library="retracer")
        writer.add_metadata(RUN, seal(run))
        targets: dict[tuple[str, str, int], int] = {}
        streams = [_ordered(reader, by_name) for reader in readers]
        for _, index, entry in heapq.merge(*(_numbered(stream, index) for index, stream in enumerate(streams))):
            key = (entry.operator, entry.port, entry.incarnation)
            if key not in targets:
                targets[key] = _register(writer, readers[index].channels, entry)
            writer.add_message(
                targets[key],
                log_time=entry.stamp,
                publish_time=entry.stamp,
                sequence=entry.sequence,
                data=entry.payload,
            )
            last = max(last, entry.stamp)
            if entry.port == STEP:
                step = entry.step()
                ledger.step(entry.operator, entry.incarnation, step)
                if step.port == "end":
                    ended.add(entry.operator)
                    end_stamps.append(step.stamp)
            elif entry.port != SUMMARY:
                ledger.message(entry)
                count += 1
        _register_silent(writer, readers, targets)
        end = max(end_stamps) if end_stamps else last
        accounts = ledger.accounts(end if end < INFINITY else last)
        why = list(dict.fromkeys([*reasons, *_shortcomings(by_name, ended, ledger, accounts)]))
        for log in logs:
            if text := log.read_bytes():
                writer.add_attachment(0, 0, f"log/{log.stem}.txt", "text/plain", text)
        verdict = Verdict("INCOMPLETE" if why else "COMPLETE", why, end, wall_seconds, accounts, count)
        writer.add_metadata(RUN, seal(run))  # again: a recording without it is lost, whatever else is whole
        writer.add_metadata(VERDICT, seal(verdict))
        writer.finish()  # type: ignore[no-untyped-call]
    part.replace(out)
    return verdict


def _shortcomings(
    specs: dict[str, NodeSpec],
    ended: set[str],
    ledger: Ledger,
    accounts: Sequence[EdgeAccount],
) -> list[str]:
    """Say in sentences what keeps a run from being complete."""
    why = [f"{name} did not come to its end" for name in specs if name not in ended and specs[name].kind != "sink"]
    why += [
        f"{account.lost} of {account.emitted} messages were lost from {account.topic} to {account.operator}"
        for account in accounts
        if account.lost > 0 and specs[account.operator].kind != "sink"
    ]
    why += [
        f"{-account.lost} messages that {account.operator} had from {account.topic} were never written"
        for account in accounts
        if account.lost < 0
    ]
    why += [
        f"{number} messages were left unhandled by {name}"
        for name, number in ledger.unhandled.items()
        if specs[name].kind != "sink"
    ]
    return why + ledger.mismatches[:10]


def _ordered(reader: ShardReader, specs: dict[str, NodeSpec]) -> Iterator[tuple[tuple[int, ...], Entry]]:
    """Sort what one operator wrote: by port within a stamp; messages whose step never came are kept."""
    group: list[tuple[tuple[int, ...], Entry]] = []
    for entry in reader.entries():
        own = specs[entry.operator]
        rank = own.outputs.index(entry.port) if entry.port in own.outputs else len(own.outputs) + (entry.port == STEP)
        if group and group[0][0][0] != entry.stamp:
            yield from sorted(group)
            group = []
        group.append(((entry.stamp, own.order, entry.incarnation, rank, entry.sequence), entry))
    yield from sorted(group)


def _numbered(
    stream: Iterator[tuple[tuple[int, ...], Entry]], index: int
) -> Iterator[tuple[tuple[int, ...], int, Entry]]:
    for key, entry in stream:
        yield key, index, entry


def _register(writer: Writer, channels: Channels, entry: Entry) -> int:
    name, text = channels.types[entry.topic]
    number = writer.register_schema(name, "jsonschema", text.encode())
    mine = {"operator": entry.operator, "incarnation": str(entry.incarnation)}
    return int(writer.register_channel(entry.topic, "msgpack", number, mine))


def _register_silent(writer: Writer, readers: Sequence[ShardReader], done: dict[tuple[str, str, int], int]) -> None:
    """Register the channels on which nothing was recorded, so that the file says that they were there."""
    for reader in readers:
        for key in reader.channels.keys.values():
            if key not in done:
                done[key] = _register(writer, reader.channels, Entry(*key, 0, 0, b""))
