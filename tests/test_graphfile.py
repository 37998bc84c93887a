"""Graph files: what is written is what is read, in the file, on the command line and in recordings."""

from __future__ import annotations

import json
import string
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graph.durations import duration_text, nanoseconds, timer_period
from graph.errors import UserError
from graph.graphfile import (
    Clock,
    Draft,
    Edge,
    Graph,
    GraphError,
    OperatorEntry,
    from_dict,
    json_schema,
    read_graph,
    to_dict,
    to_yaml,
)
from graph.yamlfile import Tree, dump

ROOT = Path(__file__).parent.parent

ROBOT = """\
clock: {mode: lockstep, pace: max, end: simulator}
operators:
  simulator:
    run: operators.simulator:Simulator
    inputs: {tick: timer/10hz, drive: {from: planner/drive, delay: 100ms}}
    config: {building: sim/buildings/default.yaml, scenario: easy, tour: A, seed: 1}
  segmenter:
    run: operators.segmenter:Segmenter
    inputs: {frame: simulator/frame}
    threads: 2
    record: {classified: digest}
  planner:
    run: operators.planner:Planner
    inputs:
      frame: {from: segmenter/classified, queue: latest}
      slow: timer/0.5hz
    restart: on-failure
    record: digest
"""

names = st.text(string.ascii_letters + "_", min_size=1, max_size=8).filter(lambda name: name not in ("timer", "clock"))
times = st.integers(0, 10**15)
scalars = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
    | st.sampled_from(
        ["on", "yes", "1e-3", "10:30", "~", "<<", "0x1f", "2020-01-01", "- a", "a: b", "#", "null", ".inf"]
    )
)
keys = st.text(st.characters(exclude_categories=["Cs"]), max_size=5)
values = st.recursive(
    scalars, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(keys, inner, max_size=3), max_leaves=5
)
edges = st.builds(
    Edge, operator=names, port=names, delay=times, queue=st.just("latest") | st.integers(1, 100)
) | st.builds(Edge, operator=st.just("timer"), port=st.sampled_from(["10hz", "0.5hz", "100ms"]))
levels = st.sampled_from(["full", "digest"])
entries = st.builds(
    OperatorEntry,
    run=st.builds("{}.{}:{}".format, names, names, names),
    inputs=st.dictionaries(names, edges, max_size=3),
    config=st.dictionaries(keys, values, max_size=3),
    threads=st.integers(1, 64),
    restart=st.sampled_from(["never", "on-failure"]),
    record=levels | st.dictionaries(names, levels, max_size=2),
)
clocks = st.builds(
    Clock,
    mode=st.sampled_from(["lockstep", "realtime"]),
    pace=st.sampled_from(["max", "realtime"]),
    duration=st.none() | st.integers(1, 10**15),
    end=st.none() | names,
    ahead=st.integers(1, 10**15),
)
graphs = st.builds(
    Graph,
    clock=clocks,
    operators=st.dictionaries(names, entries, min_size=1, max_size=4),
    name=st.just("robot"),
    root=st.just("/robots"),
)


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    """A graph file as people write them."""
    path = tmp_path / "robot.yaml"
    path.write_text(ROBOT)
    return path


def test_a_graph_file_means_what_it_says(robot: Path) -> None:
    graph = read_graph(robot)
    assert list(graph.operators) == ["simulator", "segmenter", "planner"]
    assert graph.clock == Clock(end="simulator")
    assert (graph.name, graph.root) == ("robot", str(robot.parent.resolve()))
    simulator, segmenter, planner = graph.operators.values()
    assert simulator.inputs["drive"] == Edge("planner", "drive", 100_000_000)
    assert simulator.inputs["tick"].period == 100_000_000
    assert simulator.inputs["drive"].period is None
    assert simulator.config == {"building": "sim/buildings/default.yaml", "scenario": "easy", "tour": "A", "seed": 1}
    assert (segmenter.threads, segmenter.record) == (2, {"classified": "digest"})
    assert planner.inputs["frame"].queue == "latest"
    assert planner.inputs["slow"].period == 2_000_000_000
    assert (planner.restart, planner.record) == ("on-failure", "digest")


@settings(max_examples=50)
@given(graphs)
def test_recordings_hold_graphs_exactly(graph: Graph) -> None:
    again = from_dict(json.loads(json.dumps(to_dict(graph))))
    assert again == graph
    assert list(again.operators) == list(graph.operators)


@settings(max_examples=50)
@given(graph=graphs)
def test_written_graphs_are_read_back_equal(tmp_path_factory: pytest.TempPathFactory, graph: Graph) -> None:
    path = tmp_path_factory.getbasetemp() / "robot.yaml"
    path.write_text(to_yaml(graph))
    again = read_graph(path)
    assert list(again.operators) == list(graph.operators)
    again.root = graph.root
    assert again == graph


@given(values)
def test_yaml_is_read_as_it_was_written(value: Any) -> None:
    assert json.dumps(Tree(dump(value)).data) == json.dumps(value)  # tells 1 from 1.0 and from true


@given(st.data())
def test_damaged_files_are_mistakes_and_never_crashes(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    start = data.draw(st.integers(0, len(ROBOT)))
    end = data.draw(st.integers(start, min(len(ROBOT), start + 40)))
    junk = data.draw(st.text(st.sampled_from("{}[]:,-&*!|>'\"\\#\t\n <ab0?"), max_size=6))
    path = tmp_path_factory.getbasetemp() / "damaged.yaml"
    path.write_text(ROBOT[:start] + junk + ROBOT[end:])
    mistakes = Draft(path).mistakes
    for mistake in mistakes:
        assert mistake.text
        assert 0 <= mistake.line <= path.read_text().count("\n") + 2
    if not mistakes:
        from_dict(to_dict(read_graph(path)))


@pytest.mark.parametrize(
    ("text", "data"),
    [
        ("yes", "yes"),
        ("on: 1", {"on": 1}),
        ("1e-3", 0.001),
        ("10:30", "10:30"),
        ("1_000", "1_000"),
        ("0x1F", 31),
        ("0o17", 15),
        ("010", 10),
        ("+3", 3),
        (".5", 0.5),
        ("2001-01-01", "2001-01-01"),
        ("3: a", {"3": "a"}),
        ("base: &b {x: 1, y: 2}\nown: {<<: *b, y: 3}", {"base": {"x": 1, "y": 2}, "own": {"x": 1, "y": 3}}),
    ],
)
def test_scalars_follow_yaml_1_2(text: str, data: Any) -> None:
    tree = Tree(text)
    assert tree.data == data
    assert not tree.flaws


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("100ms", 10**8),
        ("1s", 10**9),
        ("90s", 90 * 10**9),
        ("2min", 120 * 10**9),
        ("1.5h", 5400 * 10**9),
        ("0.1us", 100),
        (0.1, 10**8),
        (1e-9, 1),
        (3, 3 * 10**9),
    ],
)
def test_durations_are_exact(text: str | float, expected: int) -> None:
    assert nanoseconds(text) == expected


@given(st.integers(0, 10**18 - 1))  # 31 years
def test_durations_are_written_exactly(value: int) -> None:
    assert nanoseconds(duration_text(value)) == value


@pytest.mark.parametrize("text", ["", "s", "10", "-1s", "1 s", "1e3s", "10 parsecs", "1.s"])
def test_what_is_no_duration_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="a duration is such as 100ms"):
        nanoseconds(text)


@pytest.mark.parametrize(
    ("port", "period"),
    [("10hz", 10**8), ("0.5hz", 2 * 10**9), ("3hz", 333_333_333), ("100ms", 10**8), ("2min", 120 * 10**9)],
)
def test_timers_have_periods(port: str, period: int) -> None:
    assert timer_period(port) == period


@pytest.mark.parametrize("port", ["0hz", "fast", "-1hz", "10Hz", "0.0ms", "10"])
def test_what_is_no_timer_is_refused(port: str) -> None:
    with pytest.raises(ValueError, match="a timer is such as timer/10hz"):
        timer_period(port)


def test_the_command_line_overrides_configs_clock_and_classes(robot: Path) -> None:
    sets = [
        "simulator.seed=7",
        "simulator.new.deep=[1, x]",
        "clock.duration=10s",
        "planner.speed=1e-1",
        "planner.none=",
    ]
    graph = read_graph(robot, sets=sets, swaps=["planner=my.package:Best"])
    assert graph.operators["simulator"].config["seed"] == 7
    assert graph.operators["simulator"].config["new"] == {"deep": [1, "x"]}
    assert graph.clock.duration == 10 * 10**9
    assert graph.operators["planner"].config == {"speed": 0.1, "none": None}
    assert graph.operators["planner"].run == "my.package:Best"


def test_options_at_fault_are_named_instead_of_a_line(robot: Path) -> None:
    with pytest.raises(GraphError) as caught:
        read_graph(robot, sets=["simulator.seed.x=1", "clock.paec=max", "a.b"], swaps=["planner.x=a:B"])
    assert str(caught.value).splitlines() == [
        "--set simulator.seed.x=1: simulator.seed is no mapping",
        "--set a.b: --set wants operator.key=value",
        "--swap planner.x=a:B: --swap wants operator=module:Class",
        "--set clock.paec=max: clock.paec is not a known key; did you mean 'pace'?"
        " There are ahead, duration, end, mode, pace",
    ]


def test_a_graph_error_is_one_line_a_mistake_in_the_order_of_the_file(robot: Path) -> None:
    robot.write_text(ROBOT.replace("threads: 2", "threads: two").replace("mode: lockstep", "mode: lock"))
    with pytest.raises(GraphError) as caught:
        read_graph(robot)
    assert str(caught.value).splitlines() == [
        f"{robot}:1: clock.mode wants 'lockstep' or 'realtime'; it was given 'lock'",
        f"{robot}:10: segmenter.threads wants a whole number of at least 1; it was given 'two'",
    ]
    assert [(mistake.line, mistake.column) for mistake in caught.value.mistakes] == [(1, 15), (10, 14)]


def test_files_that_cannot_be_read_are_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "graph.yaml").write_text(ROBOT)
    (tmp_path / "latin.yaml").write_bytes("clock: {end: \xe4}".encode("latin-1"))
    (tmp_path / "zero.yaml").write_bytes(b"clock: 1\nb: \0\n")
    (tmp_path / "empty.yaml").write_bytes(b"")
    (tmp_path / "deep.yaml").write_text("[" * 20_000)
    (tmp_path / "bomb.yaml").write_text(
        "a0: &a0 [x, x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 30))
    )
    expected = {
        "grahp.yaml": "there is no such file; did you mean 'graph.yaml'? There are",
        "": "this is a directory; a YAML file is wanted; there are",
        "latin.yaml": "not text: byte 13 is not UTF-8",
        "zero.yaml": "zero.yaml:2: not YAML: it holds the character",
        "empty.yaml": "the file is empty; a graph has operators and a clock",
        "deep.yaml": "nested too deeply",
        "bomb.yaml": "more than 100000 values, aliases counted",
    }
    for name, sentence in expected.items():
        with pytest.raises(GraphError) as caught:
            read_graph(tmp_path / name)
        assert sentence in str(caught.value)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda data: data["clock"].update(ende=1), "the graph's clock.ende is not a known key; did you mean 'end'?"),
        (lambda data: data.pop("name"), "the graph's name is missing; it wants str"),
        (lambda data: data["operators"]["planner"].pop("run"), "the graph's operators.planner.run is missing"),
        (
            lambda data: data["operators"]["planner"].update(threads="x"),
            "operators.planner.threads wants int; it was given 'x'",
        ),
        (lambda data: data["operators"]["planner"]["inputs"]["slow"].update(port="x"), "this is timer/x"),
        (lambda data: data.update(operators=[]), "the graph's operators wants a mapping; it was given an empty list"),
    ],
)
def test_recorded_graphs_that_do_not_fit_are_refused_by_the_field(robot: Path, change: Any, sentence: str) -> None:
    data = to_dict(read_graph(robot))
    change(data)
    with pytest.raises(UserError) as caught:
        from_dict(data)
    assert sentence in str(caught.value)


def test_older_recordings_may_lack_what_has_a_default(robot: Path) -> None:
    graph = read_graph(robot)
    data = to_dict(graph)
    del data["operators"]["simulator"]["restart"]
    assert from_dict(data) == graph


@pytest.mark.parametrize(
    "path", [path for path in sorted(ROOT.glob("*.yaml")) if "operators:" in path.read_text()], ids=str
)
def test_the_schema_accepts_the_graphs_of_this_repository(path: Path) -> None:
    jsonschema.validate(Tree(path.read_text()).data, json_schema())


def test_the_schema_accepts_and_refuses_what_reading_does(robot: Path) -> None:
    validator = jsonschema.Draft202012Validator(json_schema())
    assert validator.is_valid(Tree(ROBOT).data)
    for old, new in [
        ("threads: 2", "threads: two"),
        ("threads: 2", "threads: 0"),
        ("threads: 2", "treads: 2"),
        ("mode: lockstep", "mode: fast"),
        ("timer/10hz", "timer/fast"),
        ("timer/10hz", "timer/0hz"),
        ("delay: 100ms", "delay: -100ms"),
        ("queue: latest", "queue: 0"),
        ("queue: latest", "queue: last"),
        ("from: planner/drive", "form: planner/drive"),
        ("  planner:", "  2nd:"),
        ("  planner:", "  timer:"),
        ("run: operators.planner:Planner", "run: operators.planner.Planner"),
        ("end: simulator", "duration: 0s"),
        ("end: simulator", "ahead: soon"),
    ]:
        text = ROBOT.replace(old, new)
        assert text != ROBOT
        assert not validator.is_valid(Tree(text).data), new
        robot.write_text(text)
        with pytest.raises(GraphError):
            read_graph(robot)
