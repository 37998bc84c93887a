"""Scan files: what was written comes back, other programs' files are read, and broken ones are named in a sentence."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from graph.geometry import planar, transform
from operators.scans import Scan, ScanError, read_scan
from operators.scans.folder import FolderScans, scan_files
from operators.scans.lzf import decompress
from operators.scans.scan import clean, rings_fall, scan_of, turned

DATA = Path(__file__).parents[2] / "shared" / "data"
COUNT = 40


def example(count=COUNT):
    random = np.random.default_rng(3)
    points = random.normal(0, 5, (count, 3)).astype(np.float32)
    ring = random.integers(0, 32, count).astype(np.uint16)
    time = np.linspace(0, 0.1, count).astype(np.float32)
    return points, ring, time


def twin(packed):
    """LZF in plain Python."""
    out, read = bytearray(), 0
    while read < len(packed):
        control, read = packed[read], read + 1
        if control < 32:
            out += packed[read : read + control + 1]
            read += control + 1
            continue
        length = control >> 5
        if length == 7:
            length, read = length + packed[read], read + 1
        start = len(out) - ((control & 31) << 8) - packed[read] - 1
        read += 1
        for place in range(start, start + length + 2):
            out.append(out[place])
    return bytes(out)


def compress(data):
    """LZF as a compressor writes it: references to the last place where three bytes stood, literals between."""
    out, literals, seen, at = bytearray(), bytearray(), {}, 0

    def flush():
        for start in range(0, len(literals), 32):
            run = literals[start : start + 32]
            out.extend([len(run) - 1, *run])
        literals.clear()

    while at < len(data):
        key = data[at : at + 3]
        back = at - seen.get(key, -1) - 1
        if len(key) == 3 and key in seen and back < 8192:
            length = 3
            while length < 264 and at + length < len(data) and data[at + length] == data[at - back - 1 + length]:
                length += 1
            flush()
            short = min(length - 2, 7)
            out.append(short << 5 | back >> 8)
            if short == 7:
                out.append(length - 2 - 7)
            out.append(back & 255)
        else:
            length = 1
            literals.append(data[at])
        for place in range(at, at + length):
            seen[data[place : place + 3]] = place
        at += length
    flush()
    return bytes(out)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.binary(min_size=1, max_size=5), st.integers(1, 300)), max_size=8))
def test_lzf_undoes_the_compressor_as_its_plain_twin_does(parts):
    data = b"".join(part * times for part, times in parts)
    packed = compress(data)
    out = np.zeros(len(data), np.uint8)
    assert decompress(np.frombuffer(packed, np.uint8), out) == len(data)
    assert out.tobytes() == data == twin(packed)


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=60), st.integers(0, 200))
def test_lzf_never_writes_beyond_its_end_whatever_it_reads(packed, size):
    out = np.full(size + 8, 77, np.uint8)
    written = decompress(np.frombuffer(packed, np.uint8), out[:size])
    assert -1 - len(packed) <= written <= size
    assert (out[size:] == 77).all()


def pcd(points, ring, time, data, *, extra=True):
    """A PCD file with padding, a field of three numbers, a double and unsigned integers."""
    count = len(points)
    kinds = [("x", "f4", 1), ("y", "f4", 1), ("_", "u1", 4), ("z", "f8", 1), ("normal", "f4", 3)]
    kinds += [("ring", "u2", 1), ("time", "f4", 1)] if extra else []
    table = np.zeros(count, [(f"{n}", kind, (size,)) for n, (_, kind, size) in enumerate(kinds)])
    columns = {"x": points[:, 0], "y": points[:, 1], "z": points[:, 2], "ring": ring, "time": time}
    for n, (name, _, _) in enumerate(kinds):
        if name in columns:
            table[f"{n}"][:, 0] = columns[name]
    letters = {"f": "F", "u": "U"}
    head = "\n".join(
        [
            "# .PCD v0.7 - made by a test",
            "VERSION 0.7",
            "FIELDS " + " ".join(name for name, _, _ in kinds),
            "SIZE " + " ".join(kind[1] for _, kind, _ in kinds),
            "TYPE " + " ".join(letters[kind[0]] for _, kind, _ in kinds),
            "COUNT " + " ".join(str(size) for _, _, size in kinds),
            f"WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}",
            f"DATA {data}\n",
        ]
    ).encode()
    if data == "ascii":
        rows = (" ".join(repr(v) for field in row for v in field.tolist()) for row in table)
        return head + "\n".join(rows).encode()
    if data == "binary":
        return head + table.tobytes()
    flat = b"".join(table[name].tobytes() for name in table.dtype.names)
    packed = compress(flat)
    return head + struct.pack("<II", len(packed), len(flat)) + packed


def ply(points, ring, time, form):
    order = ">" if "big" in form else "<"
    table = np.zeros(len(points), [(n, f"{order}f4") for n in ("x", "y", "z", "time")] + [("ring", "u1")])
    for n, name in enumerate("xyz"):
        table[name] = points[:, n]
    table["ring"], table["time"] = ring, time
    head = ["ply", f"format {form} 1.0", f"element vertex {len(points)}"]
    head += [f"property float {name}" for name in ("x", "y", "z", "time")] + ["property uchar ring", "end_header\n"]
    body = table.tobytes()
    if form == "ascii":
        body = "\n".join(" ".join(repr(v) for v in row.tolist()) for row in table).encode()
    return "\n".join(head).encode() + body


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_pcd_files_come_back_to_the_bit(tmp_path, data):
    points, ring, time = example()
    (tmp_path / "scan.pcd").write_bytes(pcd(points, ring, time, data))
    scan = read_scan(tmp_path / "scan.pcd")
    assert scan.points.dtype == np.float32
    assert np.array_equal(scan.points, points)
    assert np.array_equal(scan.ring, ring)
    assert np.array_equal(scan.time_offset, time)
    (tmp_path / "plain.PCD").write_bytes(pcd(points, ring, time, data, extra=False))
    assert read_scan(tmp_path / "plain.PCD").ring is None


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_files_come_back_to_the_bit(tmp_path, form):
    points, ring, time = example()
    (tmp_path / "scan.ply").write_bytes(ply(points, ring, time, form))
    scan = read_scan(tmp_path / "scan.ply")
    assert np.array_equal(scan.points, points)
    assert np.array_equal(scan.ring, ring)
    assert np.array_equal(scan.time_offset, time)


def test_kitti_and_npz_files_come_back_to_the_bit(tmp_path):
    points, ring, time = example()
    np.c_[points, np.ones(COUNT, np.float32)].astype("<f4").tofile(tmp_path / "scan.bin")
    assert np.array_equal(read_scan(tmp_path / "scan.bin").points, points)
    np.savez(tmp_path / "scan.npz", points=points.astype(np.float64), ring=ring, time_offset=time)
    scan = read_scan(tmp_path / "scan.npz")
    assert np.array_equal(scan.points, points)
    assert np.array_equal(scan.ring, ring)
    assert np.array_equal(scan.time_offset, time)
    np.savez(tmp_path / "wide.npz", cloud=np.c_[points, points])
    assert np.array_equal(read_scan(tmp_path / "wide.npz").points, points)


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_files_without_points_are_empty_scans(tmp_path, data):
    none = example(0)
    (tmp_path / "scan.pcd").write_bytes(pcd(*none, data))
    (tmp_path / "scan.bin").write_bytes(b"")
    (tmp_path / "scan.ply").write_bytes(ply(*none, "ascii"))
    np.savez(tmp_path / "scan.npz", points=np.zeros((0, 3)))
    for suffix in ("pcd", "bin", "ply", "npz"):
        assert read_scan(tmp_path / f"scan.{suffix}").points.shape == (0, 3)


def cut(count):
    return lambda raw: raw[:-count]


def changed(old, new):
    def change(raw):
        assert old in raw
        return raw.replace(old, new, 1)

    return change


BROKEN = {
    "text": ("binary", lambda raw: b"hello\nworld\n", "no PCD file"),
    "nothing": ("binary", lambda raw: b"", "no PCD file"),
    "an image": ("binary", lambda raw: bytes(range(256)) * 9, "no PCD file"),
    "no types": ("binary", changed(b"\nTYPE", b"\n#YPE"), "without TYPE"),
    "no x": ("binary", changed(b"FIELDS x", b"FIELDS q"), "has no x; its fields are q y z"),
    "a type of three bytes": ("binary", changed(b"SIZE 4", b"SIZE 3"), "line 5: there is no PCD type F of 3 bytes"),
    "a size that is none": ("binary", changed(b"SIZE 4", b"SIZE x"), "line 4: SIZE wants whole numbers"),
    "a field too few": ("binary", changed(b"FIELDS x", b"FIELDS"), "line 3: FIELDS, SIZE, TYPE and COUNT"),
    "another data": ("binary", changed(b"DATA binary", b"DATA morse"), "line 11: its data are 'morse'"),
    "cut binary": ("binary", cut(5), r"ends at byte \d+; its 40 points reach to byte \d+"),
    "cut ascii": ("ascii", cut(400), "of the 40 points it announces"),
    "a word": ("ascii", changed(b"\nDATA ascii\n", b"\nDATA ascii\nred "), "line 12: 'red' is no number"),
    "cut compressed": ("binary_compressed", cut(5), r"ends at byte \d+; its compressed data reach to byte"),
    "no compressed": ("binary_compressed", lambda raw: raw[: raw.index(b"compressed") + 12], "before its compressed"),
    "fewer points": ("binary_compressed", changed(b"POINTS 40", b"POINTS 41"), r"byte \d+: \d+ bytes are packed"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_pcd_is_named_with_its_line_or_byte(tmp_path, name):
    data, spoil, sentence = BROKEN[name]
    path = tmp_path / "scan.pcd"
    path.write_bytes(spoil(pcd(*example(), data)))
    with pytest.raises(ScanError, match=sentence) as caught:
        read_scan(path)
    assert "scan.pcd" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_damaged_compression_is_named_with_its_byte(tmp_path):
    raw = bytearray(pcd(*example(), "binary_compressed"))
    start = raw.index(b"compressed\n") + len("compressed\n") + 8
    raw[start] = 0xFF  # a reference back to before the beginning
    (tmp_path / "scan.pcd").write_bytes(raw)
    with pytest.raises(ScanError, match=f"byte {start}: the compressed data are damaged"):
        read_scan(tmp_path / "scan.pcd")


def test_other_broken_files_are_named_in_one_sentence(tmp_path):
    def sentence(name, raw):
        (tmp_path / name).write_bytes(raw)
        with pytest.raises(ScanError) as caught:
            read_scan(tmp_path / name)
        assert name in str(caught.value)
        assert "\n" not in str(caught.value)
        return str(caught.value)

    assert "byte 32: it ends amid a point" in sentence("scan.bin", bytes(45))
    assert "not a PLY file" in sentence("scan.ply", b"hello")
    assert "no .npz file" in sentence("scan.npz", b"hello")
    assert "no .npz file" in sentence("zip.npz", b"PK\x03\x04hello")
    assert "no scan that can be read; .bin, .pcd, .ply, .npz can" in sentence("scan.las", b"LASF")
    for name, arrays, wanted in (
        ("other.npz", {"a": np.zeros(3), "b": np.zeros(2)}, "wants an array 'points'; it has a float64"),
        ("flat.npz", {"points": np.zeros(9)}, "shape"),
        ("thin.npz", {"points": np.zeros((9, 2))}, "shape"),
        ("ring.npz", {"points": np.zeros((9, 3)), "ring": np.zeros(8, int)}, r"wants ring of shape \(9,\)"),
        ("object.npz", {"points": np.array([{}, 3], object)}, "no .npz file of numbers"),
    ):
        np.savez(tmp_path / name, **arrays)
        with pytest.raises(ScanError, match=wanted):
            read_scan(tmp_path / name)


def test_points_that_are_none_are_dropped_and_counted():
    points, ring, time = example()
    points[3, 1], points[5, 0], points[7] = np.nan, np.inf, 0.0
    points[9], points[11] = (100.0, 0, 0), (0.3, 0, 0)
    with np.errstate(all="raise"):
        scan, dropped = clean(Scan(points, ring.astype(np.uint8), time), min_range=0.5, max_range=50.0)
    gone = [3, 5, 7, 9, 11]
    near = np.flatnonzero(np.linalg.norm(np.delete(points, gone, 0), axis=1) < 0.5)
    assert dropped == (2, 3 + len(near))
    assert np.isfinite(scan.points).all()
    keep = np.delete(np.delete(np.arange(COUNT), gone), near)
    assert np.array_equal(scan.points, points[keep])
    assert np.array_equal(scan.ring, ring[keep])
    assert np.array_equal(scan.time_offset, time[keep])
    assert clean(scan)[0] is scan


def test_times_are_told_in_nanoseconds_seconds_or_of_the_day():
    points, _, seconds = example()
    columns = dict(zip("xyz", points.T, strict=True))
    stamp = 1_305_031_102_175_304_123
    offsets = np.round(seconds.astype(np.float64) * 1e9).astype(np.int64)
    for name, values in (
        ("t", offsets.astype(np.uint32)),
        ("time", seconds),
        ("timestamp", stamp + offsets),
        ("timestamp", (stamp + offsets) * 1e-9),
    ):
        scan = scan_of({**columns, name: values}, "scan", stamp=stamp)
        assert np.allclose(scan.time_offset, seconds, atol=3e-7), name  # a double holds the time of day to 0.24 us
        assert scan.remark == ""
    for wrong in (seconds * 1e6, (stamp + offsets) * 1e-9 + 1000.0):
        scan = scan_of({**columns, "time": wrong}, "scan", stamp=stamp)
        assert scan.time_offset is None
        assert "'time' is not used" in scan.remark
    scan = scan_of({**columns, "ring": np.arange(COUNT) * 100}, "scan")
    assert scan.ring is None
    assert "'ring' is not used" in scan.remark


def test_rings_are_counted_from_the_lowest_beam():
    elevation = np.radians(np.linspace(-20, 20, 16))
    turn = np.linspace(0, 2 * np.pi, 30, endpoint=False)
    level, angle = np.meshgrid(elevation, turn, indexing="ij")
    points = np.stack([np.cos(level) * np.cos(angle), np.cos(level) * np.sin(angle), np.sin(level)], -1).reshape(-1, 3)
    ring = np.repeat(np.arange(16, dtype=np.uint8), 30)
    rising, falling = Scan(points.astype(np.float32), ring), Scan(points.astype(np.float32), 15 - ring)
    assert rings_fall(rising) is False
    assert rings_fall(falling) is True
    assert np.array_equal(turned(falling, 16).ring, ring)
    assert rings_fall(Scan(rising.points[:5], ring[:5])) is None


def test_folders_are_read_in_natural_order_or_by_the_stamps_in_their_names(tmp_path):
    def make(*names):
        folder = tmp_path / names[0]
        folder.mkdir()
        for place, name in enumerate(names):
            np.full((1, 4), place + 1, "<f4").tofile(folder / f"{name}.bin")
        return folder

    scans = FolderScans(make("scan1", "scan10", "scan2"))
    assert [sweep.name for sweep in scans.sweeps] == ["scan1.bin", "scan2.bin", "scan10.bin"]
    assert [sweep.stamp for sweep in scans.sweeps] == [None] * 3
    assert [scan.points[0, 0] for scan in scans.read([0, 2])] == [1, 2]
    folder = make("9.5", "10.25", "0.75")
    assert [sweep.stamp for sweep in FolderScans(folder).sweeps] == [750_000_000, 9_500_000_000, 10_250_000_000]
    assert [sweep.stamp for sweep in FolderScans(folder, named=False).sweeps] == [None] * 3
    (tmp_path / "times.txt").write_text("0.5\n0.6\n0.7\n")
    stamps = [sweep.stamp for sweep in FolderScans(folder, stamps=tmp_path / "times.txt").sweeps]
    assert stamps == [500_000_000, 600_000_000, 700_000_000]
    (tmp_path / "times.txt").write_text("0.5\n0.6\n")
    with pytest.raises(ScanError, match="2 stamps for the 3 scans"):
        FolderScans(folder, stamps=tmp_path / "times.txt")


def test_a_folder_without_scans_says_where_there_are_some(tmp_path):
    deep = tmp_path / "velodyne" / "data"
    deep.mkdir(parents=True)
    for name in ("a.bin", "b.bin"):
        (deep / name).write_bytes(b"")
    with pytest.raises(ScanError, match=f"holds no scans.*there are 2 in {deep}"):
        scan_files(tmp_path)
    with pytest.raises(ScanError, match=r"that match 'c\*'"):
        scan_files(deep, "c*")
    (deep / "c.pcd").write_bytes(b"")
    with pytest.raises(ScanError, match=r"several kinds, .bin and .pcd; --pattern chooses"):
        scan_files(deep)
    assert len(scan_files(deep, "*.bin")) == 2


@pytest.mark.skipif(not (DATA / "pcl_room_scan").is_dir(), reason="wants ../shared/data")
def test_two_real_scans_of_one_room_fit_together():
    one, two = (read_scan(DATA / "pcl_room_scan" / f"room_scan{n}.pcd").points for n in (1, 2))
    assert one.shape == (112586, 3)
    assert two.shape == (112624, 3)
    one, two = (scan[np.unique(np.floor(scan / 0.1).astype(int), axis=0, return_index=True)[1]] for scan in (one, two))
    tree = cKDTree(one)
    fit = planar(1.97, 0.056, 0.711, 0.033)  # by ICP, from the guess that is published with the scans
    apart = [np.median(tree.query(points)[0]) for points in (transform(fit, two), two)]
    assert apart[0] < 0.1
    assert apart[1] > 0.3
