"""Thread counts of the numeric libraries: fixed per operator, since they decide the bits of a sum."""

from __future__ import annotations

import functools
import os
import sys

from threadpoolctl import ThreadpoolController

VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def environment(threads: int) -> dict[str, str]:
    """Return the environment variables that give a new process its thread count."""
    return dict.fromkeys(VARIABLES, str(threads))


@functools.lru_cache(maxsize=8)
def _controller(loaded: frozenset[str]) -> ThreadpoolController:
    return ThreadpoolController()  # scans the loaded libraries; so once, and again when one more is there


def set_threads(threads: int) -> None:
    """Give numba, torch and BLAS of this process a thread count; those not loaded are left alone."""
    loaded = frozenset(name for name in ("numpy", "scipy", "torch", "numba", "sklearn") if name in sys.modules)
    _controller(loaded).limit(limits=threads)
    if (numba := sys.modules.get("numba")) is not None:
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
    if (torch := sys.modules.get("torch")) is not None and torch.get_num_threads() != threads:
        torch.set_num_threads(threads)


def allow_threads(threads: int) -> None:
    """Let numba use up to so many threads in this process; only before numba is imported."""
    os.environ.setdefault("NUMBA_NUM_THREADS", str(max(threads, os.cpu_count() or 1)))
