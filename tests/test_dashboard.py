"""The dashboard: it is wired to whatever a graph can show, shows it, and never stands in the way of a run."""

from __future__ import annotations

import copy
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from graph.check import require
from graph.errors import UserError
from graph.graphfile import Clock, Edge, Graph, OperatorEntry
from graph.inprocess import launch_in_process
from graph.messages import Tick
from graph.recording import Recording
from graph.transport import free_port
from tests.toy_robot import ToyRobot

pytest.importorskip("rerun", reason="rerun-sdk is not installed (extra 'view')")

from operators.dashboard import Dashboard, attach
from operators.views.viewer import Viewer, ViewerError
from tests.test_views import ROOT, entities, graph_of, rows

PORTS = ("frame", "odometry", "goal", "truth", "pose", "map", "occupancy", "plan", "drive", "text")


def toy_graph(ticks: int = 12) -> Graph:
    return graph_of("toy", "tests.toy_robot:ToyRobot", ticks=ticks)


def test_attach_wires_every_port_that_a_graph_can_feed() -> None:
    graph = toy_graph()
    before = copy.deepcopy(graph)
    attached = attach(graph)
    assert graph == before
    assert list(attached.operators) == ["toy", "dashboard"]
    assert attached.operators["dashboard"].inputs == {port: Edge("toy", port) for port in PORTS}
    assert require(attached) == attached


def test_attach_takes_the_type_where_no_name_fits() -> None:
    pinhole = OperatorEntry("tests.toy_robot:Scanner", {"tick": Edge("timer", "10hz")})
    graph = Graph(Clock(duration=10**9), {"scanner": pinhole}, "scans", str(ROOT))
    assert attach(graph).operators["dashboard"].inputs == {
        "frame": Edge("scanner", "scan"),
        "classified": Edge("scanner", "classified"),
    }


def test_attach_prefers_names_over_the_order_of_the_graph() -> None:
    tick = {"tick": Edge("timer", "10hz")}
    operators = {
        "scanner": OperatorEntry("tests.toy_robot:Scanner", tick),
        "toy": OperatorEntry("tests.toy_robot:ToyRobot", tick),
    }
    inputs = attach(Graph(Clock(end="toy"), operators, "two", str(ROOT))).operators["dashboard"].inputs
    assert inputs["frame"] == Edge("toy", "frame")
    assert inputs["classified"] == Edge("scanner", "classified")


def test_attach_leaves_a_dashboard_alone_and_a_taken_name_to_its_owner() -> None:
    attached = attach(toy_graph())
    assert attach(attached) == attached
    named = Graph(Clock(end="dashboard"), {"dashboard": toy_graph().operators["toy"]}, "toy", str(ROOT))
    assert list(attach(named).operators) == ["dashboard", "dashboard_2"]


def test_attach_says_when_there_is_nothing_to_show() -> None:
    with pytest.raises(
        UserError, match=r"graph 'counter' has nothing to show: none of its operators gives .*PointCloud"
    ):
        attach(graph_of("counter", "tests.sample_operators:Counter"))


def test_a_dashboard_shows_what_it_is_given(tmp_path: Path) -> None:
    file = tmp_path / "live.rrd"
    dashboard = Dashboard(Dashboard.Config(save=file, frames=1e9))
    dashboard.on_start()
    robot = ToyRobot(ToyRobot.Config(ticks=3))
    for index in range(3):
        tick = Tick(measured_at=index * 10**8, index=index)
        for outputs in robot.on_tick(tick):
            for port in PORTS:
                getattr(dashboard, f"on_{port}")(getattr(outputs, port, None))
    dashboard.on_frame(None)
    dashboard.on_end()
    assert len(rows(file, "world/frame")) == 3
    curve = [row for row in rows(file, "plots/localization_error/pose") if row.get("Scalars:scalars")]
    assert [row["Scalars:scalars"][0] for row in curve] == pytest.approx([3.0] * 3)
    ages = [
        row["Scalars:scalars"][0] for row in rows(file, "plots/latency/frame_to_pose") if row.get("Scalars:scalars")
    ]
    assert len(ages) == 3
    assert all(0.0 <= age < 60_000.0 for age in ages)


def test_clouds_come_no_faster_than_asked(tmp_path: Path) -> None:
    file = tmp_path / "live.rrd"
    dashboard = Dashboard(Dashboard.Config(save=file, frames=1e-3))
    dashboard.on_start()
    for index in range(3):
        for outputs in ToyRobot().on_tick(Tick(measured_at=index, index=index)):
            dashboard.on_frame(getattr(outputs, "frame", None))
    dashboard.on_end()
    assert len(rows(file, "world/frame")) == 1


def test_a_run_with_a_dashboard_is_complete_and_says_the_same(tmp_path: Path) -> None:
    attached = attach(toy_graph(), {"save": str(tmp_path / "live.rrd")})
    verdict, _ = launch_in_process(attached, record=tmp_path / "seen.mcap")
    launch_in_process(toy_graph(), record=tmp_path / "alone.mcap")
    assert verdict.verdict == "COMPLETE", verdict.reasons
    seen, alone = (list(Recording(tmp_path / f"{name}.mcap").messages()) for name in ("seen", "alone"))
    assert seen == alone
    assert {"world/frame", "world/robot", "world/map/0"} <= entities(tmp_path / "live.rrd")


def test_a_viewer_that_is_gone_does_not_stop_the_dashboard(capsys: pytest.CaptureFixture[str]) -> None:
    dashboard = Dashboard(Dashboard.Config(address=f"rerun+http://127.0.0.1:{free_port()}/proxy"))
    dashboard.on_start()
    for outputs in ToyRobot().on_tick(Tick(measured_at=0, index=0)):
        dashboard.on_frame(getattr(outputs, "frame", None))
    dashboard.on_end()
    assert "not all has reached the viewer" in capsys.readouterr().out


def test_an_address_that_is_none_leaves_the_dashboard_dark(capsys: pytest.CaptureFixture[str]) -> None:
    dashboard = Dashboard(Dashboard.Config(address="nonsense"))
    dashboard.on_start()
    for outputs in ToyRobot().on_tick(Tick(measured_at=0, index=0)):
        dashboard.on_pose(getattr(outputs, "pose", None))
    dashboard.on_end()
    assert "the dashboard shows nothing: nonsense" in capsys.readouterr().out


def test_a_web_viewer_listens_here_only_and_ends_when_told() -> None:
    viewer = Viewer(free_port(), page=free_port())
    process = psutil.Process(viewer.process.pid)
    listening = [link.laddr.ip for link in process.net_connections() if link.status == psutil.CONN_LISTEN]
    assert len(listening) == 2
    assert set(listening) == {"127.0.0.1"}
    viewer.close()
    assert not viewer.alive


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux ends the children of a killed process")
def test_a_web_viewer_does_not_outlive_a_killed_owner() -> None:
    made = f"Viewer({free_port()}, page={free_port()})"
    code = f"from operators.views.viewer import Viewer; print({made}.process.pid, flush=True); input()"
    owner = subprocess.Popen(
        [sys.executable, "-c", code], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert owner.stdout is not None
    viewer = psutil.Process(int(owner.stdout.readline()))
    os.kill(owner.pid, signal.SIGKILL)
    owner.wait()
    deadline = time.monotonic() + 10.0
    while viewer.is_running() and viewer.status() != psutil.STATUS_ZOMBIE and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not viewer.is_running() or viewer.status() == psutil.STATUS_ZOMBIE


def test_a_port_that_is_taken_is_said_in_one_sentence() -> None:
    port, page = free_port(), free_port()
    first = Viewer(port, page=page)
    try:
        with pytest.raises(ViewerError, match=f"port {port} is taken"):
            Viewer(port, page=page)
    finally:
        first.close()
