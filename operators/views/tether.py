"""Run a program that dies with its parent: `python tether.py PARENT PROGRAM ARGUMENT...`, PARENT being a process id.

A process that is killed cannot take its children along; on Linux the kernel does that, where a child has asked for it.
"""

import ctypes
import os
import signal
import sys

_SET_PARENT_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG of prctl(2); it outlives exec


def main() -> None:
    """Ask for the signal, make sure that the parent was still there by then, and become the program."""
    parent, program = int(sys.argv[1]), sys.argv[2:]
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL)
    if os.getppid() == parent:
        os.execv(program[0], program)


if __name__ == "__main__":
    main()
