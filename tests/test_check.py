"""Checking graphs: each broken graph of `broken_graphs/` says in its first lines what is wanted of the check.

`# wants LINE: sentence` a mistake, `# warns LINE: sentence` a warning, `# set:` and `# swap:` options of the command
line. A sentence that ends in ... may go on.
"""

from __future__ import annotations

import contextlib
import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import pytest

from graph.check import check, optional_inputs, require, same_type
from graph.contract import Operator
from graph.errors import UserError
from graph.graphfile import Draft, GraphError, Mistake, read_graph
from graph.loading import ConfigError, build_config, config_files, load_class
from tests.sample_operators import Counter, Late, Maybe, Settings

ROOT = Path(__file__).parent.parent
BROKEN = sorted((ROOT / "tests" / "broken_graphs").glob("*.yaml"))

GOOD = """\
clock: {end: counter}
operators:
  counter:
    run: tests.sample_operators:Counter
    inputs: {tick: timer/10hz}
    config: {last: 3}
  relay:
    run: tests.sample_operators:Relay
    inputs: {count: counter/count}
  adder:
    run: tests.sample_operators:Adder
    inputs: {left: counter/count, right: {from: adder_source/count, delay: 100ms}}
  adder_source:
    run: tests.sample_operators:Scans
  screen:
    run: tests.sample_operators:Screen
    inputs: {count: relay/count}
"""


@pytest.fixture
def good(tmp_path: Path) -> Path:
    """A graph without mistakes."""
    path = tmp_path / "good.yaml"
    path.write_text(GOOD)
    return path


@pytest.fixture(autouse=True)
def at_home(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, "path", list(sys.path))


def _orders(path: Path, word: str) -> list[tuple[int, str]]:
    found = re.findall(rf"^# {word}(?: (\d+))?: (.*)$", path.read_text(), re.MULTILINE)
    return [(int(line or 0), sentence) for line, sentence in found]


def _said(mistakes: list[Mistake]) -> list[tuple[int, str]]:
    """Return (line, sentence) of mistakes; those of an option begin with the option."""
    return [(m.line, str(m) if m.source.startswith("--") else m.text) for m in mistakes]


def _agree(said: list[tuple[int, str]], wanted: list[tuple[int, str]]) -> bool:
    if len(said) != len(wanted):
        return False
    pairs = zip(said, wanted, strict=True)
    return all(
        line == wanted_line and (text.startswith(want[:-3]) if want.endswith("...") else text == want)
        for (line, text), (wanted_line, want) in pairs
    )


def _options(path: Path) -> tuple[list[str], list[str]]:
    return [text for _, text in _orders(path, "set")], [text for _, text in _orders(path, "swap")]


@pytest.mark.parametrize("path", BROKEN, ids=lambda path: path.stem)
def test_every_mistake_of_a_broken_graph_is_named_with_its_line(path: Path) -> None:
    wants, warns = _orders(path, "wants"), _orders(path, "warns")
    assert wants or warns
    sets, swaps = _options(path)
    report = check(path, sets, swaps)
    assert _agree(_said(report.mistakes), wants), "\n".join(map(str, report.mistakes))
    assert _agree(_said(report.warnings), warns), "\n".join(map(str, report.warnings))
    if wants:
        with pytest.raises(GraphError) as caught:
            require(path, sets, swaps)
        assert str(caught.value).splitlines() == [str(mistake) for mistake in report.mistakes]
    else:
        assert require(path) == report.graph


def test_there_are_at_least_thirty_broken_graphs() -> None:
    assert len([path for path in BROKEN if _orders(path, "wants")]) >= 30


CLI = pytest.mark.skipif(importlib.util.find_spec("graph.cli") is None, reason="the command line is not there yet")


@CLI
@pytest.mark.parametrize("name", ["many", "not_yaml", "cycle_undelayed"])
def test_the_command_line_says_the_same_without_a_traceback(name: str) -> None:
    path = ROOT / "tests" / "broken_graphs" / f"{name}.yaml"
    done = subprocess.run(
        [sys.executable, "-m", "graph.cli", "check", str(path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    printed = done.stdout + done.stderr
    assert done.returncode != 0
    assert "Traceback" not in printed
    flat = " ".join(printed.split())
    for line, sentence in _orders(path, "wants"):
        assert f"{name}.yaml:{line}: {sentence.removesuffix('...')}" in flat


def test_a_good_graph_has_no_mistakes(good: Path) -> None:
    report = check(good)
    assert (report.mistakes, report.warnings) == ([], [])
    assert report.graph == read_graph(good) == require(good)
    assert check(require(good)).mistakes == []


def test_a_graph_that_is_no_file_is_checked_too(good: Path) -> None:
    graph = read_graph(good, sets=["counter.lst=3"], swaps=["relay=tests.sample_operators:Adder"])
    assert [str(mistake) for mistake in check(graph).mistakes] == [
        "good: counter.lst is not a known key; did you mean 'last'? There are last, start, step",
        "good: relay (Adder) has no input 'count'; there are left, right",
        "good: relay.left is not wired; it wants Count, as given by counter/count, adder_source/count",
        "good: relay.right is not wired; it wants Count, as given by counter/count, adder_source/count",
        "good: screen.count listens to 'relay/count'; relay (Adder) has no output 'count'; there is sum",
    ]


def test_a_good_swap_has_no_mistakes(good: Path) -> None:
    assert check(good, [], ["relay=tests.sample_operators:Slow"]).mistakes == []


def test_a_swapped_class_goes_without_what_only_the_former_knew(good: Path) -> None:
    operator = "{run: tests.sample_operators:Failing, inputs: {count: counter/count}, config: {at: 3, offset: 2}}"
    good.write_text(
        f"clock: {{end: counter}}\noperators:\n  counter: {{run: tests.sample_operators:Counter, inputs: "
        f"{{tick: timer/10hz}}}}\n  relay: {operator}\n"
    )
    report = check(good, [], ["relay=tests.sample_operators:Relay"])
    assert report.mistakes == []
    assert [str(mistake) for mistake in report.warnings] == [
        f"{good}:4: config relay.at was the former class's; relay (Relay) goes without"
    ]
    assert report.graph is not None
    assert report.graph.operators["relay"].config == {"offset": 2}
    told = check(good, ["relay.at=4"], ["relay=tests.sample_operators:Relay"])
    assert "relay.at is not a known key" in str(told.mistakes[0])


@pytest.mark.parametrize("clock", ["{mode: realtime}", "{duration: 1s}", "{duration: 1s, end: adder_source}"])
def test_a_graph_ends_as_it_says(good: Path, clock: str) -> None:
    good.write_text(GOOD.replace("{end: counter}", clock))
    assert check(good).mistakes == []


def test_only_undelayed_cycles_are_refused(good: Path) -> None:
    def feedback(delay: str) -> str:
        entry = f"{{tick: timer/10hz, back: {{from: feedback/count, delay: {delay}}}}}"
        operator = f"{{run: tests.sample_operators:Feedback, inputs: {entry}}}"
        return f"clock: {{duration: 1s}}\noperators:\n  feedback: {operator}\n"

    verdicts = {}
    for delay in ("0s", "99ms", "100ms"):
        good.write_text(feedback(delay))
        report = check(good)
        verdicts[delay] = (len(report.mistakes), len(report.warnings))
    assert verdicts == {"0s": (1, 0), "99ms": (0, 1), "100ms": (0, 0)}


def test_inputs_that_may_be_missing_are_annotated_so() -> None:
    assert optional_inputs(Late) == {"late"}
    assert optional_inputs(Maybe) == {"count"}
    assert optional_inputs(Counter) == frozenset()


def test_message_types_are_one_if_name_and_schema_are() -> None:
    def make(name: str, kind: type) -> type[msgspec.Struct]:
        return msgspec.defstruct(name, [("value", kind)], module="elsewhere")

    assert same_type(make("A", int), make("A", int))
    assert not same_type(make("A", int), make("A", float))
    assert not same_type(make("A", int), make("B", int))


MODULES = {
    "raises": ("x = {}\nx['a']\n", "raises cannot be imported: KeyError: 'a' ({folder}/raises.py:2)"),
    "exits": ("import sys\nsys.exit('no')\n", "exits cannot be imported: SystemExit: no ({folder}/exits.py:2)"),
    "unfinished": ("def f(:\n", "unfinished cannot be imported: SyntaxError: invalid syntax (unfinished.py, line 1)"),
    "lacking": (
        "\nimport no_such_package.inner\n",
        "lacking cannot be imported: it needs the module 'no_such_package', which is not installed"
        " ({folder}/lacking.py:2)",
    ),
    "renamed": (
        "from graph.messages import PointClouds\n",
        "renamed cannot be imported: ImportError: cannot import name 'PointClouds' from 'graph.messages' "
        f"({ROOT}/graph/messages.py) ({{folder}}/renamed.py:1)",
    ),
    "simulated": (
        "import pybullet\n",
        'simulated needs pybullet, which is not installed; install it with: pip install "retracer[sim]"',
    ),
    "rays": (
        "import embreex.mesh_construction\n",
        'rays needs embreex, which is not installed; install it with: pip install "retracer[sim]"',
    ),
    "seen": (
        "import rerun as rr\n",
        'seen needs rerun, which is not installed; install it with: pip install "retracer[view]"',
    ),
    "portless": (
        "from graph import Operator\nclass Robot(Operator):\n    def on_frame(self, frame): ...\n",
        "portless:Robot: Robot.on_frame wants exactly one annotated parameter, the message",
    ),
    "typeless": (
        "from __future__ import annotations\nfrom graph import Operator\nclass Robot(Operator):\n"
        "    def on_frame(self, frame: Frame) -> None: ...\n",
        "typeless:Robot: Robot.on_frame: name 'Frame' is not defined",
    ),
    "strange": (
        "from __future__ import annotations\nfrom graph import Operator\nclass Robot(Operator):\n"
        "    def on_frame(self, frame: 1 / 0) -> None: ...\n",
        "strange:Robot: its ports cannot be read: ZeroDivisionError: division by zero",
    ),
    "configless": (
        "from graph import Operator\nclass Robot(Operator):\n    Config = dict\n    def on_frame(self, frame): ...\n",
        "configless:Robot is no operator: its Config is no msgspec.Struct",
    ),
    "other": ("class Robots: ...\n", "other has no class 'Robot'; there are none"),
}


@pytest.mark.parametrize("name", MODULES)
def test_modules_that_cannot_be_used_are_one_sentence(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, sentence = MODULES[name]
    (tmp_path / f"{name}.py").write_text(source)
    for missing in ("pybullet", "embreex", "rerun"):
        monkeypatch.setitem(sys.modules, missing, None)
        for loaded in [module for module in sys.modules if module.startswith(f"{missing}.")]:
            monkeypatch.delitem(sys.modules, loaded)
    with pytest.raises(UserError) as caught:
        load_class(f"{name}:Robot", tmp_path)
    assert str(caught.value) == sentence.replace("{folder}", str(tmp_path))


def test_classes_are_found_beside_the_graph_and_within_classes(tmp_path: Path) -> None:
    (tmp_path / "beside.py").write_text(
        "from graph import Operator\nclass Robots:\n    class First(Operator):\n        pass\n"
    )
    assert load_class("beside:Robots.First", tmp_path).__name__ == "First"
    with pytest.raises(UserError, match="there is no module 'beside_'; did you mean 'beside'"):
        load_class("beside_:Robots", tmp_path)


def test_a_shared_package_makes_no_likeness() -> None:
    with pytest.raises(UserError, match=r"there is no module 'tests\.nothing_like_it'; there are tests\."):
        load_class("tests.nothing_like_it:Robot")


def test_the_robot_of_this_repository_has_no_mistakes() -> None:
    pytest.importorskip("operators.simulator", reason="its world wants the extra 'sim'")
    report = check(ROOT / "graph.yaml")
    assert [str(mistake) for mistake in (*report.mistakes, *report.warnings)] == []


@pytest.mark.parametrize("run", ["", "tests.sample_operators", ":Counter", "tests.sample_operators:"])
def test_what_is_no_class_name_is_refused(run: str) -> None:
    with pytest.raises(UserError, match="an operator is named module:Class"):
        load_class(run)


def test_configs_are_built_with_paths_from_the_folder_of_the_graph(tmp_path: Path) -> None:
    (tmp_path / "map.ply").write_text("")
    written = {"needed": 1, "map": "map.ply", "inner": {"file": "not/there.txt"}, "speed": 2, "by_name": {"3": 4}}
    config = build_config(Settings, written, tmp_path)
    assert config == Settings.Config(
        needed=1,
        speed=2.0,
        map=tmp_path / "map.ply",
        inner=msgspec.structs.replace(Settings.Config(needed=0).inner, file=Path("not/there.txt")),
        by_name={"3": 4.0},
    )
    assert isinstance(config.speed, float)
    assert config_files(config) == [tmp_path / "map.ply"]


def test_all_mistakes_of_a_config_are_named_by_key(tmp_path: Path) -> None:
    written: dict[str, Any] = {"speed": -1, "layers": [1, None], "inner": {"gian": 1}, "maps": "x"}
    with pytest.raises(ConfigError) as caught:
        build_config(Settings, written, tmp_path, operator="robot")
    assert caught.value.mistakes == [
        ("speed", "robot.speed wants float of at least 0.0; it was given -1"),
        ("layers.1", "robot.layers.1 wants int; it was given nothing"),
        ("inner.gian", "robot.inner.gian is not a known key; did you mean 'gain'? There are file, gain"),
        (
            "maps",
            "robot.maps is not a known key; did you mean 'map'?"
            " There are by_name, inner, layers, map, mode, needed, speed",
        ),
        ("needed", "robot.needed is missing; it wants int"),
    ]


class Choosy(Operator):
    """An operator whose settings must agree."""

    class Config(msgspec.Struct):
        low: int = 0
        high: int = 1
        pair: tuple[int, int] = (0, 0)

        def __post_init__(self) -> None:
            if self.low > self.high:
                raise ValueError("low must not exceed high")


def test_settings_that_do_not_agree_are_said_in_the_words_of_the_operator(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"^Choosy: low must not exceed high$"):
        build_config(Choosy, {"low": 3}, tmp_path)
    with pytest.raises(ConfigError, match=r"^Choosy.pair wants a list of 2: int, int; it was given a list$"):
        build_config(Choosy, {"pair": [1, 2, 3]}, tmp_path)


def test_files_of_a_config_are_listed_once_in_the_order_of_its_fields(tmp_path: Path) -> None:
    files = [tmp_path / name for name in "cab"]
    for file in files:
        file.write_text("")

    class Config(msgspec.Struct):
        first: Path
        many: list[Path]
        named: dict[str, Path]
        folder: Path

    assert config_files(Config(files[0], [files[1], files[0]], {"x": files[2]}, tmp_path)) == files


def test_drafts_keep_what_is_sound_for_further_checks(good: Path) -> None:
    good.write_text(GOOD.replace("timer/10hz", "timer/fast").replace("{last: 3}", "{lst: 3}"))
    draft = Draft(good)
    assert [mistake.line for mistake in draft.mistakes] == [5]
    with contextlib.suppress(GraphError):
        require(good)
    assert [mistake.line for mistake in check(good).mistakes] == [5, 6]
