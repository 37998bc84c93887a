"""The rounds: seeds, graphs of sessions, what is counted, the report, and runs that are cut and go on."""

from __future__ import annotations

import argparse
import json
import shutil
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import matplotlib.cbook
import numpy as np
import pytest
import yaml

from graph.check import check
from graph.errors import UserError
from operators.rounds import experiment_command, rounds_command, session_command
from operators.rounds.experiment_command import Experiment
from operators.rounds.report import page, summarize
from operators.rounds.schedule import SCENARIOS, Schedule, Session
from operators.rounds.tally import Track, box, driven_into, driving, poisson_interval, success_table
from operators.rounds.variants import listening_graph, session_graph, written

ROOT = Path(__file__).parents[1]
BUILDING = str(ROOT / "operators" / "rounds" / "cabin.yaml")


def test_sixty_sessions_and_those_with_people_predicted_have_seeds_of_their_own():
    groups = Schedule(rounds=4).groups()
    assert [len(group) for group in groups] == [12] * 6 + [4]
    assert sum(len(group) for group in groups[:5]) == 60
    sessions = [Schedule(rounds=4).mapping(), *(session for group in groups for session in group)]
    others = [session for group in Schedule(rounds=4, seed=2).groups() for session in group]
    seeds = [session.seed for session in sessions + others]
    assert len(set(seeds)) == len(seeds)
    assert len({session.name for session in sessions}) == len(sessions)


def test_labels_are_none_then_the_networks_then_true():
    groups = Schedule(rounds=3).groups()
    assert [{session.labels for session in group} for group in groups] == [
        {"none"},
        {"network"},
        {"network"},
        {"truth"},
        {"network"},
        {"network"},
    ]
    assert {session.people for group in [*groups[:-2], groups[-1]] for session in group} == {"ignore"}
    assert {session.people for session in groups[-2]} == {"predict"}


def test_another_lidar_drives_one_tour_of_each_scenario():
    sessions = Schedule(rounds=2).lidar()
    assert [(session.scenario, session.tour) for session in sessions] == [(name, "A") for name in SCENARIOS]
    assert Schedule(rounds=1).lidar() == []


def test_hardest_tours_can_be_driven_again():
    sessions = Schedule(rounds=1, repeats=4).predict()
    assert len(sessions) == 12 + 3 * 3
    assert {session.scenario for session in sessions[12:]} == {"extreme"}
    assert len({session.seed for session in sessions}) == len({session.name for session in sessions}) == 21


@pytest.mark.parametrize("labels", ["none", "network", "truth"])
@pytest.mark.parametrize("people", ["ignore", "predict"])
def test_graph_of_every_session_is_without_mistakes(tmp_path, labels, people):
    session = Session("round 2", "hard", "A", 7, labels, people)
    for name in ("map.ply", "weights.safetensors"):
        (tmp_path / name).touch()
    graph = session_graph(session, building=BUILDING, map_file="map.ply", weights="weights.safetensors")
    path = tmp_path / "graph.yaml"
    path.write_text(written(graph, "a session"))
    assert check(path).mistakes == []
    operators = yaml.safe_load(path.read_text())["operators"]
    assert ("segmenter" in operators) == (labels != "none")
    assert ("tracker" in operators) == (people == "predict" and labels != "none")
    near = {"near": "blindspot", "braking": 2.5} if people == "predict" else {}
    wanted = {"building": BUILDING, "scenario": "hard", "tour": "A", "seed": 7} | near
    assert operators["simulator"]["config"] == wanted
    brakes = {"braking": 2.5} if people == "predict" else {}
    assert operators["planner"]["config"] == {"people": people} | brakes


def test_one_planner_with_one_set_of_parameters_in_all_rounds():
    configs = [
        session_graph(session, building=BUILDING, weights="w")["operators"]["planner"]["config"]
        for group in Schedule(rounds=4).groups()[:5]
        for session in group
    ]
    assert all(config == {"people": "ignore"} for config in configs)


def test_network_wants_weights():
    with pytest.raises(ValueError, match="want its weights"):
        session_graph(Session("round 2", "easy", "A", 1, "network"), building=BUILDING)


def test_recording_is_heard_again_without_anybody_driving():
    graph = session_graph(Session("truth", "easy", "A", 1, "truth"), building=BUILDING, map_file="map.ply")
    heard = listening_graph(graph, "run.mcap", "network", weights="w.safetensors")
    assert list(heard["operators"]) == ["simulator", "segmenter", "triage", "localizer"]
    assert heard["operators"]["simulator"]["config"] == {"recording": "run.mcap", "operator": "simulator"}
    assert heard["operators"]["localizer"] == graph["operators"]["localizer"]
    assert "planner" in graph["operators"]
    assert list(listening_graph(graph, "run.mcap", "none")["operators"]) == ["simulator", "triage", "localizer"]


def test_poisson_interval_is_exact():
    assert poisson_interval(0, 1.0) == pytest.approx((0.0, 3.689), abs=1e-3)
    assert poisson_interval(3, 3.0) == pytest.approx((0.6187 / 3.0, 8.7673 / 3.0), abs=1e-3)
    assert poisson_interval(2, 0.0) == (0.0, float("inf"))


def test_box_is_matplotlibs():
    values = np.random.default_rng(0).exponential(1.0, 500)
    own, theirs = box(values), matplotlib.cbook.boxplot_stats(values)[0]
    assert all(own[key] == pytest.approx(theirs[key]) for key in ("whislo", "q1", "med", "q3", "whishi"))
    assert box(np.zeros(0)) == {"n": 0}


def test_who_walks_into_the_robot_was_not_driven_into():
    still, moving = np.zeros((5, 3)), np.array([[0.1 * i, 0.0, 0.0] for i in range(5)])
    ahead, behind = np.array([0.8, 0.0]), np.array([-0.4, 0.0])

    def count(way, person):
        return driven_into(Track(way, way, np.ones(5, np.bool_), [(4, 0)], [person]))

    assert count(still, ahead) == 0
    assert count(moving, ahead) == 1
    assert count(moving, behind) == 0


def record(group, scenario, tour, reached, **changes):
    return {
        "group": group, "scenario": scenario, "tour": tour, "name": f"{group}-{scenario}-{tour}", "seed": 1,
        "targets": 4, "reached": reached, "ending": "tour_finished" if reached == 4 else "stuck", "driven_m": 500.0,
        "time_s": 60.0, "wall_seconds": 30.0, "collisions_with_people": 2, "driven_into_people": 1,
        "collisions_with_things": 0, "errors_mm": [1.0, 2.0, 3.0], "path": [[0.0, 0.0], [1.0, 1.0]],
        "graph": "round-1/a.yaml", **changes,
    }  # fmt: skip


def test_success_is_the_papers():
    records = [record("round 1", "easy", tour, 4) for tour in "AB"]
    records += [record("round 1", "hard", "A", 1), record("round 1", "hard", "B", 4)]
    (row,) = success_table(records, ["round 1"], ["easy", "hard", "extreme"])
    assert row["cells"]["easy"] == {"success": 100.0, "completed": True, "sessions": 2}
    assert row["cells"]["hard"] == {"success": 62.5, "completed": False, "sessions": 2}
    assert row["cells"]["extreme"]["success"] is None
    assert row["mean"] == 81.25


def test_collisions_count_by_the_kilometre():
    (row,) = driving([record("round 1", "easy", tour, 4) for tour in "AB"], ["round 1"], ["easy"])
    assert row["km"] == 1.0
    assert row["collisions_with_people"]["per_km"] == 4.0
    low, high = row["collisions_with_people"]["interval"]
    assert low < 4.0 < high
    assert row["times_real_time"] == 2.0


CONFUSION = {"ground": {"ground": 1.0, "permanent": 0.0}, "wall": {"ground": 0.1, "permanent": 0.9}}


def told(records):
    return {
        "settings": {
            "rounds": 1, "building": BUILDING, "scenarios": ["easy", "hard"], "tours": ["A"], "seed": 1, "cpu": "x<y",
        },
        "sessions": records,
        "comparison": [{**item, "group": "no labels"} for item in records],
        "labels": [
            {"group": "round 1", "frames": 3, "sessions_accepted": 1, "coverage": 0.9, "recall": {"wall": 0.5}}
        ],
        "networks": [{"name": "network of round 1", "evaluation": {"confusion": CONFUSION}}],
        "stages": [{"stage": "drive", "group": "round 1", "seconds": 90.0, "disk_gb": 1.0}],
        "disk_gb": 1.0,
    }  # fmt: skip


def test_page_says_what_the_json_says():
    summary = summarize(told([record("round 1", "easy", "A", 4), record("round 1", "hard", "A", 1, skipped=2)]))
    json.dumps(summary, allow_nan=True)
    assert [(item["name"], item["skipped"]) for item in summary["failed"]] == [("round 1-hard-A", 2)]
    picture = {
        "points": np.random.default_rng(0).normal(0, 3, (50, 3)).astype(np.float32),
        "labellings": [("truth", np.arange(50, dtype=np.uint8) % 5)],
    }
    text = page(summary, picture)
    assert "<u>100 %</u>" in text
    assert "(100 %)" in text  # the paper's
    assert "25 %" in text
    assert "x&lt;y" in text
    assert "<td>stuck</td><td>1 of 4</td><td>2</td>" in text
    assert text.count("data:image/png") == 5


def test_page_of_nothing_yet():
    empty = told([]) | {"comparison": [], "labels": [], "networks": [], "stages": []}
    assert "0 sessions" in page(summarize(empty))


def arguments(*given):
    parser = argparse.ArgumentParser()
    rounds_command.add_arguments(parser)
    return parser.parse_args(["-o", "out", *given])


def test_default_is_the_papers_experiment():
    settings = rounds_command.settings_of(arguments(), 1)
    assert (settings.rounds, settings.tours, settings.mapping_tour) == (4, ("A", "B", "C"), "mapping")
    assert settings.scenarios == ("easy", "medium", "hard", "extreme")
    quick = rounds_command.settings_of(arguments("--quick"), 1)
    assert (quick.rounds, quick.tours, quick.building) == (1, ("A",), BUILDING)


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        (["--rounds", "0"], "--rounds wants 1 to 9; it was given 0"),
        (["--steps", "3"], "--steps wants 20"),
        (["--budget", "soon"], "--budget: a duration is such as"),
        (["--building", "nowhere.yaml"], "nowhere.yaml: no such building"),
        (["--scenarios", "hard,lunar"], "no scenario 'lunar'; there are easy, extreme, hard, mapping, medium"),
        (["--scenarios", ","], "no scenario ','; there are easy"),
        (["--tours", "A,Z"], "has no tour 'Z'; it has A, B, C, mapping"),
    ],
)
def test_bad_arguments_are_named(given, complaint):
    with pytest.raises(UserError, match=complaint):
        rounds_command.settings_of(arguments(*given), 1)


class Killed(Exception):
    """Stands for the end of the process."""


@pytest.fixture
def stubs(monkeypatch):
    """Replace what takes time by files, and let the n-th of them fail."""
    calls: list[str] = []
    limit = [10**9]

    def note(what):
        if len(calls) >= limit[0]:
            raise Killed
        calls.append(what)

    def launch(graph, recording):
        note(f"launch {graph.stem}")
        recording.write_bytes(b"frames")
        return {"wall_seconds": 1.0}

    def record_of(session, outcome, recording):
        assert recording.exists()
        return record(session.group, session.scenario, session.tour, 4) | session._asdict() | {"name": session.name}

    def verb(words, log, *, threads=1):
        note(f"{words[0]} {log.parent.name}")
        output = Path(words[words.index("-o") + 1]) if "-o" in words else log
        for recording in (word for word in words[1:] if str(word).endswith(".mcap")):
            assert Path(recording).exists()
        if words[0] == "annotate":
            output.mkdir(exist_ok=True)
            (output / "map.ply").touch()
            (output / f"{log.parent.name}.labelled.mcap").touch()
            return json.dumps({"frames": 1, "sessions_accepted": 1, "coverage": 1.0})
        if words[0] == "evaluate":
            return json.dumps({"confusion": CONFUSION})
        output.touch()
        return "{}"

    for name, stub in (("launch", launch), ("record_of", record_of), ("verb", verb)):
        monkeypatch.setattr(experiment_command, name, stub)
    monkeypatch.setattr(experiment_command, "keep_picture", lambda recording, target: None)
    monkeypatch.setattr(experiment_command, "page", lambda told, picture: "")
    return calls, limit


def experiment(folder, *given):
    settings = rounds_command.settings_of(
        arguments("--rounds", "2", "--scenarios", "easy,hard", "--tours", "A,B", *given), 1
    )
    return Experiment(folder, settings, say=lambda line: None)


@pytest.mark.parametrize("cut", [0, 1, 4, 7, 12, 22])
def test_killed_run_goes_on_where_it_was(stubs, tmp_path, cut):
    calls, limit = stubs
    experiment(tmp_path / "whole").run()
    whole = calls.copy()
    assert len(set(whole)) == len(whole)
    calls.clear()
    limit[0] = cut
    with pytest.raises(Killed):
        experiment(tmp_path / "cut").run()
    limit[0] = 10**9
    experiment(tmp_path / "cut").run()
    assert calls == whole
    assert not list(tmp_path.rglob("*-[ABC].mcap"))
    calls.clear()
    experiment(tmp_path / "cut").run()
    assert not calls


def test_what_a_killed_launch_left_behind_is_in_nobodys_way(tmp_path, monkeypatch):
    recording = tmp_path / "round-1-easy-A.mcap"
    left = tmp_path / "round-1-easy-A.shards"
    left.mkdir()
    (left / "simulator.0.mcap").write_text("half a recording")
    seen = []
    monkeypatch.setattr(session_command, "verb", lambda words, log: seen.append(left.exists()) or "{}")
    assert session_command.launch(tmp_path / "round-1-easy-A.yaml", recording) == {}
    assert seen == [False]


def test_disk_is_measured_while_recordings_vanish(tmp_path):
    (tmp_path / "kept.mcap").write_bytes(b"frames")
    stop = threading.Event()

    def record_and_delete():
        n = 0
        while not stop.is_set():
            n += 1
            shards = tmp_path / f"{n}.shards"
            shards.mkdir()
            (shards / "simulator.0.mcap").touch()
            (tmp_path / f"{n}.mcap").touch()
            shutil.rmtree(shards)
            (tmp_path / f"{n}.mcap").unlink()

    with ThreadPoolExecutor(1) as crew:
        session = crew.submit(record_and_delete)
        try:
            assert {session_command.bytes_in(tmp_path) for _ in range(3000)} == {6}
        finally:
            stop.set()
        session.result()


def test_recordings_can_be_kept(stubs, tmp_path):
    settings = rounds_command.settings_of(arguments("--rounds", "1", "--scenarios", "easy"), 1)
    Experiment(tmp_path, settings, keep=True, say=lambda line: None).run()
    assert len(list(tmp_path.rglob("*-[ABC].mcap"))) == 9


def test_each_round_uses_the_latest_map_and_network(stubs, tmp_path):
    experiment(tmp_path).run()
    graphs = {path.stem: yaml.safe_load(path.read_text())["operators"] for path in tmp_path.rglob("*.yaml")}
    assert graphs["round-1-easy-A"]["localizer"]["config"] == {"map": "../mapping/map.ply"}
    assert graphs["round-2-easy-A"]["localizer"]["config"] == {"map": "../round-1/annotation/map.ply"}
    assert graphs["round-2-easy-A"]["segmenter"]["config"] == {"weights": "../round-1/weights.safetensors"}
    assert graphs["truth-hard-B"]["segmenter"]["run"].endswith("TrueSegmenter")
    assert graphs["predict-hard-B"]["planner"]["config"] == {"people": "predict", "braking": 2.5}


def test_where_nothing_was_labelled_the_next_round_has_no_network(stubs, tmp_path, monkeypatch):
    stub = experiment_command.verb

    def verb(words, log, *, threads=1):
        if words[0] == "annotate":
            raise UserError("none of the 6 sessions is accepted: all were lost")
        return stub(words, log, threads=threads)

    monkeypatch.setattr(experiment_command, "verb", verb)
    outcome = experiment(tmp_path).run()
    operators = yaml.safe_load((tmp_path / "round-2" / "round-2-easy-A.yaml").read_text())["operators"]
    assert "segmenter" not in operators
    assert outcome["labels"][0]["sessions_accepted"] == 0


def test_folder_of_another_experiment_is_refused(stubs, tmp_path):
    experiment(tmp_path)
    with pytest.raises(UserError, match="holds another experiment: seed 1 instead of 2"):
        experiment(tmp_path, "--seed", "2")


@pytest.mark.slow
def test_quick_rounds_from_the_first_drive_to_the_report(tmp_path, capsys):
    pytest.importorskip("pybullet")
    assert rounds_command.run(arguments("--quick", "--json", "--steps", "30", "-o", str(tmp_path / "quick"))) == 0
    outcome = json.loads(capsys.readouterr().out)
    assert [row["group"] for row in outcome["success"]] == ["round 1", "truth"]
    assert outcome["success"][0]["cells"]["easy"]["success"] == 100.0
    assert outcome["disk_gb"] < 2.0
    assert (tmp_path / "quick" / "report.html").stat().st_size > 100_000
