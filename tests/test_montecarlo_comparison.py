"""The comparison of localizers: its numbers, its report and its graphs."""

from __future__ import annotations

import argparse
import io
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from PIL import Image

from graph.check import check
from graph.cli import main
from operators.montecarlo import localizers_command
from operators.montecarlo.comparison import METHODS, Run, table
from operators.montecarlo.localizers_command import add_arguments, batches, driven_graph, same_graph
from operators.montecarlo.map_file import GridMap
from operators.montecarlo.picture import FOUND, WALL, map_picture
from operators.montecarlo.report import write_report
from operators.rounds.variants import written


class Step(NamedTuple):
    """A call, as a ledger has it."""

    milliseconds: int
    port: str = "frame"

    @property
    def wall_duration(self) -> int:
        return 1_000_000 * self.milliseconds


def run(method="amcl", labels="none", errors=(0.2, 0.4), ending="tour finished", tour="A", name="driven") -> Run:
    return Run(name, "hard", tour, method, labels, list(errors), ending, 7, 7, 5.0)


RUNS = [
    run(),
    run(errors=(0.6,), tour="B", ending="lost"),
    run(labels="network", errors=(0.1, 0.1)),
    run(labels="truth", errors=(0.08, 0.08)),
    run(method="gmapping", errors=(0.3,)),
]


def test_factors_are_ratios_of_mean_errors_and_failures_are_counted():
    amcl, gmapping = table(RUNS, "driven")
    assert amcl["labels"]["none"]["mean"] == pytest.approx(0.4)
    assert (amcl["labels"]["none"]["failed"], amcl["labels"]["none"]["tours"]) == (1, 2)
    assert amcl["factor_network"] == pytest.approx(4.0)
    assert amcl["factor_truth"] == pytest.approx(5.0)
    assert amcl["network_over_truth"] == pytest.approx(1.25)
    assert (amcl["factor_paper"], gmapping["factor_paper"]) == (3.8, 3.0)
    assert "factor_network" not in gmapping
    assert run(ending="", errors=(0.1, 2.5)).failed
    assert not run(ending="", errors=(0.1, 1.5)).failed


def test_the_report_holds_both_tables_and_a_picture_of_each(tmp_path: Path):
    write_report(tmp_path, [*RUNS, run(name="same", ending="")], {"seed": 1})
    record = json.loads((tmp_path / "report.json").read_text())
    assert set(record["tables"]) == {"driven", "same"}
    page = (tmp_path / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 2
    assert "3.80" in page
    assert "AMCL" in page
    assert "1.25" in page  # with the network over the truth


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("labels", ["none", "truth"])
def test_each_graph_of_the_experiment_has_no_mistakes(tmp_path: Path, method: str, labels: str):
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    args = parser.parse_args(["-o", str(tmp_path)])
    file = tmp_path / "graph.yaml"
    file.write_text(written(driven_graph(args, "hard", "A", method, labels), "a test"))
    report = check(file)
    assert not report.mistakes
    assert METHODS[method] in file.read_text()


@pytest.mark.parametrize("labels", ["none", "truth"])
def test_all_methods_listen_to_one_recording_side_by_side(tmp_path: Path, labels: str):
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    args = parser.parse_args(["-o", str(tmp_path)])
    graph = same_graph(args, tmp_path / "tour.mcap", list(METHODS), labels)
    assert graph["operators"]["amcl"]["config"]["odom_alpha3"] == 0.8
    for method, kind in METHODS.items():
        assert graph["operators"][method]["run"] == kind
        assert graph["operators"][method]["inputs"]["frame"] == f"triage_{method}/localization"
        assert graph["operators"][f"triage_{method}"]["config"] == {"localizer": method}
    assert ("segmenter" in graph["operators"]) == (labels == "truth")
    assert "planner" not in graph["operators"]


def test_the_hard_scenario_on_shared_recordings_comes_first_and_a_robot_drives_with_one_method():
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    todo = list(batches(parser.parse_args(["-o", "out"]), ["none", "truth"]))
    assert todo[0] == [("same", "hard", "A", method, "none") for method in METHODS]
    driven = [jobs for jobs in todo if jobs[0][0] == "driven"]
    assert {len(jobs) for jobs in driven} == {1}
    assert len(driven) == 2 * 3 * 2 * len(METHODS)
    assert len({job for jobs in todo for job in jobs}) == 2 * len(driven)


def test_a_map_is_drawn_over_the_walls_upright():
    cells = np.full((60, 80), -1, np.int8)
    cells[30:50, 30:60] = 0
    cells[49, 30:60] = 100  # the wall of the largest y
    walls = GridMap(np.zeros((30, 30), np.int8), np.array([31.5, 31.5]) * 0.05, 0.05)
    walls.cells[0, 0] = 100
    picture = Image.open(io.BytesIO(map_picture(GridMap(cells, np.zeros(2), 0.05), walls))).convert("RGB")
    shown = np.asarray(picture)
    rows, columns = np.nonzero((shown == FOUND).all(axis=2))
    assert len(set(rows.tolist())) == 1
    assert len(columns) == 30
    assert (shown == WALL).all(axis=2).sum() == 1
    assert rows[0] < np.nonzero((shown == WALL).all(axis=2))[0][0]


def test_a_driven_tour_says_how_it_ended_and_what_an_update_took(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    args = argparse.Namespace(output=tmp_path, keep=True)
    steps = [(0, "localizer", Step(milliseconds)) for milliseconds in (1, 1, 1, 20, 30, 40)]
    said = {"simulator": {"ending": {"tour_finished": False, "stuck": True}, "reached": 3, "targets": 7}}
    said["localizer"] = {"updates": 3}
    monkeypatch.setattr(localizers_command, "driven_graph", lambda *told: {})
    monkeypatch.setattr(localizers_command, "_launch", lambda *told: (tmp_path / "r.mcap", {"summaries": said}))
    monkeypatch.setattr(localizers_command, "Recording", lambda path: argparse.Namespace(steps=lambda name: steps))
    monkeypatch.setattr(localizers_command, "distances", lambda read, operator: np.array([0.1, 0.2]))
    localizers_command._run(args, [("driven", "hard", "A", "amcl", "truth")])
    found = Run(**json.loads((tmp_path / "tours" / "driven-hard-A-amcl-truth.json").read_text()))
    assert (found.ending, found.reached, found.targets, found.failed) == ("stuck", 3, 7, True)
    assert found.update_ms == pytest.approx(30.0)


def test_what_is_missing_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["localizers", "-o", str(tmp_path), "--labels", "network"]) == 2
    assert "the network's labels want its weights" in capsys.readouterr().err
    assert main(["localizers", "-o", str(tmp_path), "--map", "nowhere.yaml"]) == 2
    assert "nowhere.yaml: no such file" in capsys.readouterr().err
    assert main(["localizers", "-o", str(tmp_path), "--recordings", str(tmp_path / "none")]) == 2
    assert "none: no such folder" in capsys.readouterr().err
