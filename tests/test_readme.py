"""The README keeps its word: its example runs, its commands exist, its links lead somewhere."""

from __future__ import annotations

import re
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest

from graph.cli import DOMAIN, RUNTIME, main
from graph.contract import ports_of
from graph.messages import Drive, PointCloud

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def test_the_operator_in_twenty_lines_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    code = next(block for block in re.findall(r"```python\n(.*?)```", README, re.DOTALL) if "class Brake" in block)
    module = types.ModuleType("brake")
    monkeypatch.setitem(sys.modules, "brake", module)
    exec(compile(code, "brake.py", "exec"), module.__dict__)
    ports = ports_of(module.Brake)
    assert ports.inputs == {"frame": PointCloud, "drive": Drive}
    brake = module.Brake()
    go = Drive(measured_at=0, linear=1.0, angular=0.2)
    assert brake.on_drive(go).drive.linear == 1.0
    brake.on_frame(PointCloud(measured_at=0, points=np.array([[0.4, 0.0, 0.0]], np.float32), base_from_lidar=np.eye(4)))
    assert brake.on_drive(go).drive.linear == 0.0
    assert brake.on_drive(go).drive.angular == 0.2


def test_commands_and_links_exist() -> None:
    for verb in re.findall(r"^retracer (\w+)", README, re.MULTILINE):
        assert verb in RUNTIME or verb in DOMAIN, verb
    for link in re.findall(r"\]\((?!http)([^)#]+)\)", README):
        assert (ROOT / link).exists(), link


@pytest.mark.parametrize("verb", [*RUNTIME, *DOMAIN])
def test_every_verb_helps_with_an_example(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main([verb, "--help"])
    assert left.value.code == 0
    assert f"retracer {verb}" in capsys.readouterr().out.split("usage:", 1)[1].split("\n", 1)[1]


def test_no_verb_and_an_unknown_one_are_said_in_a_line() -> None:
    for arguments in ([], ["lunch"]):
        done = subprocess.run(
            [sys.executable, "-m", "graph.cli", *arguments], cwd=ROOT, capture_output=True, text=True, check=False
        )
        assert done.returncode == 2
        assert "Traceback" not in done.stderr
