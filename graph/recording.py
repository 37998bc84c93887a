"""Recordings: MCAP files with the exact bytes of every message, the ledger of every operator, and the graph."""

from __future__ import annotations

import functools
import io
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, NamedTuple, TypeVar

import msgspec
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    McapRecord,
    Message,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import StreamReader, breakup_chunk

from graph.codec import digest
from graph.errors import UserError
from graph.graphfile import Graph, from_dict
from graph.ledger import Step
from graph.shard import LEDGER_SCHEMA, STEP, SUMMARY, ledger_schema
from graph.wiring import NodeSpec

MAGIC = b"\x89MCAP0\r\n"
PROFILE = "retracer"
RUN, VERDICT = "retracer.run", "retracer.verdict"  # metadata records: written first, and written last
FORMAT = 1

_FOOTER_BYTES = 1 + 8 + 20 + len(MAGIC)

Record = TypeVar("Record", bound=McapRecord)

_step_decoder = msgspec.msgpack.Decoder(Step)


class RecordingError(UserError):
    """A file that is no recording, is damaged, or is of another time."""


class Entry(NamedTuple):
    """One message of a recording, of an operator's port, its ledger (`step`) or its `summary`."""

    operator: str
    port: str
    incarnation: int
    sequence: int
    stamp: int
    payload: bytes

    @property
    def topic(self) -> str:
        return f"{self.operator}/{self.port}"

    def step(self) -> Step:
        """Decode a ledger entry. Raises RecordingError if it is none."""
        try:
            return _step_decoder.decode(self.payload)
        except msgspec.MsgspecError as error:
            raise RecordingError(f"{self.topic} number {self.sequence} is no step of a ledger: {error}") from error


class Run(msgspec.Struct):
    """What was known when the run started."""

    graph: dict[str, Any]
    specs: tuple[NodeSpec, ...]  # the same, resolved: readable where the operators' classes are not
    versions: dict[str, str]
    cpu: str
    files: dict[str, str]  # path as the config names it: SHA-256
    started: str = ""  # wall-clock time, ISO 8601
    command: str = ""
    format: int = FORMAT


class _Format(msgspec.Struct):
    """What any version of a metadata record can be asked for."""

    format: int = FORMAT


class EdgeAccount(msgspec.Struct):
    """emitted * ports = consumed + skipped + later + lost, on the edge from a topic to an operator."""

    topic: str
    operator: str
    emitted: int
    consumed: int
    skipped: int
    later: int  # would have arrived after the end
    lost: int


class Verdict(msgspec.Struct):
    """What was known when the run was over."""

    verdict: str  # COMPLETE or INCOMPLETE
    reasons: list[str]
    end: int  # stamp, nanoseconds
    wall_seconds: float
    accounts: list[EdgeAccount]
    messages: int


class _Exact:
    """A stream whose short reads are an end of file, not half a record."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._inner = stream

    def read(self, size: int = -1) -> bytes:
        data = self._inner.read(size)
        return data if len(data) == size else b""


def read_records(stream: IO[bytes]) -> Iterator[McapRecord]:
    """Iterate over the records of a shard, which has no chunks. Raises what is wrong where it is wrong."""
    reader = StreamReader(_Exact(stream), skip_magic=True, record_size_limit=2 << 30)  # type: ignore[arg-type]
    if stream.read(len(MAGIC)) != MAGIC:
        raise RecordingError("it does not begin as an MCAP file does")
    yield from reader.records


def _record_at(stream: IO[bytes], place: int, kind: type[Record]) -> Record:
    """Read the record at a place that the index names. Raises ValueError if another kind of record stands there."""
    stream.seek(place)
    opcode = stream.read(1)
    stream.seek(place)
    reader = StreamReader(_Exact(stream), skip_magic=True, emit_chunks=True)  # type: ignore[arg-type]
    record = next(iter(reader.records)) if opcode == bytes([Opcode[kind.__name__.upper()]]) else None
    if not isinstance(record, kind):
        raise ValueError(f"at byte {place} stands no {kind.__name__}")
    return record


def seal(record: msgspec.Struct) -> dict[str, str]:
    """Make a metadata record of a struct, with its digest, since MCAP puts no checksum on metadata."""
    text = msgspec.json.encode(record)
    return {"json": text.decode(), "digest": digest(text).hex()}


def unseal(metadata: dict[str, str], kind: type[Any], name: str) -> Any:
    """Read a struct back. Raises RecordingError if a byte of it has changed, or a field is not of this version."""
    text = metadata.get("json", "").encode()
    if metadata.get("digest") != digest(text).hex():
        raise RecordingError(f"its {name} record is damaged: the digest does not fit")
    try:
        version = msgspec.json.decode(text, type=_Format).format
        if version != FORMAT:
            raise RecordingError(f"it is of recording format {version}; this version of retracer reads format {FORMAT}")
        return msgspec.json.decode(text, type=kind)
    except msgspec.MsgspecError as error:
        raise RecordingError(f"its {name} record does not fit this version of retracer: {error}") from error


class Channels:
    """Schemas and channels met so far in one file: channel id to (operator, port, incarnation)."""

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.types: dict[str, tuple[str, str]] = {}  # topic: (type name, JSON Schema)
        self.keys: dict[int, tuple[str, str, int]] = {}

    def take(self, record: McapRecord) -> None:
        """Note a schema or a channel; other records are ignored."""
        if isinstance(record, Schema):
            self.schemas[record.id] = record
        elif isinstance(record, Channel):
            schema = self.schemas.get(record.schema_id)
            if schema is None or "/" not in record.topic or "operator" not in record.metadata:
                raise RecordingError(f"its channel {record.topic!r} is none of retracer's")
            _, _, port = record.topic.partition("/")
            self.keys[record.id] = (record.metadata["operator"], port, int(record.metadata["incarnation"]))
            self.types[record.topic] = (schema.name, schema.data.decode())

    def entry(self, message: Message) -> Entry:
        """Name the operator and port of a message."""
        operator, port, incarnation = self.keys[message.channel_id]
        return Entry(operator, port, incarnation, message.sequence, message.log_time, message.data)


def _complaint(path: Path, error: Exception) -> RecordingError:
    if isinstance(error, EndOfFile):
        return RecordingError(f"{path} is cut short; `retracer recover {path} -o FILE` brings back what is whole")
    text = str(error) or type(error).__name__
    return RecordingError(f"{path} is damaged: {text}; `retracer recover {path} -o FILE` brings back what is whole")


class Recording:
    """A recording on disk. Opening it reads only its index; messages stream from the file in the order of the merge.

    Raises RecordingError, in one sentence, for a file that is missing, empty, not MCAP, not retracer's, cut or damaged.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if not self.path.exists():
            raise RecordingError(f"{self.path}: no such recording")
        if self.path.is_dir():
            raise RecordingError(f"{self.path} is a folder; a recording is an .mcap file")
        size = self.path.stat().st_size
        with self.path.open("rb") as stream:
            head = stream.read(len(MAGIC))
            if size == 0:
                raise RecordingError(f"{self.path} is empty; a recording is an MCAP file")
            if head != MAGIC:
                raise RecordingError(f"{self.path} is not an MCAP file: it does not begin as one does")
            self._read_index(stream, size)
        for name in (RUN, VERDICT):
            if name not in self.metadata:
                raise RecordingError(f"{self.path} is an MCAP file, but not a recording of retracer: no {name} record")
        try:
            self.run: Run = unseal(self.metadata[RUN], Run, RUN)
            self.verdict: Verdict = unseal(self.metadata[VERDICT], Verdict, VERDICT)
        except RecordingError as error:
            raise RecordingError(f"{self.path}: {error}") from None
        self.require_ledger()

    def _read_index(self, stream: IO[bytes], size: int) -> None:
        """Read what is where, and the metadata, by the summary section, whose CRC must be right."""
        stream.seek(max(0, size - _FOOTER_BYTES))
        tail = stream.read(_FOOTER_BYTES)
        if size < _FOOTER_BYTES + len(MAGIC) or not tail.endswith(MAGIC) or tail[0] != 2:
            raise _complaint(self.path, EndOfFile())
        start, _, crc = struct.unpack("<QQI", tail[9:29])
        if not len(MAGIC) <= start <= size - _FOOTER_BYTES:
            raise _complaint(self.path, ValueError("its footer points nowhere"))
        stream.seek(start)
        summary = stream.read(size - start - _FOOTER_BYTES)
        if zlib.crc32(summary + tail[: 9 + 16]) != crc:
            raise _complaint(self.path, ValueError("the checksum of its index does not fit"))
        self.channels = Channels()
        self.types = self.channels.types  # topic: (type name, JSON Schema)
        self.counts: dict[str, int] = {}  # topic: messages
        self.metadata: dict[str, dict[str, str]] = {}
        self._chunks: list[int] = []
        self._attachments: list[tuple[int, int]] = []
        topics: dict[int, str] = {}
        try:
            reader = StreamReader(io.BytesIO(summary + tail), skip_magic=True)
            for record in reader.records:
                if isinstance(record, Channel) and "operator" not in record.metadata:
                    continue
                self.channels.take(record)
                if isinstance(record, Channel):
                    topics[record.id] = record.topic
                elif isinstance(record, ChunkIndex):
                    self._chunks.append(record.chunk_start_offset)
                elif isinstance(record, AttachmentIndex):
                    self._attachments.append((record.offset, record.length))
                elif isinstance(record, MetadataIndex):
                    place = _record_at(stream, record.offset, Metadata)
                    self.metadata[place.name] = place.metadata
                elif isinstance(record, Statistics):
                    for channel, count in record.channel_message_counts.items():
                        if channel in topics:
                            self.counts[topics[channel]] = self.counts.get(topics[channel], 0) + count
        except RecordingError:
            raise
        except Exception as error:
            raise _complaint(self.path, error) from error
        self._chunks.sort()

    @functools.cached_property
    def graph(self) -> Graph:
        """Return the resolved graph that ran."""
        return from_dict(self.run.graph)

    def entries(self) -> Iterator[Entry]:
        """Iterate over every message, step and summary, ordered by (stamp, operator, port, sequence).

        Raises RecordingError where the file is damaged.
        """
        with self.path.open("rb") as stream:
            for place in self._chunks:
                try:
                    records = breakup_chunk(_record_at(stream, place, Chunk), validate_crc=True)
                    found = [self.channels.entry(record) for record in records if isinstance(record, Message)]
                except Exception as error:
                    raise _complaint(self.path, error) from error
                yield from found

    def messages(self, *topics: str) -> Iterator[Entry]:
        """Iterate over the messages of some topics (`operator/port`), or of all ports if none is named."""
        for entry in self.entries():
            if entry.port not in (STEP, SUMMARY) and (not topics or entry.topic in topics):
                yield entry

    def steps(self, *operators: str) -> Iterator[tuple[str, int, Step]]:
        """Iterate over the ledger: (operator, incarnation, step)."""
        for entry in self.entries():
            if entry.port == STEP and (not operators or entry.operator in operators):
                yield entry.operator, entry.incarnation, entry.step()

    def summaries(self) -> dict[str, dict[str, Any]]:
        """Return what each operator said at the end: operator to name to number."""
        return {
            entry.operator: msgspec.msgpack.decode(entry.payload) for entry in self.entries() if entry.port == SUMMARY
        }

    def attachments(self) -> Iterator[Attachment]:
        """Iterate over the attachments: the log of each operator."""
        with self.path.open("rb") as stream:
            for place, length in self._attachments:
                try:
                    record = _record_at(stream, place, Attachment)
                    stream.seek(place + 9)
                    content = stream.read(length - 9)
                    if zlib.crc32(content[:-4]) != int.from_bytes(content[-4:], "little"):
                        raise ValueError(f"the checksum of {record.name} does not fit")
                except Exception as error:
                    raise _complaint(self.path, error) from error
                yield record

    def require_ledger(self) -> None:
        """Raise RecordingError if the ledger is of another version."""
        for topic, (name, text) in self.types.items():
            if topic.endswith(f"/{STEP}") and (name != LEDGER_SCHEMA or text.encode() != ledger_schema()):
                raise RecordingError(f"{self.path}: its ledger is of another version of retracer")
