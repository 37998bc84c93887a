"""Messages to bytes and back: exact, canonical, aligned; and a sentence for everything that does not fit."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Annotated, Any

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from graph import codec
from graph.arrays import ALIGNMENT, Array, array, unit
from graph.codec import CodecError, decode, digest, encode, schema, type_name
from graph.compare import differences
from graph.messages import Drive, Message, OccupancyGrid, PointCloud, Pose, Tick
from tests.conftest import ROOT

FIXED = settings(
    derandomize=True, deadline=None, database=None, max_examples=60, suppress_health_check=list(HealthCheck)
)
STAMPS = st.integers(-(2**62), 2**62)
FLOATS = st.floats(width=32, allow_nan=True)


class Inner(msgspec.Struct, frozen=True, eq=False):
    """An array within a struct within a message."""

    values: Annotated[Array, array("int16", "k")]


class Everything(Message, frozen=True, kw_only=True, eq=False):
    """Fields of every sort that a message may have."""

    grid: Annotated[Array, array("complex64", 2, "k")]
    point: Annotated[Array, array("float64")]
    inner: Inner
    more: list[Inner] = msgspec.field(default_factory=list)
    by_name: dict[str, Inner] = msgspec.field(default_factory=dict)
    tags: set[str] = msgspec.field(default_factory=set)
    text: str = ""
    maybe: Annotated[Array, array("uint8", "k")] | None = None


def arrays(dtype: str, *shape: int) -> st.SearchStrategy[Array]:
    return hnp.arrays(np.dtype(dtype), shape)


@st.composite
def clouds(draw: st.DrawFn) -> PointCloud:
    count = draw(st.integers(0, 7))
    optional: dict[str, tuple[str, tuple[int, ...]]] = {
        "ring": ("uint8", (count,)),
        "scores": ("float32", (count, 4)),
        "moving": ("bool", (count,)),
        "instance": ("int32", (count,)),
    }
    return PointCloud(
        measured_at=draw(STAMPS),
        points=draw(arrays("float32", count, 3)),
        base_from_lidar=draw(arrays("float64", 4, 4)),
        **{name: draw(st.none() | arrays(dtype, *shape)) for name, (dtype, shape) in optional.items()},
    )


@st.composite
def everything(draw: st.DrawFn) -> Everything:
    count = draw(st.integers(0, 4))
    inner = st.integers(0, 3).flatmap(lambda length: arrays("int16", length)).map(Inner)
    return Everything(
        measured_at=draw(STAMPS),
        grid=draw(arrays("complex64", 2, count)),
        point=draw(arrays("float64")),
        inner=draw(inner),
        more=draw(st.lists(inner, max_size=2)),
        by_name=draw(st.dictionaries(st.text(max_size=3), inner, max_size=3)),
        tags=draw(st.sets(st.text(max_size=3), max_size=4)),
        text=draw(st.text(max_size=5)),
        maybe=draw(st.none() | arrays("uint8", count)),
    )


@settings(FIXED)
@given(clouds() | everything() | st.builds(Drive, measured_at=STAMPS, linear=FLOATS, angular=FLOATS))
def test_what_goes_in_comes_out_to_the_bit_and_has_one_encoding(message: Any) -> None:
    payload = encode(message)
    back = decode(payload, type(message))
    assert list(differences(message, back)) == []
    assert encode(back) == payload


@settings(FIXED)
@given(st.lists(st.integers(0, 30_000), min_size=1, max_size=3), st.binary(max_size=20))
def test_large_arrays_take_a_shorter_way_to_the_same_bytes(lengths: list[int], text: bytes) -> None:
    class Large(msgspec.Struct):
        parts: list[Annotated[Array, array("float32", "n")]]
        text: bytes

    parts = [np.arange(length, dtype=np.float32) for length in lengths]
    message = Large(parts, text)
    assert encode(message) == msgspec.msgpack.encode(message, enc_hook=codec._pack_array)


def test_a_message_that_holds_a_place_holder_is_still_encoded_right() -> None:
    class Large(msgspec.Struct):
        part: Annotated[Array, array("uint8", "n")]
        text: bytes

    message = Large(np.zeros(100_000, np.uint8), codec._PLACE_BYTES)
    back = decode(encode(message), Large)
    assert back.text == codec._PLACE_BYTES
    assert back.part.shape == (100_000,)


def test_decoded_arrays_are_aligned_read_only_little_endian_and_in_c_order() -> None:
    for count in (0, 1, 3, 1000, 40_000):
        cloud = cloud_of(np.arange(3 * count, dtype=np.float32).reshape(count, 3))
        points = decode(b"" + encode(cloud), PointCloud).points
        assert points.ctypes.data % ALIGNMENT == 0
        assert points.flags.c_contiguous
        assert points.dtype.byteorder in "=<|"
        with pytest.raises(ValueError, match="read-only"):
            points[...] = 0.0


def cloud_of(points: Array, **more: Any) -> PointCloud:
    return PointCloud(measured_at=1, points=points, base_from_lidar=np.eye(4), **more)


def test_the_layout_in_memory_does_not_matter() -> None:
    points = np.arange(12, dtype=np.float32).reshape(4, 3)
    strided = np.zeros((8, 6), np.float32)
    strided[::2, ::2] = points
    wanted = encode(cloud_of(points))
    assert encode(cloud_of(np.asfortranarray(points))) == wanted
    assert encode(cloud_of(strided[::2, ::2])) == wanted


def test_numpy_numbers_travel_as_numbers() -> None:
    message = Drive(measured_at=np.int64(5), linear=np.float64(1.5), angular=np.float32(2.5))
    assert encode(message) == encode(Drive(measured_at=5, linear=1.5, angular=2.5))


@pytest.mark.parametrize(
    ("message", "sentence"),
    [
        (cloud_of(np.zeros((2, 3))), r"PointCloud\.points wants float32 \(n, 3\); it was given float64 \(2, 3\)"),
        (cloud_of(np.zeros(6, np.float32)), r"PointCloud\.points wants float32 \(n, 3\); it was given float32 \(6,\)"),
        (cloud_of(np.zeros((2, 3), ">f4")), r"PointCloud\.points wants float32 .* given >f4"),
        (
            cloud_of(np.zeros((2, 3), np.float32), ring=np.zeros(3, np.uint8)),
            r"PointCloud\.ring wants uint8 \(n,\) with n = 2; it was given uint8 \(3,\)",
        ),
        (Pose(measured_at=0, world_from_base=None), r"Pose\.world_from_base wants float64 \(4, 4\)"),
        (
            Everything(
                measured_at=0,
                grid=np.zeros((2, 1), np.complex64),
                point=np.zeros(()),
                inner=Inner(np.zeros(1, np.int16)),
                more=[Inner(np.zeros(1, np.int32))],
            ),
            r"Everything\.more\[\]\.values wants int16 \(k,\); it was given int32",
        ),
        (Tick(measured_at=0, index=object()), r"Tick: a object cannot travel"),
    ],
)
def test_a_message_that_does_not_fit_its_type_is_refused_by_field(message: Any, sentence: str) -> None:
    with pytest.raises(CodecError, match=sentence):
        encode(message)


@pytest.mark.parametrize(
    ("payload", "sentence"),
    [
        (b"", "not a Drive"),
        (b"\xc1", "not a Drive"),
        (msgspec.msgpack.encode([1, 2]), "not a Drive"),
        (msgspec.msgpack.encode({"measured_at": 1, "linear": 2.0}), "not a Drive: .*angular"),
        (msgspec.msgpack.encode({"measured_at": 1, "linear": "fast", "angular": 0.0}), r"not a Drive: .*linear"),
    ],
)
def test_bytes_that_are_no_such_message_are_refused(payload: bytes, sentence: str) -> None:
    with pytest.raises(CodecError, match=sentence):
        decode(payload, Drive)


EXTENSIONS = [
    msgspec.msgpack.Ext(1, b""),
    msgspec.msgpack.Ext(1, b"\xff"),
    msgspec.msgpack.Ext(2, b"whatever"),
    msgspec.msgpack.Ext(1, b"\x01\x00"),
    *(
        msgspec.msgpack.Ext(1, bytes((len(head),)) + head + b"\0" * 8)
        for head in (
            msgspec.msgpack.encode(item)
            for item in (
                ("<f4", (3, 3)),
                ("|O", (1,)),
                ("nonsense", (1,)),
                ("<f8", (-1, -1)),
                ("<f8", (2**60,)),
                (1, 2),
            )
        )
    ),
]


@pytest.mark.parametrize("extension", EXTENSIONS, ids=range(len(EXTENSIONS)))
def test_arrays_that_are_none_are_refused(extension: msgspec.msgpack.Ext) -> None:
    payload = msgspec.msgpack.encode({"measured_at": 1, "points": extension, "base_from_lidar": extension})
    with pytest.raises(CodecError, match="PointCloud"):
        decode(payload, PointCloud)


@settings(FIXED, max_examples=300)
@given(st.integers(0, 10**6), st.integers(0, 255))
def test_a_changed_byte_gives_another_message_or_a_codec_error(place: int, value: int) -> None:
    payload = bytearray(encode(cloud_of(np.zeros((2, 3), np.float32), ring=np.zeros(2, np.uint8))))
    payload[place % len(payload)] = value
    try:
        message = decode(bytes(payload), PointCloud)
    except CodecError:
        return
    assert len(message.points) == (len(message.ring) if message.ring is not None else len(message.points))


def test_sets_are_encoded_alike_whatever_the_hash_seed() -> None:
    program = (
        "import msgspec, sys\nfrom graph.codec import encode\n"
        "class Tags(msgspec.Struct):\n    tags: set[str]\n"
        "print(encode(Tags({'one', 'two', 'three', 'four', 'five'})).hex())"
    )
    said = {
        subprocess.run(
            [sys.executable, "-c", program],
            env={**os.environ, "PYTHONHASHSEED": str(number)},
            cwd=ROOT,
            capture_output=True,
            check=True,
        ).stdout
        for number in (1, 2, 3)
    }
    assert len(said) == 1


def test_the_digest_is_xxh3_128() -> None:
    assert digest(b"").hex() == "99aa06d3014798d86001c324468d497f"  # as published by xxHash
    assert digest(b"a") != digest(b"b")


def test_the_schema_says_dtype_shape_unit_and_frame() -> None:
    fields = msgspec.json.decode(schema(PointCloud))["$defs"]["PointCloud"]["properties"]
    assert fields["points"]["x-dtype"] == "float32"
    assert fields["points"]["x-shape"] == ["n", 3]
    assert (fields["points"]["x-unit"], fields["points"]["x-frame"]) == ("m", "lidar")
    assert fields["measured_at"]["x-unit"] == "ns"
    assert schema(PointCloud) == schema(PointCloud)
    assert type_name(OccupancyGrid) == "graph.messages.OccupancyGrid"


def test_a_dtype_that_numpy_does_not_know_is_refused_where_it_is_written() -> None:
    with pytest.raises(TypeError, match="nothing"):
        array("nothing", "n")
    assert unit("m").extra_json_schema == {"x-unit": "m"}
