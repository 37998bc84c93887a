"""Refined maps and buffers as files."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np

from operators.annotation.buffer import Buffer, Classing, KnownMap, known_map
from operators.pointmap import MapPoints, load_map, save_map
from operators.pointmap.ply import read_ply


def shared_map(path: Path, settings: Classing | None = None) -> KnownMap:
    """Load a refined map, ready to be searched; the last one is kept, since all sessions of a batch share it.

    Raises PlyError, or OSError without the file.
    """
    return _known(path, path.stat().st_mtime_ns, Classing() if settings is None else settings)


@functools.lru_cache(maxsize=1)
def _known(path: Path, changed: int, settings: Classing) -> KnownMap:
    return known_map(load_map(path), settings)


def save_buffer(path: Path, buffer: Buffer) -> None:
    """Write what a session saw besides the map as a PLY with classes; beside it the classes of the map, if its own."""
    save_map(path, buffer.new)
    beside = path.with_suffix(".npy")
    if buffer.known_labels is not buffer.known.labels:
        with beside.open("wb") as file:
            np.save(file, buffer.known_labels)


def load_buffer(path: Path, known: KnownMap, apart: float = 0.0) -> Buffer:
    """Read what `save_buffer` wrote. A session that saw nothing new has no points.

    apart: metres between its points and the nearest known one, at least, as far as that is known.
    """
    columns = read_ply(path)
    new = MapPoints(
        np.stack([columns[name] for name in ("x", "y", "z")], axis=1),
        np.stack([columns[name] for name in ("nx", "ny", "nz")], axis=1),
        columns["score"],
        columns["p_mov"],
        columns["class"],
    )
    beside = path.with_suffix(".npy")
    return Buffer(known, np.load(beside) if beside.exists() else known.labels, new, apart)
