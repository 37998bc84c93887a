"""Zenoh as the runtime uses it: one session a process, blocking puts, and one queue that one thread drains.

The launcher holds the router; operators are clients. What keeps Zenoh from losing messages silently: BLOCK instead of
DROP, a lease and a wait_before_close longer than any stall that we tolerate, and one priority for all, so that data
is never overtaken by the mark that announces it. Its own shared memory stays off: large payloads lie in a ring.
"""

from __future__ import annotations

import socket
import struct
from types import TracebackType
from typing import Self

import msgspec
import zenoh

from graph.inbox import INLINE, Inbox, Sample
from graph.ring import RingReader

STALL = 30  # seconds that a stuck reader may take before its transport is closed

_ENVELOPE = struct.Struct("<IQqqI")  # incarnation, sequence, stamp; place in the ring and length


def free_port(host: str = "127.0.0.1") -> int:
    """Ask the system for a free TCP port."""
    with socket.socket() as listener:
        listener.bind((host, 0))
        return int(listener.getsockname()[1])


def _configuration(mode: str, endpoint: str) -> zenoh.Config:
    config = zenoh.Config()
    settings = {
        "mode": f'"{mode}"',
        "scouting/multicast/enabled": "false",
        "scouting/gossip/enabled": "false",
        ("listen" if mode == "router" else "connect") + "/endpoints": f'["{endpoint}"]',
        "transport/shared_memory/enabled": "false",  # it takes longer, and a process that begins can clear it away
        "transport/link/tx/lease": str(STALL * 1000),
        "transport/link/tx/queue/congestion_control/block/wait_before_close": str(STALL * 1_000_000),
    }
    if mode == "client":
        settings["connect/timeout_ms"] = "5000"
        settings["connect/exit_on_failure"] = "true"
    for key, value in settings.items():
        config.insert_json5(key, value)
    return config


class Wire:
    """A session: puts under a run's prefix, and everything subscribed to in one queue."""

    def __init__(
        self, endpoint: str, prefix: str, *, router: bool = False, bell: tuple[int, int] | None = None
    ) -> None:
        self.session = zenoh.open(_configuration("router" if router else "client", endpoint))
        self.prefix = prefix
        self.inbox = Inbox(bell)
        self.publishers: dict[str, zenoh.Publisher] = {}
        self.tokens: list[zenoh.LivelinessToken] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the session; without it Zenoh's threads keep the process alive."""
        self.session.close()  # type: ignore[no-untyped-call]
        self.inbox.bell.close()

    def _receiver(self, key: str, copying: RingReader | None = None) -> zenoh.handlers.Callback[zenoh.Sample]:
        """Return a handler; it runs in a thread of Zenoh, so it does little. A key without wildcards is known ahead."""
        known = None if "*" in key else key
        skip, put = len(self.prefix) + 1, self.inbox.put

        def receive(sample: zenoh.Sample) -> None:
            envelope, mark, place, length = (0, 0, 0), b"", INLINE, 0
            if (attachment := sample.attachment) is not None:
                raw = attachment.to_bytes()
                incarnation, sequence, stamp, place, length = _ENVELOPE.unpack_from(raw)
                envelope = incarnation, sequence, stamp
                mark = raw[_ENVELOPE.size :]
            name = known or str(sample.key_expr)[skip:]
            payload: bytes | memoryview = sample.payload.to_bytes() if place == INLINE else b""
            if place != INLINE and copying is not None:
                payload, place = copying.read(place, length), INLINE
            put(Sample(name, payload, envelope, sample.kind == zenoh.SampleKind.PUT, mark, place, length))

        return zenoh.handlers.Callback(receive, indirect=False)

    def subscribe(self, key: str, ring: RingReader | None = None) -> None:
        """Let everything put under a key (wildcards allowed) come into the inbox, large payloads from the ring."""
        if ring is not None and not ring.copy:
            self.inbox.expect(key, ring)
            ring = None  # it is read where the inbox is emptied, and at once where that may take long
        self.session.declare_subscriber(f"{self.prefix}/{key}", self._receiver(key, ring))

    def watch(self, key: str) -> None:
        """Let liveliness tokens, present and future, come into the inbox."""
        self.session.liveliness().declare_subscriber(f"{self.prefix}/{key}", self._receiver(key), history=True)

    def declare_ready(self, name: str) -> None:
        """Raise the liveliness token that the readiness barrier waits for."""
        self.tokens.append(self.session.liveliness().declare_token(f"{self.prefix}/ready/{name}"))

    def announce(self, key: str) -> None:
        """Declare a publisher ahead of its first put."""
        self.publishers[key] = self.session.declare_publisher(
            f"{self.prefix}/{key}",
            congestion_control=zenoh.CongestionControl.BLOCK,
            priority=zenoh.Priority.DATA,
            express=True,
        )

    def put(
        self,
        key: str,
        payload: bytes | memoryview,
        envelope: tuple[int, int, int] | None = None,
        mark: bytes = b"",
        place: int = INLINE,
    ) -> None:
        """Put bytes, or say where in the ring they lie; blocks while the way is full."""
        if key not in self.publishers:
            self.announce(key)
        attachment = None if envelope is None else _ENVELOPE.pack(*envelope, place, len(payload)) + mark
        self.publishers[key].put(payload if place == INLINE else b"", attachment=attachment)

    def tell(self, key: str, record: msgspec.Struct) -> None:
        """Put one of the runtime's own records."""
        self.put(key, msgspec.msgpack.encode(record))
