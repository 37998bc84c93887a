"""What ties the process of an operator to its launcher: the pipe at its stdin."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading

import msgspec

from graph.words import Boot


def outlive_nobody() -> None:
    """End this process when the launcher is gone, even if that was killed: its end of our stdin closes."""

    def watch() -> None:
        while os.read(0, 1):
            pass
        os._exit(3)

    if sys.platform == "linux":  # also while a long call of native code holds the interpreter
        ctypes.CDLL(None, use_errno=True).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
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
