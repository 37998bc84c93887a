"""Packets of a Velodyne HDL-32E as a .pcap file of its network traffic, split into revolutions."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from operators.scans.folder import Scans, Sweep
from operators.scans.scan import Scan, ScanError

# Layout and angles: Velodyne, HDL-32E User's Manual, appendix on the data packet.
PAYLOAD = 1206  # bytes of a data packet
BLOCKS, LASERS = 12, 32  # a packet
RETURN = [("range", "<u2"), ("light", "u1")]
PACKET = np.dtype(
    [
        ("blocks", [("flag", "<u2"), ("azimuth", "<u2"), ("returns", RETURN, LASERS)], BLOCKS),
        ("time", "<u4"),  # us since the hour
        ("mode", "u1"),
        ("product", "u1"),
    ]
)  # fmt: skip
FLAG = 0xEEFF
HDL32E, DUAL_RETURN = 0x21, 0x39
UNIT = 0.002  # metres
TURN = 36_000  # hundredths of a degree
HOUR = 3_600_000_000  # us
FIRING, LASER = 46.08e-6, 1.152e-6  # seconds between two blocks, and between two lasers of one

STEP = np.radians(4.0 / 3.0)
# The lasers fire in the order -30.67, -9.33, -29.33, -8.00, ... degrees: the lower and the upper half in turns.
RING = np.arange(LASERS).reshape(2, LASERS // 2).T.reshape(-1)  # (lasers,) from the lowest beam
ELEVATION = (RING - 23) * STEP  # (lasers,) radians; beam 23 is level

MAGICS = {b"\xd4\xc3\xb2\xa1": ("<", 1), b"\xa1\xb2\xc3\xd4": (">", 1),
          b"\x4d\x3c\xb2\xa1": ("<", 1000), b"\xa1\xb2\x3c\x4d": (">", 1000)}  # fmt: skip


class Capture(NamedTuple):
    """The data packets of a .pcap file."""

    packets: npt.NDArray[np.void]  # (n,) PACKET
    start: int  # ns since 1970: when the first was captured


def read_pcap(path: Path) -> Capture:
    """Read the HDL-32E data packets of a .pcap file. Raises ScanError with the byte."""
    raw = path.read_bytes()
    if raw[:4] not in MAGICS:
        raise ScanError(f"{path} is no .pcap file: it does not begin as one (pcapng must be converted)")
    order, divisor = MAGICS[raw[:4]]
    header = struct.Struct(f"{order}IIII")
    payloads: list[bytes] = []
    at, start = 24, 0
    while at < len(raw):
        if at + header.size > len(raw):
            raise ScanError(f"{path} byte {at}: the file ends amid a packet")
        seconds, fraction, size, _ = header.unpack_from(raw, at)
        end = at + header.size + size
        if end > len(raw):
            raise ScanError(f"{path} byte {at}: the file ends amid a packet")
        payload = raw[max(end - PAYLOAD, at + header.size) : end]
        if len(payload) == PAYLOAD and payload[:2] == b"\xff\xee":
            if not payloads:
                start = seconds * 1_000_000_000 + fraction * 1000 // divisor
            payloads.append(payload)
        at = end
    packets = np.frombuffer(b"".join(payloads), PACKET)
    if not len(packets):
        raise ScanError(f"{path} holds no data packets of a Velodyne lidar")
    if not (packets["blocks"]["flag"] == FLAG).all() or not (packets["product"] == HDL32E).all():
        products = ", ".join(f"0x{product:02x}" for product in np.unique(packets["product"]))
        raise ScanError(f"{path} holds packets of another lidar (product {products}); only the HDL-32E can be read")
    if (packets["mode"] == DUAL_RETURN).any():
        raise ScanError(f"{path} holds dual returns; only strongest or last returns can be read")
    return Capture(packets, start)


class PacketScans(Scans):
    """The whole revolutions of a capture, each stamped at its first firing; the cut ones at both ends are left out.

    Azimuth 0 is x, clockwise seen from above as the sensor counts; rings from the lowest beam. Raises ScanError if
    there is no whole revolution.
    """

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        packets, start = read_pcap(path)
        ticks = packets["time"].astype(np.int64)
        ticks = ticks[0] + np.concatenate([[0], np.cumsum(np.diff(ticks) % HOUR)])
        blocks = packets["blocks"].reshape(-1)
        self.azimuth = blocks["azimuth"].astype(np.int64)  # (blocks,)
        self.ranges = blocks["returns"]["range"]  # (blocks, lasers)
        self.micros = np.repeat(ticks - ticks[0], BLOCKS) + np.tile(np.arange(BLOCKS) * FIRING * 1e6, len(ticks))
        cuts = 1 + np.flatnonzero(np.diff(self.azimuth) < -TURN // 2)
        self.turns = list(zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True))
        if not self.turns:
            raise ScanError(f"{path} holds no whole revolution; it has {len(packets)} packets")
        self.sweeps = [
            Sweep(f"revolution {place}", start + round(float(self.micros[first]) * 1000))
            for place, (first, _) in enumerate(self.turns)
        ]

    def read(self, wanted: Sequence[int]) -> Iterator[Scan]:
        """Yield the revolutions at some places in `sweeps`."""
        for place in wanted:
            yield self._revolution(*self.turns[place])

    def _revolution(self, first: int, last: int) -> Scan:
        step = np.median(np.diff(self.azimuth[first:last]))  # to the next block; the mean would feel lost packets
        azimuth = self.azimuth[first:last, None] + step * np.arange(LASERS) * (LASER / FIRING)
        turn = np.radians(azimuth * 0.01)  # (blocks, lasers)
        seconds = (self.micros[first:last, None] - self.micros[first]) * 1e-6 + np.arange(LASERS) * LASER
        hit = self.ranges[first:last] > 0
        distance = (self.ranges[first:last] * UNIT)[hit]
        elevation = np.broadcast_to(ELEVATION, hit.shape)[hit]
        level, turn = distance * np.cos(elevation), turn[hit]
        points = np.stack([level * np.cos(turn), -level * np.sin(turn), distance * np.sin(elevation)], axis=1)
        ring = np.broadcast_to(RING, hit.shape)[hit]
        return Scan(points.astype(np.float32), ring.astype(np.uint8), seconds[hit].astype(np.float32))
