"""Scan files: KITTI .bin, PCD, PLY and NPZ, each read into a Scan."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from operators.pointmap.ply import PlyError, read_ply
from operators.scans.pcd import read_pcd
from operators.scans.scan import COORDINATES, RINGS, TIMES, Columns, Scan, ScanError, scan_of

KITTI_POINT = 16  # bytes: x, y, z, intensity as little-endian float32


def read_scan(path: Path, *, stamp: int | None = None) -> Scan:
    """Read one scan file by its suffix (see READERS).

    stamp: of the scan in ns, for files whose points carry a time of day. Raises ScanError, with the line or byte at
    fault, and OSError for a file that cannot be opened.
    """
    if (reader := READERS.get(path.suffix.lower())) is None:
        raise ScanError(f"{path} is no scan that can be read; {', '.join(READERS)} can")
    return scan_of(reader(path), str(path), stamp=stamp)


def read_kitti(path: Path) -> Columns:
    """Read a KITTI .bin file: float32 x, y, z, intensity. Raises ScanError if it ends amid a point."""
    raw = path.read_bytes()
    if len(raw) % KITTI_POINT:
        whole = len(raw) - len(raw) % KITTI_POINT
        raise ScanError(
            f"{path} byte {whole}: it ends amid a point; a KITTI .bin holds x, y, z, intensity as float32, "
            f"{KITTI_POINT} bytes a point, and this one has {len(raw)}"
        )
    table = np.frombuffer(raw, "<f4").reshape(-1, 4)
    return {axis: table[:, place] for place, axis in enumerate(COORDINATES)}


def read_vertices(path: Path) -> Columns:
    """Read the vertices of a PLY file, ASCII or binary. Raises ScanError."""
    try:
        return read_ply(path)
    except PlyError as error:
        raise ScanError(str(error)) from None


def read_npz(path: Path) -> Columns:
    """Read an .npz file: the array `points`, or the only array, (n, 3 or more); ring and time_offset (n,) if there.

    Raises ScanError that names the arrays it found.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ScanError(f"{path} is no .npz file of numbers: {' '.join(str(error).split())}") from None
    found = ", ".join(f"{name} {array.dtype} {array.shape}" for name, array in arrays.items()) or "no arrays"
    name = "points" if "points" in arrays else next(iter(arrays), "") if len(arrays) == 1 else ""
    if not name:
        raise ScanError(f"{path} wants an array 'points'; it has {found}")
    points = arrays[name]
    if points.ndim != 2 or points.shape[1] < 3 or points.dtype.kind not in "iuf":
        raise ScanError(f"{path} wants points as numbers of shape (n, 3) or (n, more); it has {found}")
    columns = {axis: points[:, place] for place, axis in enumerate(COORDINATES)}
    for field in (*RINGS, *TIMES):
        if field in arrays and field != name:
            if arrays[field].shape != (len(points),):
                raise ScanError(f"{path} wants {field} of shape ({len(points)},), one value a point; it has {found}")
            columns[field] = arrays[field]
    return columns


READERS: dict[str, Callable[[Path], Columns]] = {
    ".bin": read_kitti,
    ".pcd": read_pcd,
    ".ply": read_vertices,
    ".npz": read_npz,
}
