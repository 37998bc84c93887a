"""PyBullet, imported without the line that it prints."""

from __future__ import annotations

import ctypes
import os
import sys

sys.stdout.flush()
sys.stderr.flush()
_kept = os.dup(1), os.dup(2)
_nowhere = os.open(os.devnull, os.O_WRONLY)
os.dup2(_nowhere, 1)
os.dup2(_nowhere, 2)
try:
    import pybullet
finally:
    ctypes.CDLL(None).fflush(None)  # the line waits in C's own buffer
    for _number, _copy in enumerate(_kept, 1):
        os.dup2(_copy, _number)
        os.close(_copy)
    os.close(_nowhere)

__all__ = ["pybullet"]
