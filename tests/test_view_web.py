"""`retracer view --web` in a real browser, headless Chromium: the points are really drawn."""

from __future__ import annotations

import io
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rerun", reason="rerun-sdk is not installed (extra 'view')")
pytest.importorskip("playwright", reason="playwright is not installed (extra 'dev')")

from PIL import Image
from playwright.sync_api import Page, sync_playwright

from graph.inprocess import launch_in_process
from operators.views.palette import TRUTH, Colour
from tests.test_views import ROOT, graph_of

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = (
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)
PATIENCE = 150.0  # seconds; a software renderer on a busy machine is slow

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed (Debian: apt-get install chromium)"),
]


@contextmanager
def served(recording: Path) -> Iterator[str]:
    """Serve a recording with the command, as a user would, and yield the address that it prints."""
    command = [sys.executable, "-m", "graph.cli", "view", str(recording), "--web"]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        found = next((match for line in process.stdout if (match := re.search(r"http://\S+", line))), None)
        assert found is not None, "no address was printed"
        yield found[0]
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=30.0) == 0
    finally:
        process.kill()
        process.wait()


@contextmanager
def browser() -> Iterator[Page]:
    """Open a page in headless Chromium, which draws in software."""
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        yield chromium.new_page(viewport={"width": 1200, "height": 800}, color_scheme="dark")
        chromium.close()


def pixels(page: Page) -> np.ndarray:
    """Take a picture of the page: (rows, columns, 3)."""
    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(int)


def amount(picture: np.ndarray, colour: Colour) -> int:
    """Count the pixels of a colour in the left part, where the world is and above the legend."""
    world = picture[60:680, :800]
    return int((np.abs(world - colour).max(axis=-1) <= 6).sum())


def recorded(folder: Path, points: int) -> Path:
    """Record a toy robot that sees so many points."""
    file = folder / f"toy{points}.mcap"
    launch_in_process(graph_of("toy", "tests.toy_robot:ToyRobot", ticks=3, points=points), record=file)
    return file


def test_the_points_are_really_drawn(tmp_path: Path) -> None:
    table, wall, still = TRUTH[4].colour, TRUTH[2].colour, TRUTH[7].colour
    with browser() as page, served(recorded(tmp_path, 20_000)) as address:
        page.goto(f"{address}&renderer=webgl")
        deadline = time.monotonic() + PATIENCE
        while amount(picture := pixels(page), table) < 300 and time.monotonic() < deadline:
            page.wait_for_timeout(2000)
    assert amount(picture, table) >= 300
    assert amount(picture, wall) >= 1000
    with browser() as page, served(recorded(tmp_path, 0)) as address:
        page.goto(f"{address}&renderer=webgl")
        deadline = time.monotonic() + PATIENCE
        while amount(picture := pixels(page), still) < 20 and time.monotonic() < deadline:
            page.wait_for_timeout(2000)
    assert amount(picture, still) >= 20, "the world of the recording without points is not drawn at all"
    assert amount(picture, table) == 0
    assert amount(picture, wall) == 0
