"""Packets of an HDL-32E: a sphere made of packets, real ones, and captures that are none."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from operators.scans import ScanError
from operators.scans.packets import BLOCKS, FIRING, HOUR, LASER, LASERS, PACKET, PacketScans
from operators.scans.scan import rings_fall

DATA = Path(__file__).parents[2] / "shared" / "data" / "mrpt_hdl32e" / "sample_velodyne_hdl32.pcap"
ANGLES = [-30.67, -9.33, -29.33, -8.00, -28.00, -6.67, -26.67, -5.33, -25.33, -4.00, -24.00, -2.67, -22.67, -1.33,
          -21.33, 0.00, -20.00, 1.33, -18.67, 2.67, -17.33, 4.00, -16.00, 5.33, -14.67, 6.67, -13.33, 8.00, -12.00,
          9.33, -10.67, 10.67]  # fmt: skip  # degrees, as the manual lists them
PER_TURN = 150  # packets, of 1800 blocks of 0.2 degrees


def packets(count, *, first=30_000, ticks=HOUR - 5000, product=0x21, mode=0x37):
    """A lidar in the middle of a sphere of 5 m: packet after packet."""
    table = np.zeros(count, PACKET)
    blocks = np.arange(count * BLOCKS).reshape(count, BLOCKS)
    table["blocks"]["flag"] = 0xEEFF
    table["blocks"]["azimuth"] = (first + 20 * blocks) % 36_000
    table["blocks"]["returns"]["range"] = 2500
    table["time"] = (ticks + np.round(np.arange(count) * BLOCKS * FIRING * 1e6).astype(np.int64)) % HOUR
    table["mode"], table["product"] = mode, product
    return table


def pcap(table, *, order="<", nano=False):
    magic = {("<", False): 0xA1B2C3D4, (">", False): 0xA1B2C3D4}.get((order, nano), 0xA1B23C4D)
    out = [struct.pack(f"{order}IHHiIII", magic, 2, 4, 0, 0, 65535, 1)]
    for n, packet in enumerate(table):
        payload = bytes(42) + packet.tobytes()
        out.append(struct.pack(f"{order}IIII", 1000, n * (1000 if nano else 1), len(payload), len(payload)) + payload)
        if n % 7 == 0:  # the sensor's position, which is of no use here
            out.append(struct.pack(f"{order}IIII", 1000, n, 554, 554) + bytes(554))
    return b"".join(out)


@pytest.mark.parametrize(("order", "nano"), [("<", False), (">", True)])
def test_a_sphere_is_seen_whole_revolution_by_revolution(tmp_path, order, nano):
    (tmp_path / "x.pcap").write_bytes(pcap(packets(3 * PER_TURN), order=order, nano=nano))
    scans = PacketScans(tmp_path / "x.pcap")
    assert len(scans.sweeps) == 2  # the cut ones at both ends are left out
    turn = 1800 * FIRING
    begin = (36_000 - 30_000) / 20 * FIRING
    for place, sweep in enumerate(scans.sweeps):
        assert sweep.stamp == pytest.approx(1000e9 + (begin + place * turn) * 1e9, abs=2e3)
    for scan in scans.read([0, 1]):
        assert len(scan.points) == 1800 * LASERS
        x, y, z = scan.points.T.astype(np.float64)
        assert np.allclose(np.sqrt(x * x + y * y + z * z), 5.0, atol=1e-5)
        elevation = np.degrees(np.arctan2(z, np.hypot(x, y))).reshape(1800, LASERS)
        assert np.allclose(elevation, ANGLES, atol=0.01)
        assert np.array_equal(scan.ring.reshape(1800, LASERS)[0], np.argsort(np.argsort(ANGLES)))
        assert rings_fall(scan) is False
        azimuth = np.degrees(-np.arctan2(y, x)).reshape(1800, LASERS) % 360.0
        wanted = np.arange(1800)[:, None] * 0.2 + 0.2 * LASER / FIRING * np.arange(LASERS)
        assert np.abs((azimuth - wanted + 180.0) % 360.0 - 180.0).max() < 1e-3
        times = scan.time_offset.reshape(1800, LASERS)
        assert times[0, 0] == 0.0
        assert np.allclose(np.diff(times[:, 0]), FIRING, atol=2e-6)  # packets are stamped to the microsecond
        assert np.allclose(np.diff(times[0]), LASER, atol=1e-8)


def test_lasers_without_a_return_give_no_point(tmp_path):
    table = packets(3 * PER_TURN)
    table["blocks"]["returns"]["range"][:, :, 5] = 0
    (tmp_path / "x.pcap").write_bytes(pcap(table))
    (scan,) = PacketScans(tmp_path / "x.pcap").read([1])
    assert len(scan.points) == 1800 * (LASERS - 1)
    assert len(np.unique(scan.ring)) == LASERS - 1


BROKEN = {
    "text": (b"hello, world", "no .pcap file"),
    "nothing": (b"", "no .pcap file"),
    "a cut packet": (pcap(packets(20))[:-7], r"byte \d+: the file ends amid a packet"),
    "a cut head": (pcap(packets(20))[: 24 + 9], "byte 24: the file ends amid a packet"),
    "no packets": (pcap(packets(0)), "no data packets"),
    "a VLP-16": (pcap(packets(20, product=0x22)), r"another lidar \(product 0x22\)"),
    "dual returns": (pcap(packets(20, mode=0x39)), "dual returns"),
    "half a turn": (pcap(packets(PER_TURN // 2)), "no whole revolution; it has 75 packets"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_capture_is_named_in_one_sentence(tmp_path, name):
    raw, sentence = BROKEN[name]
    (tmp_path / "x.pcap").write_bytes(raw)
    with pytest.raises(ScanError, match=sentence) as caught:
        PacketScans(tmp_path / "x.pcap")
    assert "x.pcap" in str(caught.value)


@pytest.mark.skipif(not DATA.is_file(), reason="wants ../shared/data")
def test_two_real_revolutions_show_one_street():
    scans = PacketScans(DATA)
    first, second = scans.read([0, 1])
    assert scans.sweeps[1].stamp - scans.sweeps[0].stamp == pytest.approx(0.1106e9, abs=1e5)
    assert len(first.points) > 50_000
    x, y, z = first.points.T
    street = (np.abs(y) < 3.0) & (np.hypot(x, y) > 3.5)
    heights = [np.percentile(z[street & (first.ring == ring)], 10) for ring in range(9)]
    assert np.ptp(heights) < 0.2  # nine beams from -30.7 to -20 degrees see one street
    assert -2.3 < np.mean(heights) < -2.0  # from the roof of a car
    distances = cKDTree(first.points).query(second.points[::50])[0]
    assert np.median(distances) < 0.1
    assert np.ptp(first.time_offset) == pytest.approx(0.1106, abs=2e-4)
