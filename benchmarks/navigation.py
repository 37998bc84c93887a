"""What it costs to navigate among people: tracker and planner, in core time a frame, while a tour is driven.

python -m benchmarks.navigation

The operators are called by hand in this process, with true labels, in the fullest scenario. There is no peer: ROS's
navigation stack has no wheels.
"""

from __future__ import annotations

import json
import time
from collections import defaultdict
from typing import Any

import numpy as np

FRAMES, UNTIMED = 300, 20
SCENARIO, TOUR, SEED = "extreme", "A", 1
PERIOD = 100_000_000  # nanoseconds


class Stopwatch:
    """Core time of calls, by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, list[float]] = defaultdict(list)

    def __call__(self, name: str, method: Any, *messages: Any) -> Any:
        """Call a method and note what it cost."""
        begun = time.thread_time()
        said = method(*messages)
        said = list(said) if hasattr(said, "__next__") else said
        self.seconds[name].append(time.thread_time() - begun)
        return said


def drive(people: str) -> dict[str, list[float]]:
    """Drive some frames; return the core seconds of each call by operator and port."""
    from graph.messages import Tick  # here: the extra `sim` may be absent
    from operators.localizer import TrueLocalizer
    from operators.planner import Planner
    from operators.segmenter import TrueSegmenter
    from operators.simulator import Simulator
    from operators.tracker import Tracker
    from operators.triage import Triage

    for kind in (TrueLocalizer, Tracker, Planner):
        kind.warm_up()
    simulator = Simulator(Simulator.Config(scenario=SCENARIO, tour=TOUR, seed=SEED))
    segmenter, triage, localizer = TrueSegmenter(TrueSegmenter.Config()), Triage(), TrueLocalizer()
    tracker, planner = Tracker(), Planner(Planner.Config(people="predict" if people == "predict" else "ignore"))
    call = Stopwatch()
    for index in range(FRAMES):
        scan = next(iter(simulator.on_tick(Tick(measured_at=index * PERIOD, index=index))))
        parts = call("triage", triage.on_frame, segmenter.on_frame(scan.frame).classified)
        localizer.on_odometry(scan.odometry)
        located = localizer.on_frame(parts.localization)
        call("planner", planner.on_goal, scan.goal)
        if located.occupancy is not None:
            call("planner", planner.on_map, located.occupancy)
        call("planner", planner.on_obstacles, parts.planning)
        call("tracker", tracker.on_people, parts.people)
        call("planner", planner.on_tracks, call("tracker", tracker.on_pose, located.pose).tracks)
        simulator.on_drive(call("planner", planner.on_pose, located.pose).drive)
        simulator.on_pose(located.pose)
        if index == UNTIMED:
            call.seconds.clear()
    return call.seconds


def rows() -> list[dict[str, Any]]:
    """Measure both ways of meeting people."""
    found = []
    for people in ("ignore", "predict"):
        seconds = drive(people)
        for name in ("triage", "tracker", "planner"):
            value = 1e3 * float(np.sum(seconds[name])) / (FRAMES - UNTIMED)
            found.append({"name": f"{name}, people: {people}", "value": value, "unit": "core-ms"})
    return found


if __name__ == "__main__":
    print(json.dumps(rows(), indent=1))
