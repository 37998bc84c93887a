"""The one line of live status: stamp, speed against real time, rate and latency of each operator."""

from __future__ import annotations

import contextlib
import shutil
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TextIO

import numpy as np
from rich.console import Console
from rich.progress import Progress

REFRESH = 0.25  # seconds on a terminal
QUIET_REFRESH = 10.0  # seconds where output goes to a file
COMPILING = 3.0  # seconds without any progress after which the line says why
WINDOW = 200  # calls over which the shown latency is taken


@contextlib.contextmanager
def progress_bar(text: str, *, quiet: bool = False) -> Iterator[Callable[[float], None]]:
    """Show a bar on stderr for a `with` block, which is given a function to call with the share that is done."""
    console = Console(stderr=True)
    with Progress(console=console, disable=quiet or not console.is_terminal, transient=True) as bar:
        task = bar.add_task(text, total=1.0)
        yield lambda share: bar.update(task, completed=share)


class StatusLine:
    """Collects the operators' reports and redraws one line; other text goes above it. Thread-safe in `say`."""

    def __init__(self, names: Sequence[str], *, stream: TextIO | None = None, quiet: bool = False) -> None:
        self.names = list(names)
        self.stream = stream or sys.stderr
        self.quiet = quiet
        self.live = self.stream.isatty()
        self.phase = "starting"
        self.began = time.monotonic()
        self.shown_at = 0.0 if self.live else time.monotonic() - QUIET_REFRESH + 2.0
        self.drawn = False
        self.lock = threading.Lock()
        self.stamps = dict.fromkeys(self.names, 0)
        self.steps = dict.fromkeys(self.names, 0)
        self.skipped = dict.fromkeys(self.names, 0)
        self.recent: dict[str, deque[int]] = {name: deque(maxlen=WINDOW) for name in self.names}
        self.durations: dict[str, list[int]] = {name: [] for name in self.names}

    def begin(self) -> None:
        """Note that the run proper begins now."""
        self.began, self.phase = time.monotonic(), ""

    def take(self, name: str, stamp: int, steps: int, durations: Sequence[int], skipped: int) -> None:
        """Take one report: the stamp of the last call, calls so far, durations (ns) since the last report."""
        self.stamps[name] = max(stamp, self.stamps[name])
        self.steps[name] = steps
        self.skipped[name] = skipped
        self.recent[name].extend(durations)
        self.durations[name].extend(durations)

    def line(self) -> str:
        """Compose the line."""
        if self.phase:
            return self.phase
        wall = max(time.monotonic() - self.began, 1e-9)
        stamp = max(self.stamps.values(), default=0) / 1e9
        if stamp == 0 and wall > COMPILING:
            return f"{wall:5.0f} s in the first calls: numba compiles, once on a machine"
        parts = [f"{stamp:7.1f} s  {stamp / wall:4.1f} x real time"]
        for name in self.names:
            if recent := self.recent[name]:
                slow = (
                    np.percentile(recent, 95) / 1e6
                )  # the calls that matter: a median would be that of the small ones
                parts.append(f"{name} {self.steps[name] / wall:.0f}/s {slow:.1f} ms")
        return " | ".join(parts)

    def show(self, *, force: bool = False) -> None:
        """Redraw, if it is time."""
        now = time.monotonic()
        if self.quiet or (not force and now - self.shown_at < (REFRESH if self.live else QUIET_REFRESH)):
            return
        self.shown_at = now
        with self.lock:
            if self.live:
                width = shutil.get_terminal_size().columns - 1
                self.stream.write(f"\r\x1b[2K{self.line()[:width]}")
                self.drawn = True
            else:
                self.stream.write(self.line() + "\n")
            self.stream.flush()

    def say(self, text: str) -> None:
        """Print a line of text above the status."""
        with self.lock:
            self.stream.write(("\r\x1b[2K" if self.drawn else "") + text + "\n")
            self.drawn = False
            self.stream.flush()

    def close(self) -> None:
        """Leave the terminal on a fresh line."""
        with self.lock:
            if self.drawn:
                self.stream.write("\r\x1b[2K")
                self.stream.flush()

    def statistics(self) -> dict[str, dict[str, Any]]:
        """Return, for each operator: steps, p50_ms and p95_ms of its calls, and messages skipped."""
        return {
            name: {
                "steps": self.steps[name],
                "p50_ms": round(float(np.percentile(self.durations[name], 50)) / 1e6, 3)
                if self.durations[name]
                else 0.0,
                "p95_ms": round(float(np.percentile(self.durations[name], 95)) / 1e6, 3)
                if self.durations[name]
                else 0.0,
                "skipped": self.skipped[name],
            }
            for name in self.names
        }
