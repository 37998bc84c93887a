"""PyBullet and Embree: without the line that PyBullet prints, and with the install of either that is missing."""

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
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        f"the simulator wants {error.name}, which is not installed: pip install 'retracer[sim]' (Python 3.11)",
        name=error.name,
    ) from error
finally:
    ctypes.CDLL(None).fflush(None)  # the line waits in C's own buffer
    for _number, _copy in enumerate(_kept, 1):
        os.dup2(_copy, _number)
        os.close(_copy)
    os.close(_nowhere)

__all__ = ["EmbreeScene", "TriangleMesh", "pybullet"]
