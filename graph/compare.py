"""Two messages of one type, field by field: where they differ first, and by how much at most."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np


class Difference(msgspec.Struct, frozen=True):
    """One field that differs: its path, the index of the first difference, both values, and the largest difference."""

    field: str
    index: tuple[int, ...]
    recorded: str
    replayed: str
    largest: float | None = None  # None where the values are no numbers
    share: float = 1.0  # of the entries that differ

    def __str__(self) -> str:
        place = f"[{', '.join(map(str, self.index))}]" if self.index else ""
        by = "" if self.largest is None else f", largest difference {self.largest:.3g}"
        return f"{self.field}{place} was {self.recorded}, is {self.replayed}{by}"


def differences(recorded: Any, replayed: Any, where: str = "") -> Iterator[Difference]:
    """Iterate over the fields in which two values differ; equal means equal bits, so that NaN equals NaN."""
    if isinstance(recorded, msgspec.Struct) and type(recorded) is type(replayed):
        for name in recorded.__struct_fields__:
            yield from differences(
                getattr(recorded, name), getattr(replayed, name), f"{where}.{name}" if where else name
            )
    elif isinstance(recorded, np.ndarray) and isinstance(replayed, np.ndarray):
        yield from _array_differences(recorded, replayed, where)
    elif isinstance(recorded, dict) and isinstance(replayed, dict) and recorded.keys() == replayed.keys():
        for key, value in recorded.items():
            yield from differences(value, replayed[key], f"{where}.{key}" if where else str(key))
    elif isinstance(recorded, (list, tuple)) and isinstance(replayed, (list, tuple)) and len(recorded) == len(replayed):
        for index, (old, new) in enumerate(zip(recorded, replayed, strict=True)):
            yield from differences(old, new, f"{where}[{index}]")
    elif not _same(recorded, replayed):
        numbers = all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in (recorded, replayed))
        largest = abs(float(replayed) - float(recorded)) if numbers else None
        yield Difference(where, (), _short(recorded), _short(replayed), largest)


def _same(old: Any, new: Any) -> bool:
    if isinstance(old, float) and isinstance(new, float):
        return np.float64(old).tobytes() == np.float64(new).tobytes()
    return type(old) is type(new) and bool(old == new)


def _array_differences(old: np.ndarray[Any, Any], new: np.ndarray[Any, Any], where: str) -> Iterator[Difference]:
    if old.shape != new.shape or old.dtype != new.dtype:
        yield Difference(where, (), f"{old.dtype} {old.shape}", f"{new.dtype} {new.shape}")
        return
    width = old.dtype.itemsize
    bits = [np.ascontiguousarray(values).reshape(-1).view(np.uint8).reshape(-1, width) for values in (old, new)]
    unequal = (bits[0] != bits[1]).any(axis=1)
    if not unequal.any():
        return
    first = np.unravel_index(int(np.argmax(unequal)), old.shape)
    with np.errstate(invalid="ignore", over="ignore"):  # infinity less infinity
        gap = np.abs(new.astype(np.complex128) - old.astype(np.complex128)).reshape(-1)[unequal]
    largest = float(np.nanmax(gap)) if np.isfinite(gap).any() else None
    index = tuple(int(place) for place in first)
    yield Difference(where, index, _short(old[first]), _short(new[first]), largest, float(unequal.mean()))


def _short(value: Any) -> str:
    text = repr(value.item() if isinstance(value, np.generic) else value)
    return text if len(text) <= 60 else text[:57] + "..."
