"""A shard: what one operator process emitted and did, written where it was born.

Unchunked MCAP, flushed after each call, so that a killed process loses at most the call it was in, and the one before
if that spoke at length and its messages are still on their way to their readers.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from pathlib import Path
from typing import IO

import msgspec
from mcap.opcode import Opcode
from mcap.writer import IndexType, Writer

from graph.codec import schema, type_name
from graph.contract import Summary
from graph.ledger import Step
from graph.node import Emission
from graph.wiring import NodeSpec

STEP, SUMMARY = "step", "summary"  # topics beside an operator's own ports: operator/step, operator/summary

MUCH = 1 << 18  # bytes that take longer to write than a message takes to travel

LEDGER_SCHEMA = "retracer.Step"
SUMMARY_SCHEMA = "retracer.Summary"

_RECORD = struct.Struct("<BQHIQQ")  # opcode, length of the rest; channel, sequence, log time, publish time
_FIELDS = _RECORD.size - 9  # bytes of the rest before the data


Schemas = dict[str, tuple[str, str]]


def schemas_of(types: dict[str, type[msgspec.Struct]]) -> Schemas:
    """Describe the message types of ports for a shard: port to (name, JSON Schema)."""
    return {port: (type_name(kind), schema(kind)) for port, kind in types.items()}


def ledger_schema() -> bytes:
    """Return the JSON Schema of a step, as it stands in recordings."""
    return schema(Step).encode()


class Shard:
    """Writes one operator's shard.

    path: the file, which must not exist. schemas: output port to (name, JSON Schema) of its message type.
    """

    def __init__(self, path: Path, spec: NodeSpec, schemas: Schemas, incarnation: int = 0) -> None:
        self.spec = spec
        self.stream: IO[bytes] = path.open("xb", buffering=1 << 20)
        self.writer = Writer(
            self.stream, use_chunking=False, index_types=IndexType.NONE, enable_crcs=False, use_statistics=False
        )
        self.writer.start(profile="retracer-shard", library="retracer")
        mine = {"operator": spec.name, "incarnation": str(incarnation)}
        self.channels: dict[str, int] = {}
        self.held: tuple[list[Emission], Step, Summary | dict[str, object] | None] | None = None
        for port, (name, text) in schemas.items():
            number = self.writer.register_schema(name, "jsonschema", text.encode())
            self.channels[port] = self.writer.register_channel(f"{spec.name}/{port}", "msgpack", number, mine)
        number = self.writer.register_schema(LEDGER_SCHEMA, "jsonschema", ledger_schema())
        self.channels[STEP] = self.writer.register_channel(f"{spec.name}/{STEP}", "msgpack", number, mine)
        number = self.writer.register_schema(SUMMARY_SCHEMA, "jsonschema", b'{"type": "object"}')
        self.channels[SUMMARY] = self.writer.register_channel(f"{spec.name}/{SUMMARY}", "msgpack", number, mine)
        self.writer.add_metadata("retracer.shard", mine)  # the writer holds schemas and channels back until this
        self.stream.flush()

    def hold(self, emissions: list[Emission], step: Step, summary: Summary | dict[str, object] | None = None) -> None:
        """Write what a call said and did, at once if that is little, else when `settle` is called."""
        self.settle()
        self.held = emissions, step, summary
        if sum(len(emission.payload) for emission in emissions) < MUCH:
            self.settle()

    def settle(self) -> None:
        """Write what is held back."""
        if self.held is not None:
            held, self.held = self.held, None
            self.write(*held)

    def write(
        self, emissions: Iterable[Emission], step: Step, summary: Summary | dict[str, object] | None = None
    ) -> None:
        """Append the messages of one call, then its step; flushed when this returns."""
        self._messages(emissions)
        if summary is not None:
            self._add(SUMMARY, step.stamp, 0, msgspec.msgpack.encode(summary))
        self._add(STEP, step.stamp, step.index, msgspec.msgpack.encode(step))
        self.stream.flush()

    def leave(self, emissions: Iterable[Emission]) -> None:
        """Append messages alone: those of a call that failed after it had spoken."""
        self.settle()
        self._messages(emissions)
        self.stream.flush()

    def _messages(self, emissions: Iterable[Emission]) -> None:
        for emission in emissions:
            if self.spec.record[emission.port] == "full":
                self._add(emission.port, emission.stamp, emission.sequence, emission.payload)

    def _add(self, port: str, stamp: int, sequence: int, data: bytes | memoryview) -> None:
        # what Writer.add_message writes, without its two copies of the data
        length = _FIELDS + len(data)
        self.stream.write(_RECORD.pack(Opcode.MESSAGE, length, self.channels[port], sequence, stamp, stamp))
        self.stream.write(data)

    def close(self) -> None:
        """Write what is left and the footer."""
        self.settle()
        self.writer.finish()  # type: ignore[no-untyped-call]
        self.stream.close()
