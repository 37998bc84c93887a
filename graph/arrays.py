"""Numpy arrays as fields of messages: dtype, shape, unit and frame are part of the type."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

ALIGNMENT = 64  # bytes; numba and BLAS take other paths, and sum to other bits, on unaligned data

Array = npt.NDArray[Any]


class ArraySpec(NamedTuple):
    """Dtype and shape that a field demands; a string in the shape is a length shared within the message."""

    dtype: str
    shape: tuple[int | str, ...]

    def __str__(self) -> str:
        inner = ", ".join(str(length) for length in self.shape)
        return f"{self.dtype} ({inner}{',' if len(self.shape) == 1 else ''})"


def array(dtype: str, *shape: int | str, unit: str = "", frame: str = "", about: str = "") -> msgspec.Meta:
    """Describe an array field: `points: Annotated[Array, array("float32", "n", 3, unit="m", frame="lidar")]`.

    dtype: a numpy dtype name. shape: lengths; a string names a length that all fields of one message share.
    unit, frame: shown in the schema of the recording. The description is checked at encode and at decode.
    """
    np.dtype(dtype)
    extra: dict[str, Any] = {"x-dtype": dtype, "x-shape": list(shape)}
    if unit:
        extra["x-unit"] = unit
    if frame:
        extra["x-frame"] = frame
    return msgspec.Meta(description=about or None, extra_json_schema=extra)


def unit(name: str, *, frame: str = "", about: str = "") -> msgspec.Meta:
    """Describe the unit (and frame) of a scalar field, for the schema of the recording."""
    extra = {"x-unit": name} | ({"x-frame": frame} if frame else {})
    return msgspec.Meta(description=about or None, extra_json_schema=extra)


def spec_of(meta: object) -> ArraySpec | None:
    """Return the array description carried by an annotation of `array`, else None."""
    extra = getattr(meta, "extra_json_schema", None) or {}
    if "x-dtype" not in extra:
        return None
    return ArraySpec(extra["x-dtype"], tuple(extra["x-shape"]))


def aligned_copy(raw: memoryview | bytes, dtype: np.dtype[Any], shape: tuple[int, ...]) -> Array:
    """Copy raw little-endian C-order bytes into a 64-byte aligned, read-only array.

    Raises ValueError if the bytes do not fill the shape exactly.
    """
    size = math.prod(shape) * dtype.itemsize
    if len(raw) != size:
        raise ValueError(f"{len(raw)} bytes do not make a {dtype.name} array of shape {shape}, which takes {size}")
    buffer = np.empty(size + ALIGNMENT, np.uint8)
    start = -buffer.ctypes.data % ALIGNMENT
    buffer.data[start : start + size] = raw
    result = np.ndarray(shape, dtype, buffer, start)
    result.flags.writeable = False
    return result
