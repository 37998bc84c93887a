"""What ties a process to the one that started it: an operator to its launcher, a verb to the verb that runs it."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading

import msgspec

from graph.words import Boot

BOUND = "RETRACER_BOUND"  # in the environment of a verb that shall end with the process that runs it


def end_with_parent(how: signal.Signals) -> None:
    """Let the system send this process a signal when its parent ends, even while native code runs. Linux only."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(1, how)  # PR_SET_PDEATHSIG


def end_if_bound() -> None:
    """Tie this process to its parent if the environment says so; what it starts itself is not tied by that."""
    if os.environ.pop(BOUND, None):
        end_with_parent(signal.SIGTERM)


def outlive_nobody() -> None:
    """End this process when the launcher is gone, even if that was killed: its end of our stdin closes."""

    def watch() -> None:
        while os.read(0, 1):
            pass
        os._exit(3)

    end_with_parent(signal.SIGKILL)  # also while a long call holds the interpreter
    threading.Thread(target=watch, daemon=True).start()


def read_boot() -> Boot:
    """Read the one line that the launcher writes, unbuffered, so that the pipe can be watched afterwards."""
    line = bytearray()
    while not line.endswith(b"\n"):
        byte = os.read(0, 65536)
        if not byte:
            raise SystemExit(3)
        line += byte
    return msgspec.json.decode(line, type=Boot)
