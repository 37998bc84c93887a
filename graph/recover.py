"""What a crash left: a folder of shards, or a recording that is cut or damaged; every whole chunk comes back."""

from __future__ import annotations

import io
import mmap
import tempfile
from collections.abc import Iterator
from pathlib import Path

import msgspec
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk
from mcap.writer import Writer

from graph.merge import merge
from graph.recording import MAGIC, RUN, VERDICT, Channels, RecordingError, Run, Verdict, unseal
from graph.run import run_of


class Recovery(msgspec.Struct):
    """What was brought back, and what was lost."""

    verdict: Verdict
    messages: int
    chunks: int
    lost: list[str]


def recover(source: Path, out: Path) -> Recovery:
    """Rebuild a recording from a folder of shards or from a damaged recording.

    Raises RecordingError if there is nothing to rebuild from, or if `out` exists.
    """
    if out.exists():
        raise RecordingError(f"{out} exists already; name another file")
    if not source.exists():
        raise RecordingError(f"{source}: no such file or folder")
    if source.is_dir():
        shards = sorted(source.glob("*.mcap"))
        if not shards:
            raise RecordingError(f"{source} holds no shards")
        verdict = merge(
            shards,
            out,
            run_of(source),
            reasons=["the launcher was killed; the shards were merged by recover"],
            crashed=True,
            logs=sorted(source.glob("*.log")),
        )
        return Recovery(verdict, verdict.messages, 0, verdict.reasons[1:])
    return _recover_file(source, out)


def _recover_file(source: Path, out: Path) -> Recovery:
    """Split what is readable of a damaged recording into shards again, and merge them."""
    if source.stat().st_size == 0:
        raise RecordingError(f"{source} is empty: there is nothing to recover")
    with source.open("rb") as stream:
        data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
    scan = _Scan(data)
    if data[: len(MAGIC)] != MAGIC and scan.chunk_from(0) == len(data):
        raise RecordingError(f"{source} is not an MCAP file: it does not begin as one does, and holds no chunk")
    with tempfile.TemporaryDirectory(dir=out.parent) as folder:
        shards = scan.split(Path(folder))
        if scan.run is None:
            raise RecordingError(f"{source}: its {RUN} record is gone, and with it the graph; nothing can be recovered")
        if not shards:
            raise RecordingError(f"{source}: not one whole chunk is left")
        was = scan.verdict
        if scan.lost or was is None:
            verdict = merge(shards, out, scan.run, reasons=["recovered from a damaged file", *scan.lost])
        else:
            verdict = merge(shards, out, scan.run, reasons=was.reasons, wall_seconds=was.wall_seconds)
    return Recovery(verdict, verdict.messages, scan.chunks, scan.lost)


class _Scan:
    """Walks over the records of damaged MCAP bytes; what is not whole is noted and left out."""

    def __init__(self, data: mmap.mmap) -> None:
        self.file, self.data = data, memoryview(data)
        self.run: Run | None = None
        self.verdict: Verdict | None = None
        self.chunks = 0
        self.lost: list[str] = []
        self.channels = Channels()
        self.writers: dict[tuple[str, int], Writer] = {}
        self.ids: dict[tuple[str, int, str], int] = {}

    def records(self) -> Iterator[tuple[int, int, memoryview]]:
        """Iterate over (place, opcode, content); where a record makes no sense, go on at the next chunk that does."""
        place = len(MAGIC)
        chunk = self.chunk_from(place)
        while place + 9 <= len(self.data):
            opcode, end = self.data[place], place + 9 + self._number(place + 1)
            if chunk < place:
                chunk = self.chunk_from(place)
            sound = place == chunk if opcode == Opcode.CHUNK else 1 <= opcode <= Opcode.DATA_END and end <= chunk
            if not sound:
                self.lost.append(f"{chunk - place} bytes from byte {place} on make no record")
                place = chunk
                continue
            yield place, opcode, self.data[place + 9 : end]
            if opcode == Opcode.FOOTER:
                return
            place = end
        self.lost.append("the file ends without an index")

    def chunk_from(self, place: int) -> int:
        """Return where the next chunk begins whose lengths fit each other; the end of the file if there is none."""
        head = 1 + 8 + 28  # opcode, length, two stamps, size, checksum; then the compression by name, and a length
        while (name := self.file.find(b"\x04\x00\x00\x00zstd", place + head)) >= 0:
            start, rest = name - head, self._number(name + 8)
            fits = self._number(start + 1) == 28 + 8 + 8 + rest and name + 16 + rest <= len(self.data)
            if self.data[start] == Opcode.CHUNK and fits:
                return start
            place = start + 1
        return len(self.data)

    def _number(self, place: int) -> int:
        return int.from_bytes(self.data[place : place + 8], "little")

    def _read_index(self) -> None:
        """Take schemas and channels from the index at the end, if it is left: a lost chunk may have held them."""
        for _, opcode, content in self.records():
            try:
                if opcode == Opcode.SCHEMA:
                    self.channels.take(Schema.read(_stream(content)))
                elif opcode == Opcode.CHANNEL:
                    self.channels.take(Channel.read(_stream(content)))
            except Exception:  # any byte may have changed; the chunks say it again
                continue
        self.lost.clear()

    def split(self, folder: Path) -> list[Path]:
        """Write one shard an operator; returns their paths."""
        streams = []
        paths: list[Path] = []
        self._read_index()
        for place, opcode, content in self.records():
            if opcode == Opcode.METADATA:
                self._metadata(place, content)
            elif opcode == Opcode.CHUNK:
                for entry_channel, message in self._chunk(place, content):
                    operator, port, incarnation = entry_channel
                    if (operator, incarnation) not in self.writers:
                        paths.append(folder / f"{operator}.{incarnation}.mcap")
                        streams.append(paths[-1].open("wb"))
                        self.writers[operator, incarnation] = writer = Writer(streams[-1], use_chunking=False)
                        writer.start(profile="retracer-shard", library="retracer")
                    self._copy(operator, port, incarnation, message)
        for writer in self.writers.values():
            writer.finish()  # type: ignore[no-untyped-call]
        for stream in streams:
            stream.close()
        return paths

    def _copy(self, operator: str, port: str, incarnation: int, message: Message) -> None:
        writer, key = self.writers[operator, incarnation], (operator, incarnation, port)
        if key not in self.ids:
            name, text = self.channels.types[f"{operator}/{port}"]
            schema = writer.register_schema(name, "jsonschema", text.encode())
            mine = {"operator": operator, "incarnation": str(incarnation)}
            self.ids[key] = writer.register_channel(f"{operator}/{port}", "msgpack", schema, mine)
        writer.add_message(self.ids[key], message.log_time, message.data, message.publish_time, message.sequence)

    def _metadata(self, place: int, content: memoryview) -> None:
        try:
            record = Metadata.read(_stream(content))
            if record.name == RUN:
                self.run = unseal(record.metadata, Run, RUN)
            elif record.name == VERDICT:
                self.verdict = unseal(record.metadata, Verdict, VERDICT)
        except Exception as error:  # any byte may have changed
            self.lost.append(f"the metadata at byte {place}: {error}")

    def _chunk(self, place: int, content: memoryview) -> Iterator[tuple[tuple[str, str, int], Message]]:
        try:
            records = breakup_chunk(Chunk.read(_stream(content)), validate_crc=True)
        except Exception as error:  # any byte may have changed
            self.lost.append(f"the chunk at byte {place} ({len(content)} bytes): {error or type(error).__name__}")
            return
        self.chunks += 1
        for record in records:
            if isinstance(record, (Schema, Channel)):
                self.channels.take(record)
            elif isinstance(record, Message):
                if record.channel_id not in self.channels.keys:
                    self.lost.append(f"a message in the chunk at byte {place}: its channel stood in a lost chunk")
                    continue
                yield self.channels.keys[record.channel_id], record


def _stream(content: memoryview) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(content))
