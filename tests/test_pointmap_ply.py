"""Maps as PLY files: round trip, files of other programs, and files that are not maps."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.spatial import cKDTree

from operators.pointmap import MapPoints, PlyError, load_map, save_map
from operators.pointmap.ply import read_ply, write_ply
from operators.pointmap.thinning import thinned


def example(count=50, **more):
    random = np.random.default_rng(0)
    points, normals = random.normal(size=(2, count, 3)).astype(np.float32)
    return MapPoints(points, normals, random.uniform(0, 1, count).astype(np.float32), **more)


def test_a_map_comes_back_to_the_bit(tmp_path):
    movable = np.linspace(0, 1, 50).astype(np.float32)
    label = (np.arange(50) % 5).astype(np.uint8)
    for cloud in (example(movable=movable, label=label), example()):
        save_map(tmp_path / "map.ply", cloud)
        again = load_map(tmp_path / "map.ply")
        assert all(np.array_equal(a, b) for a, b in zip(cloud[:3], again[:3], strict=True))
    assert (again.movable == 0.5).all()
    assert (again.label == 0).all()
    save_map(tmp_path / "map.ply", example(movable=movable, label=label))
    assert np.array_equal(load_map(tmp_path / "map.ply").movable, movable)
    assert np.array_equal(load_map(tmp_path / "map.ply").label, label)


def test_the_header_is_what_other_programs_read(tmp_path):
    save_map(tmp_path / "map.ply", example())
    raw = (tmp_path / "map.ply").read_bytes()
    head = raw[: raw.index(b"end_header")].decode()
    assert head.startswith("ply\nformat binary_little_endian 1.0\nelement vertex 50\n")
    names = re.findall(r"property (\w+) (\w+)", head)
    assert [name for _, name in names] == ["x", "y", "z", "nx", "ny", "nz", "score", "p_mov", "class"]
    assert {kind for kind, _ in names} == {"float", "uchar"}
    assert len(raw) == raw.index(b"end_header") + len("end_header\n") + 50 * 33


def plain(cloud, kind="ascii"):
    """A file as another program writes it: doubles, extra properties, faces, a prefix."""
    rows = np.concatenate([cloud.points, cloud.normals, cloud.scores[:, None]], axis=1).astype(np.float64)
    names = ["x", "y", "z", "nx", "ny", "nz", "scalar_score"]
    head = ["ply", f"format {kind} 1.0", "comment made elsewhere", f"element vertex {len(rows)}"]
    head += [f"property double {name}" for name in names] + ["property uchar red", "element face 0"]
    head += ["property list uchar int vertex_indices", "end_header"]
    if kind == "ascii":
        body = "\n".join(" ".join([*(repr(float(v)) for v in row), "255"]) for row in rows).encode()
    else:
        order = "<" if "little" in kind else ">"
        table = np.zeros(len(rows), [*((name, f"{order}f8") for name in names), ("red", "u1")])
        for n, name in enumerate(names):
            table[name] = rows[:, n]
        body = table.tobytes()
    return ("\n".join(head) + "\n").encode() + body


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_files_of_other_programs_are_read(tmp_path, kind):
    (tmp_path / "other.ply").write_bytes(plain(example(), kind))
    cloud = load_map(tmp_path / "other.ply")
    assert np.allclose(cloud.points, example().points)
    assert np.allclose(cloud.normals, example().normals)
    assert np.allclose(cloud.scores, example().scores)
    assert cloud.movable is None


def changed(old, new):
    return lambda raw: raw.replace(old, new, 1)


BROKEN = {
    "text": (lambda raw: b"hello", "is not a PLY file"),
    "empty": (lambda raw: b"", "is not a PLY file"),
    "header without end": (lambda raw: raw[:60], "is not a PLY file"),
    "no normals": (changed(b"property float nz", b"property float q"), "has no normals"),
    "no coordinates": (changed(b"property float x", b"property float q"), "has no coordinates"),
    "cut short": (lambda raw: raw[:-40], "ends after 48 of the 50 vertices"),
    "unknown format": (changed(b"binary_little_endian", b"binary_middle_endian"), "can be read"),
    "unknown type": (changed(b"property float x", b"property quad x"), "unknown type 'quad'"),
    "list": (changed(b"property float x", b"property list uchar int x"), "list among the properties"),
    "no vertices": (changed(b"element vertex 50", b"comment nothing"), "without format or vertices"),
    "zero vertices": (changed(b"element vertex 50", b"element vertex 0"), "without points"),
    "faces first": (changed(b"element vertex 50", b"element face 1\nelement vertex 50"), "vertices must come first"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_file_is_named_in_one_sentence(tmp_path, name):
    save_map(tmp_path / "map.ply", example())
    spoil, sentence = BROKEN[name]
    (tmp_path / "broken.ply").write_bytes(spoil((tmp_path / "map.ply").read_bytes()))
    with pytest.raises(PlyError, match=sentence) as caught:
        load_map(tmp_path / "broken.ply")
    assert "broken.ply" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_numbers_that_are_none_are_refused(tmp_path):
    cloud = example()
    cloud.points[3, 1] = np.nan
    save_map(tmp_path / "map.ply", cloud)
    with pytest.raises(PlyError, match="not finite"):
        load_map(tmp_path / "map.ply")


def test_words_in_an_ascii_file_are_refused(tmp_path):
    (tmp_path / "map.ply").write_bytes(plain(example()).replace(b"255", b"red", 1))
    with pytest.raises(PlyError, match="not a number"):
        load_map(tmp_path / "map.ply")
    (tmp_path / "map.ply").write_bytes(plain(example())[:-300])
    with pytest.raises(PlyError, match="ends after"):
        load_map(tmp_path / "map.ply")


def test_nothing_half_written_is_left(tmp_path, monkeypatch):
    save_map(tmp_path / "map.ply", example())
    before = (tmp_path / "map.ply").read_bytes()

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("operators.pointmap.ply.os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        save_map(tmp_path / "map.ply", example(80))
    assert (tmp_path / "map.ply").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["map.ply"]


def test_columns_of_two_lengths_are_no_table(tmp_path):
    with pytest.raises(ValueError, match="one length"):
        write_ply(tmp_path / "x.ply", {"x": np.zeros(2, np.float32), "y": np.zeros(3, np.float32)})


def test_columns_of_any_kind_are_kept(tmp_path):
    write_ply(tmp_path / "x.ply", {"x": np.arange(3, dtype=np.float32), "class": np.arange(3, dtype=np.uint8)})
    assert read_ply(tmp_path / "x.ply")["class"].tolist() == [0, 1, 2]


def test_a_packed_map_comes_back_to_the_bit(tmp_path):
    cloud = example()
    save_map(tmp_path / "map.ply.gz", cloud)
    again = load_map(tmp_path / "map.ply.gz")
    assert all(np.array_equal(a, b) for a, b in zip(cloud[:3], again[:3], strict=True))
    packed = (tmp_path / "map.ply.gz").read_bytes()
    (tmp_path / "cut.ply.gz").write_bytes(packed[: len(packed) // 2])
    with pytest.raises(PlyError, match=r"cut\.ply\.gz is packed by gzip, and damaged"):
        load_map(tmp_path / "cut.ply.gz")


def test_a_thinned_map_keeps_a_point_wherever_there_was_one(tmp_path):
    random = np.random.default_rng(1)
    points = random.uniform(0, 3, (20_000, 3)).astype(np.float32)
    normals = np.zeros((20_000, 3), np.float32)
    normals[:10_000, 0] = normals[10_000:, 2] = 1.0  # half of it level
    points[10_000:, 2] = 0.0
    cloud = MapPoints(points, normals, np.full(20_000, 0.7, np.float32), label=np.arange(20_000).astype(np.uint8))
    few = thinned(cloud, 0.2)
    assert len(few.points) < 0.25 * len(points)
    for part, kept, size in (
        (points[:10_000], few.normals[:, 0] > 0, 0.2),
        (points[10_000:], few.normals[:, 2] > 0, 0.5),
    ):
        distance, _ = cKDTree(few.points[kept]).query(part)
        assert distance.max() < np.sqrt(3) * size + 0.01
        assert len(np.unique(np.floor(part / size), axis=0)) == kept.sum()
    own, row = cKDTree(points).query(few.points)
    assert own.max() < 0.002
    assert np.array_equal(few.label, cloud.label[row])
