"""The viewer that Rerun's wheel brings along: a window, or a web page. It listens on this machine only."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
import time
import urllib.parse
from pathlib import Path

import rerun as rr
import rerun_cli  # type: ignore[import-untyped]

HOST = "127.0.0.1"
PATIENCE = 30.0  # seconds that a viewer gets to start


class ViewerError(RuntimeError):
    """A viewer that does not come up, or a file that cannot be written."""


def has_display() -> bool:
    """Say whether a window could be seen: on Linux there is an X or Wayland display, elsewhere always."""
    return sys.platform != "linux" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


class Viewer:
    """A viewer in a process of its own. A window stays when we go; a web page goes with us, however we go.

    port: of the data. page: of the web page; None opens a window. Raises ViewerError if it does not start.
    """

    def __init__(self, port: int, *, page: int | None = None) -> None:
        self.url = f"rerun+http://{HOST}:{port}/proxy"
        self.address = f"http://{HOST}:{page}/?url={urllib.parse.quote(self.url, safe='')}" if page else ""
        command = [str(_program()), "--bind", HOST, "--port", str(port)]
        if page is None:
            command += ["--expect-data-soon"]
        else:
            command += ["--serve-web", "--web-viewer-port", str(page), "--server-memory-limit", "50%"]
            command = [sys.executable, str(Path(__file__).with_name("tether.py")), str(os.getpid()), *command]
        if taken := [wanted for wanted in (port, page) if wanted is not None and _answers(wanted)]:
            raise ViewerError(f"port {taken[0]} is taken by another program")
        with tempfile.TemporaryFile() as log:
            self.process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True
            )
            for wanted in (port, page):
                if wanted is not None and not self._listens(wanted):
                    self.close()
                    log.seek(0)
                    raise ViewerError(f"Rerun's viewer did not start: {_last_line(log.read())}")

    @property
    def alive(self) -> bool:
        """Say whether the viewer is still there."""
        return self.process.poll() is None

    def close(self) -> None:
        """End the viewer, and wait for it."""
        self.process.terminate()
        try:
            self.process.wait(timeout=5.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()

    def _listens(self, port: int) -> bool:
        deadline = time.monotonic() + PATIENCE
        while self.alive and time.monotonic() < deadline:
            if _answers(port):
                return True
            time.sleep(0.05)
        return False


def open_stream(name: str) -> rr.RecordingStream:
    """Return a stream that keeps what is drawn until `send_to` says where it goes; name: as the viewer shows it."""
    stream = rr.RecordingStream("retracer")
    stream.send_recording_name(name)
    return stream


def send_to(stream: rr.RecordingStream, *, url: str = "", file: Path | None = None) -> None:
    """Send a stream to a viewer, into an .rrd file, or both. Raises ViewerError if it cannot go there."""
    try:
        sinks = ([rr.GrpcSink(url)] if url else []) + ([rr.FileSink(file)] if file else [])
        stream.set_sinks(*sinks)
    except (OSError, RuntimeError) as error:
        raise ViewerError(f"{file or url}: {error}") from error


def finish(stream: rr.RecordingStream, *, patience: float) -> None:
    """Send what is still on its way, for at most so many seconds. Raises ViewerError if not all has arrived."""
    try:
        stream.flush(timeout_sec=patience)
    except RuntimeError as error:
        raise ViewerError(f"not all has reached the viewer: {error}") from error
    stream.disconnect()  # not after a failure: it would try for as long again


def _program() -> Path:
    """Find the viewer in the wheel: the very program, since a wrapper would outlive or hide it."""
    folder = Path(rerun_cli.__file__).parent
    places = ("rerun", "rerun.exe", "Rerun.app/Contents/MacOS/Rerun")
    found = [folder / place for place in places if (folder / place).is_file()]
    if not found:
        raise ViewerError(f"the installed rerun-sdk has no viewer: there is none in {folder}")
    return found[0]


def _answers(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((HOST, port)) == 0


def _last_line(text: bytes) -> str:
    lines = [line for line in text.decode(errors="replace").splitlines() if line.strip()]
    return lines[-1].strip() if lines else "it said nothing"
