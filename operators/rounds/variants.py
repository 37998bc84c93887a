"""The graph of each session: the whole robot with its own scenario, labels and map, and less where less is needed."""

from __future__ import annotations

import copy
import functools
from pathlib import Path
from typing import Any

import yaml

from operators.rounds.schedule import Session

ROBOT = Path(__file__).parent / "robot.yaml"

Graph = dict[str, Any]  # a graph file's content

PLAYBACK = "graph.playback:operators.simulator.Simulator"
NEAR = "blindspot"  # the second lidar of a robot that predicts people
BRAKING = 2.5  # m/s^2: and its brakes
SEGMENTERS = {"network": "operators.segmenter:Segmenter", "truth": "operators.segmenter:TrueSegmenter"}


@functools.cache
def _read() -> Graph:
    graph: Graph = yaml.safe_load(ROBOT.read_text(encoding="utf-8"))
    return graph


def robot() -> Graph:
    """Return the whole robot, each time another copy."""
    return copy.deepcopy(_read())


def session_graph(
    session: Session,
    *,
    building: str,
    map_file: str | None = None,
    weights: str | None = None,
    threads: int = 1,
    voxel: float = 0.08,
    lidar: dict[str, Any] | None = None,
) -> Graph:
    """Return the graph of a session; files as the graph file shall name them.

    map_file: where localization starts; none for the mapping. weights: of the network, where the labels are its own.
    threads: of the segmenter. voxel: metres, of the subsampling where labels are true, as the network's. lidar: further
    settings of the simulator. Raises ValueError where the network's weights are missing.
    """
    graph = robot()
    operators = graph["operators"]
    told = {"building": building, "scenario": session.scenario, "tour": session.tour, "seed": session.seed}
    operators["simulator"]["config"] = told | (lidar or {})
    if map_file is not None:
        operators["localizer"]["config"] = {"map": map_file}
    operators["planner"]["config"]["people"] = session.people
    if session.people == "predict":
        operators["simulator"]["config"] |= {"near": NEAR, "braking": BRAKING}
        operators["planner"]["config"]["braking"] = BRAKING
    with_labels(graph, session.labels, weights=weights, threads=threads, voxel=voxel)
    if session.people == "ignore":
        without_tracker(graph)
    return graph


def with_labels(graph: Graph, labels: str, *, weights: str | None, threads: int = 1, voxel: float = 0.08) -> None:
    """Put the segmenter of these labels into a graph, or take it out. Raises ValueError for missing weights."""
    operators = graph["operators"]
    if labels == "none":
        del operators["segmenter"]
        operators["triage"]["inputs"]["frame"] = "simulator/frame"
        without_tracker(graph)
        return
    entry = operators["segmenter"]
    entry["run"] = SEGMENTERS[labels]
    if labels == "truth":
        entry["config"] = {"voxel": voxel}
        return
    if weights is None:
        raise ValueError("labels of a network want its weights")
    entry["config"], entry["threads"] = {"weights": weights}, threads


def without_tracker(graph: Graph) -> None:
    """Take the tracker out of a graph, if it is there."""
    graph["operators"].pop("tracker", None)
    for port in ("tracks", "things"):
        graph["operators"].get("planner", {"inputs": {}})["inputs"].pop(port, None)


def listening_graph(
    graph: Graph, recording: str, labels: str, *, weights: str | None = None, threads: int = 1, voxel: float = 0.08
) -> Graph:
    """Return what localizes on a recording of a session: its simulator played back, these labels, the localizer.

    graph: of the session. recording, weights: files as the graph file shall name them.
    """
    listening = copy.deepcopy(graph)
    operators = listening["operators"]
    whole = robot()["operators"]
    operators |= {name: whole[name] for name in ("segmenter", "triage")}
    without_tracker(listening)
    del operators["planner"]
    operators["simulator"] = {
        "run": PLAYBACK,
        "config": {"recording": recording, "operator": "simulator"},
        "record": {"frame": "digest"},
    }
    with_labels(listening, labels, weights=weights, threads=threads, voxel=voxel)
    names = [name for name in whole if name in operators]
    listening["operators"] = {name: operators[name] for name in names}
    return listening


def written(graph: Graph, about: str) -> str:
    """Return the text of a graph file."""
    return f"# {about}\n" + yaml.safe_dump(graph, sort_keys=False, default_flow_style=None, width=110)
