"""LZF decompression, as PCL compresses PCD files."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

Bytes = npt.NDArray[np.uint8]


@njit(cache=True)
def decompress(packed: Bytes, out: Bytes) -> int:
    """Decompress into `out`, which has exactly the size of what was packed.

    Returns the number of bytes written; or where the data are damaged -1 - the byte of `packed` at fault.
    Format: M. Lehmann's LibLZF; a control byte below 32 announces a run, else a reference back.
    """
    read, written, size = 0, 0, len(packed)
    while read < size:
        at = read
        control = int(packed[read])
        read += 1
        if control < 32:
            length = control + 1
            if read + length > size or written + length > len(out):
                return -1 - at
            for i in range(length):
                out[written + i] = packed[read + i]
            read += length
        else:
            length = control >> 5
            if length == 7:
                if read >= size:
                    return -1 - at
                length += int(packed[read])
                read += 1
            length += 2
            if read >= size:
                return -1 - at
            start = written - ((control & 31) << 8) - int(packed[read]) - 1
            read += 1
            if start < 0 or written + length > len(out):
                return -1 - at
            for i in range(length):  # byte by byte: a reference may reach into what it writes
                out[written + i] = out[start + i]
        written += length
    return written
