"""Maps as PLY files that CloudCompare and Open3D open as they are."""

from __future__ import annotations

import gzip
import os
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from operators.pointmap.voxel_map import MapPoints

Columns = dict[str, npt.NDArray[Any]]

TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float": "f4", "double": "f8", "float32": "f4", "float64": "f8",
}  # fmt: skip
NAMES = {"f4": "float", "u1": "uchar"}
FORMATS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
PACKED, MAGIC = ".gz", b"\x1f\x8b"
COORDINATES, NORMALS = ("x", "y", "z"), ("nx", "ny", "nz")


class PlyError(ValueError):
    """A file that is not the PLY that was wanted: the message says what it is and what was wanted."""


def write_ply(path: Path, columns: Columns) -> None:
    """Write columns of one length (float32 or uint8) as the vertices of a binary little-endian PLY.

    A path that ends with .gz is packed. The file appears whole or not at all. Raises OSError when it cannot be written.
    """
    lengths = {len(column) for column in columns.values()}
    if len(lengths) != 1:
        raise ValueError(f"the columns of a PLY must be of one length; they are {sorted(lengths)}")
    kinds = [(name, column.dtype.str.lstrip("<|=")) for name, column in columns.items()]
    table = np.empty(lengths.pop(), [(name, f"<{kind}") for name, kind in kinds])
    for name, column in columns.items():
        table[name] = column
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    lines += [f"property {NAMES[kind]} {name}" for name, kind in kinds]
    raw = "\n".join([*lines, "end_header\n"]).encode("ascii") + table.tobytes()
    partial = path.with_name(f"{path.name}.part")
    try:
        with partial.open("wb") as file:
            file.write(gzip.compress(raw, mtime=0) if path.suffix == PACKED else raw)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError:
        partial.unlink(missing_ok=True)
        raise


def read_ply(path: Path) -> Columns:
    """Read the vertices of a PLY, ASCII or binary, packed by gzip or not, as columns by name.

    Raises PlyError, or OSError without the file.
    """
    raw = path.read_bytes()
    if raw.startswith(MAGIC):
        try:
            raw = gzip.decompress(raw)
        except (OSError, EOFError, zlib.error) as error:
            raise PlyError(f"{path} is packed by gzip, and damaged: {error}") from None
    head, mark, body = raw.partition(b"end_header")
    if not raw.startswith(b"ply") or not mark:
        raise PlyError(f"{path} is not a PLY file: it has no header from 'ply' to 'end_header'")
    body = body[body.find(b"\n") + 1 :]
    byte_order, count, kinds = read_header(path, head.decode("ascii", "replace").split("\n")[1:])
    dtype = np.dtype([(name, f"{byte_order}{kind}") for name, kind in kinds])
    if byte_order == "=":
        words = body.split()[: count * len(kinds)]
        if len(words) < count * len(kinds):
            raise PlyError(f"{path} ends after {len(words) // len(kinds)} of the {count} vertices that it announces")
        try:
            values = np.array(words, np.float64).reshape(count, len(kinds))
        except ValueError as error:
            raise PlyError(f"{path} holds a vertex that is not a number: {error}") from error
        return {name: values[:, n].astype(kind) for n, (name, kind) in enumerate(kinds)}
    if len(body) < count * dtype.itemsize:
        raise PlyError(f"{path} ends after {len(body) // dtype.itemsize} of the {count} vertices that it announces")
    table = np.frombuffer(body, dtype, count)
    return {name: np.ascontiguousarray(table[name], kind) for name, kind in kinds}


def read_header(path: Path, lines: list[str]) -> tuple[str, int, list[tuple[str, str]]]:
    """Return byte order ('=' for ASCII), number of vertices, and (name, dtype) of their properties."""
    byte_order, count, kinds = "", -1, []
    element = ""
    for words in (line.split() for line in lines):
        match words:
            case ["format", name, _] if name in FORMATS:
                byte_order = FORMATS[name]
            case ["format", *rest]:
                raise PlyError(f"{path} is a PLY of format {' '.join(rest)!r}; {', '.join(FORMATS)} can be read")
            case ["element", "vertex", number] if number.isdigit():
                element, count = "vertex", int(number)
            case ["element", name, *_]:
                if count < 0:
                    raise PlyError(f"{path} has the element {name!r} before its vertices; vertices must come first")
                element = name
            case ["property", "list", *_] if element == "vertex":
                raise PlyError(f"{path} has a list among the properties of its vertices; only numbers can be read")
            case ["property", kind, name] if element == "vertex":
                if kind not in TYPES:
                    raise PlyError(f"{path} has the property {name!r} of the unknown type {kind!r}")
                kinds.append((name.removeprefix("scalar_"), TYPES[kind]))  # CloudCompare's prefix
            case _:
                pass
    if not byte_order or count < 0 or not kinds:
        raise PlyError(f"{path} has a PLY header without format or vertices")
    return byte_order, count, kinds


def save_map(path: Path, cloud: MapPoints) -> None:
    """Write a map as PLY: x y z nx ny nz score p_mov class."""
    columns: Columns = {name: cloud.points[:, n] for n, name in enumerate(COORDINATES)}
    columns |= {name: cloud.normals[:, n] for n, name in enumerate(NORMALS)}
    columns["score"] = cloud.scores
    columns["p_mov"] = np.full(len(cloud.points), 0.5, np.float32) if cloud.movable is None else cloud.movable
    columns["class"] = np.zeros(len(cloud.points), np.uint8) if cloud.label is None else cloud.label
    write_ply(path, columns)


def load_map(path: Path) -> MapPoints:
    """Read a map from a PLY with normals; without scores every normal counts 1.

    Raises FileNotFoundError, PlyError when there are no coordinates, no normals, or numbers that are not finite.
    """
    columns = read_ply(path)
    for wanted, what in ((COORDINATES, "coordinates"), (NORMALS, "normals")):
        missing = [name for name in wanted if name not in columns]
        if missing:
            raise PlyError(
                f"{path} has no {what}: a map needs the properties {' '.join(wanted)}; it has {' '.join(columns)}"
            )
    points = np.stack([columns[name] for name in COORDINATES], axis=1).astype(np.float32)
    normals = np.stack([columns[name] for name in NORMALS], axis=1).astype(np.float32)
    scores = columns.get("score", np.ones(len(points))).astype(np.float32)
    if not len(points):
        raise PlyError(f"{path} is a map without points")
    if not (np.isfinite(points).all() and np.isfinite(normals).all() and np.isfinite(scores).all()):
        raise PlyError(f"{path} holds points, normals or scores that are not finite numbers")
    movable = columns["p_mov"].astype(np.float32) if "p_mov" in columns else None
    label = columns["class"].astype(np.uint8) if "class" in columns else None
    return MapPoints(points, normals, scores, movable, label)
