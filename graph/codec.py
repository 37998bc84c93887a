"""Messages to bytes and back: msgpack by msgspec, arrays as one extension, checked against their types.

Wire and recording hold the same bytes. Encoding is canonical: equal messages give equal bytes.
"""

from __future__ import annotations

import functools
import json
import struct
import typing
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import xxhash

from graph.arrays import Array, ArraySpec, aligned_copy, spec_of

ARRAY_EXTENSION = 1  # the only msgpack extension code in use

_ALLOWED_KINDS = "biufc"

_LARGE = 1 << 16  # bytes of an array that is worth a place holder; from here on msgpack's header is always ext 32
_EXT_32 = struct.Struct(">BIb")  # 0xc9, length, code
_PLACE = msgspec.msgpack.Ext(ARRAY_EXTENSION, bytes.fromhex("8b5e1f0c6a7d4392b1e0c95d27f3a864"))  # arbitrary bytes
_PLACE_BYTES = msgspec.msgpack.encode(_PLACE)


class CodecError(ValueError):
    """A message that does not fit its type, or bytes that are no such message."""


@functools.lru_cache(maxsize=1024)  # most arrays of a topic look alike
def _array_head(dtype: np.dtype[Any], shape: tuple[int, ...]) -> tuple[bytes, np.dtype[Any]]:
    """Return what stands before the bytes of an array, and the dtype that it travels with."""
    if dtype.kind not in _ALLOWED_KINDS:
        raise CodecError(f"arrays of dtype {dtype} cannot travel; use numbers or booleans")
    little = dtype.newbyteorder("<")
    head = msgspec.msgpack.encode((little.str, shape))
    return bytes((len(head),)) + head, little


def _array_pieces(value: Array) -> tuple[bytes, memoryview]:
    """Return the content of an array's extension: what it is, and its bytes as they lie in memory."""
    head, little = _array_head(value.dtype, value.shape)
    ready = value.flags.c_contiguous and value.dtype == little
    return head, (value if ready else np.ascontiguousarray(value, little)).data


def _pack_array(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return msgspec.msgpack.Ext(ARRAY_EXTENSION, b"".join(_array_pieces(value)))
    if isinstance(value, np.generic):
        return value.item()
    raise CodecError(f"a {type(value).__name__} cannot travel in a message")


Room = Callable[[int], memoryview | None]  # memory for so many bytes, where there is any


def _encode(message: msgspec.Struct, room: Room | None) -> bytes | memoryview:
    """Encode a message, copying large arrays once instead of three times; the bytes are the same."""
    large: list[tuple[bytes, memoryview]] = []

    def pack(value: Any) -> Any:
        if isinstance(value, np.ndarray) and value.nbytes >= _LARGE:
            large.append(_array_pieces(value))
            return _PLACE
        return _pack_array(value)

    encoded = msgspec.msgpack.encode(message, enc_hook=pack, order="deterministic")
    between = encoded.split(_PLACE_BYTES) if large else [encoded]
    if len(between) != len(large) + 1:  # the message happens to hold the bytes of a place holder
        between = [msgspec.msgpack.encode(message, enc_hook=_pack_array, order="deterministic")]
        large.clear()
    pieces: list[bytes | memoryview] = [between[0]]
    for (head, data), rest in zip(large, between[1:], strict=True):
        pieces += (_EXT_32.pack(0xC9, len(head) + data.nbytes, ARRAY_EXTENSION), head, data, rest)
    size = sum(piece.nbytes if isinstance(piece, memoryview) else len(piece) for piece in pieces)
    target = None if room is None else room(size)
    return b"".join(pieces) if target is None else _filled(target, pieces)


def _filled(target: memoryview, pieces: list[bytes | memoryview]) -> memoryview:
    """Copy pieces behind each other into memory of just their size."""
    begin = 0
    for piece in pieces:
        flat = piece.cast("B") if isinstance(piece, memoryview) else piece
        target[begin : begin + len(flat)] = flat
        begin += len(flat)
    return target


_head_decoder = msgspec.msgpack.Decoder(tuple[str, tuple[int, ...]])


@functools.lru_cache(maxsize=1024)  # most arrays of a topic look alike
def _array_form(head: bytes) -> tuple[np.dtype[Any], tuple[int, ...]]:
    name, shape = _head_decoder.decode(head)
    dtype = np.dtype(name)
    if dtype.kind not in _ALLOWED_KINDS:
        raise CodecError(f"arrays of dtype {dtype} cannot travel")
    return dtype, shape


def _unpack_array(code: int, data: memoryview) -> Array:
    if code != ARRAY_EXTENSION:
        raise CodecError(f"unknown msgpack extension {code}")
    split = 1 + data[0]
    dtype, shape = _array_form(bytes(data[1:split]))
    return aligned_copy(data[split:], dtype, shape)


Check = Callable[[Any, dict[str, int], str, str], None]  # value, lengths by name, what it is part of, its name


def _array_check(spec: ArraySpec) -> Check:
    dtype, sizes = np.dtype(spec.dtype), tuple(spec.shape)

    def check(value: Any, lengths: dict[str, int], where: str, name: str) -> None:
        good = isinstance(value, np.ndarray) and value.dtype == dtype
        if good and (shape := value.shape) != sizes:
            good = len(shape) == len(sizes)
            for wanted, length in zip(sizes, shape, strict=False):
                good = good and length == (wanted if isinstance(wanted, int) else lengths.setdefault(wanted, length))
        if not good:
            given = f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
            known = {side: length for side, length in lengths.items() if side in spec.shape}
            hint = f" with {', '.join(f'{k} = {v}' for k, v in known.items())}" if known else ""
            raise CodecError(f"{where}.{name} wants {spec}{hint}; it was given {given}")

    return check


def _check_for(hint: Any) -> Check | None:
    """Build the array check of one type hint: arrays, structs, and lists, tuples or dicts of them."""
    origin = typing.get_origin(hint)
    if origin is typing.Annotated:
        inner, *metas = typing.get_args(hint)
        for meta in metas:
            if (spec := spec_of(meta)) is not None:
                return _array_check(spec)
        return _check_for(inner)
    if isinstance(hint, type) and issubclass(hint, msgspec.Struct):
        return _check_part if struct_checks(hint) else None
    checks = [check for arg in typing.get_args(hint) if (check := _check_for(arg)) is not None]
    if not checks:
        return None
    only = checks[0]

    def check_all(value: Any, lengths: dict[str, int], where: str, name: str) -> None:
        for item in value.values() if origin is dict else value:
            only(item, {}, where, f"{name}[]")

    def check_some(value: Any, lengths: dict[str, int], where: str, name: str) -> None:
        if value is not None:  # a union: None, or the one kind of array or struct it may hold
            only(value, lengths, where, name)

    return check_all if origin in (list, tuple, dict) else check_some


def _check_part(value: Any, lengths: dict[str, int], where: str, name: str) -> None:
    _check_struct(value, f"{where}.{name}")


def _check_struct(value: Any, where: str) -> None:
    own: dict[str, int] = {}
    for name, check in struct_checks(type(value)):
        check(getattr(value, name), own, where, name)


_struct_checks: dict[type[Any], tuple[tuple[str, Check], ...]] = {}


def struct_checks(kind: type[Any]) -> tuple[tuple[str, Check], ...]:
    """List (field, check) of the fields of a struct that hold arrays."""
    if (known := _struct_checks.get(kind)) is not None:
        return known
    hints = typing.get_type_hints(kind, include_extras=True)
    found = ((name, _check_for(hints[name])) for name in kind.__struct_fields__)
    _struct_checks[kind] = tuple((name, check) for name, check in found if check is not None)
    return _struct_checks[kind]


def encode(message: msgspec.Struct) -> bytes:
    """Encode a message. Raises CodecError, naming the field, if an array is not of the declared dtype and shape."""
    encoded = encode_into(message, None)
    assert isinstance(encoded, bytes)
    return encoded


def encode_into(message: msgspec.Struct, room: Room | None) -> bytes | memoryview:
    """Encode a message into the memory that `room` has for it, or else into new bytes. Raises as `encode`."""
    try:
        _check_struct(message, type(message).__name__)
    except (TypeError, AttributeError) as error:
        raise CodecError(f"{type(message).__name__}: {error}") from error
    try:
        return _encode(message, room)
    except (TypeError, ValueError, msgspec.MsgspecError) as error:
        raise CodecError(f"{type(message).__name__}: {error}") from error


@functools.cache
def _decoder(kind: Any) -> msgspec.msgpack.Decoder[Any]:
    return msgspec.msgpack.Decoder(kind, ext_hook=_unpack_array)


def decode(payload: bytes | memoryview, kind: type[msgspec.Struct]) -> Any:
    """Decode a message of a known type; its arrays are 64-byte aligned and read-only.

    Raises CodecError, naming the field, if the bytes are not such a message.
    """
    try:
        message = _decoder(kind).decode(payload)
    except (msgspec.MsgspecError, ValueError, TypeError, IndexError) as error:
        raise CodecError(f"not a {kind.__name__}: {error}") from error
    _check_struct(message, kind.__name__)
    return message


def digest(payload: bytes | memoryview) -> bytes:
    """Return the 16-byte xxh3-128 digest of a payload."""
    return xxhash.xxh3_128_digest(payload)


def schema(kind: type[Any]) -> str:
    """Return the JSON Schema of a message type as canonical text; arrays carry x-dtype, x-shape, x-unit, x-frame."""
    if kind not in _schemas:
        _schemas[kind] = _read_schema(kind)
    return _schemas[kind]


_schemas: dict[type[Any], str] = {}


def _read_schema(kind: type[Any]) -> str:

    def array_schema(kind: type) -> dict[str, Any]:
        return {"description": "array"} if kind is np.ndarray else {}

    return json.dumps(msgspec.json.schema(kind, schema_hook=array_schema), sort_keys=True)


def type_name(kind: type) -> str:
    """Return the full name of a message type, the same in every process: `graph.messages.PointCloud`."""
    return f"{kind.__module__}.{kind.__qualname__}"
