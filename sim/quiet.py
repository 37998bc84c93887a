"""PyBullet, imported without the line that it prints to standard output, where a script may want JSON."""

from __future__ import annotations

import ctypes
import os
import sys

sys.stdout.flush()
_kept = os.dup(1)
_nowhere = os.open(os.devnull, os.O_WRONLY)
os.dup2(_nowhere, 1)
try:
    import pybullet
finally:
    ctypes.CDLL(None).fflush(None)  # the line waits in C's own buffer
    os.dup2(_kept, 1)
    os.close(_kept)
    os.close(_nowhere)

__all__ = ["pybullet"]
