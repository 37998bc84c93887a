"""PCD files of the Point Cloud Library: ascii, binary and binary_compressed."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from operators.scans.lzf import decompress
from operators.scans.scan import Columns, ScanError

KINDS = {"F": "f", "I": "i", "U": "u"}
SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
DATA = ("ascii", "binary", "binary_compressed")
LONGEST_HEADER = 1 << 16  # bytes


class Header(NamedTuple):
    """What a PCD file announces."""

    fields: list[tuple[str, str, int]]  # name, dtype, count
    points: int
    data: str
    size: int  # bytes
    lines: int


def read_pcd(path: Path) -> Columns:
    """Read the fields of a PCD file that hold one number a point, by name. Raises ScanError with the line or byte."""
    raw = path.read_bytes()
    header = read_header(raw, path)
    columns = {"ascii": _ascii, "binary": _binary, "binary_compressed": _compressed}[header.data](raw, header, path)
    single = {name for name, _, count in header.fields if count == 1 and name != "_"}
    return {name: column for name, column in columns.items() if name in single}


def read_header(raw: bytes, path: Path) -> Header:
    """Read the header of a PCD file. Raises ScanError with the line."""
    said: dict[str, tuple[int, list[str]]] = {}
    at = number = 0
    while "DATA" not in said:
        number += 1
        end = raw.find(b"\n", at, at + LONGEST_HEADER)
        line = raw[at : len(raw) if end < 0 else end]
        key, *words = line.decode("latin-1").partition("#")[0].split() or [""]
        if (end < 0 and key != "DATA") or not key.isascii():
            raise ScanError(f"{path} is no PCD file: it has no header that ends in a line DATA")
        at = len(raw) if end < 0 else end + 1
        if key:
            said[key.upper()] = number, words
    if missing := [key for key in ("FIELDS", "SIZE", "TYPE") if key not in said]:
        raise ScanError(f"{path} has a PCD header without {' and '.join(missing)}")

    def numbers(key: str, default: list[int]) -> list[int]:
        line, words = said.get(key, (0, [str(value) for value in default]))
        if not words or not all(word.isdigit() for word in words):
            raise ScanError(f"{path} line {line}: {key} wants whole numbers; it says {' '.join(words) or 'nothing'}")
        return [int(word) for word in words]

    names, kinds = said["FIELDS"][1], said["TYPE"][1]
    sizes, counts = numbers("SIZE", []), numbers("COUNT", [1] * len(names))
    if not len(names) == len(kinds) == len(sizes) == len(counts):
        raise ScanError(f"{path} line {said['FIELDS'][0]}: FIELDS, SIZE, TYPE and COUNT are not of one length")
    for kind, size in zip(kinds, sizes, strict=True):
        if size not in SIZES.get(kind, ()):
            raise ScanError(f"{path} line {said['TYPE'][0]}: there is no PCD type {kind} of {size} bytes")
    width, height = numbers("WIDTH", [0])[0], numbers("HEIGHT", [1])[0]
    data = " ".join(said["DATA"][1])
    if data not in DATA:
        raise ScanError(f"{path} line {said['DATA'][0]}: its data are {data!r}; {', '.join(DATA)} can be read")
    fields = [(n, f"<{KINDS[k]}{s}", c) for n, k, s, c in zip(names, kinds, sizes, counts, strict=True)]
    return Header(fields, numbers("POINTS", [width * height])[0], data, at, number)


def _ascii(raw: bytes, header: Header, path: Path) -> Columns:
    width = sum(count for _, _, count in header.fields)
    words = raw[header.size :].split()
    if len(words) < header.points * width:
        raise ScanError(f"{path} ends after {len(words) // max(width, 1)} of the {header.points} points it announces")
    try:
        table = np.array(words[: header.points * width], np.float64).reshape(header.points, width)
    except ValueError:
        raise ScanError(_first_word(raw, header, path)) from None
    columns, at = {}, 0
    for name, kind, count in header.fields:
        with np.errstate(invalid="ignore"):
            columns[name] = table[:, at].astype(kind)
        at += count
    return columns


def _first_word(raw: bytes, header: Header, path: Path) -> str:
    for number, line in enumerate(raw[header.size :].split(b"\n"), header.lines + 1):
        for word in line.split():
            try:
                float(word)
            except ValueError:
                return f"{path} line {number}: {word.decode('latin-1')!r} is no number"
    return f"{path} holds what is no number"


def _binary(raw: bytes, header: Header, path: Path) -> Columns:
    places = [(f"{place}", kind, (count,)) for place, (_, kind, count) in enumerate(header.fields)]
    dtype = np.dtype(places)
    wanted = header.size + header.points * dtype.itemsize
    if len(raw) < wanted:
        raise ScanError(f"{path} ends at byte {len(raw)}; its {header.points} points reach to byte {wanted}")
    table = np.frombuffer(raw, dtype, header.points, header.size)
    return {
        name: np.ascontiguousarray(table[f"{place}"][:, 0])
        for place, (name, _, count) in enumerate(header.fields)
        if count
    }


def _compressed(raw: bytes, header: Header, path: Path) -> Columns:
    if len(raw) < header.size + 8:
        raise ScanError(f"{path} ends at byte {len(raw)}, before its compressed data")
    packed_size, size = struct.unpack_from("<II", raw, header.size)
    start = header.size + 8
    wanted = header.points * sum(int(kind[2:]) * count for _, kind, count in header.fields)
    if size != wanted:
        raise ScanError(f"{path} byte {header.size + 4}: {size} bytes are packed; {header.points} points take {wanted}")
    if len(raw) < start + packed_size:
        raise ScanError(f"{path} ends at byte {len(raw)}; its compressed data reach to byte {start + packed_size}")
    out = np.zeros(size, np.uint8)
    written = decompress(np.frombuffer(raw, np.uint8, packed_size, start), out)
    if written != size:
        at = start - 1 - written if written < 0 else start + packed_size
        raise ScanError(f"{path} byte {at}: the compressed data are damaged")
    columns: dict[str, npt.NDArray[Any]] = {}
    at = 0
    for name, kind, count in header.fields:  # field by field, not point by point
        length = header.points * count
        if count == 1:
            columns[name] = np.frombuffer(out, kind, length, at)
        at += length * int(kind[2:])
    return columns
