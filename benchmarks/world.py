"""What a step of the simulator costs: people, physics, lidar, truth, noise, and the message.

python -m benchmarks.world

Times are of one core (CPU time of this process) and hold the encoding of all that the simulator says.
"""

from __future__ import annotations

import json
import time
from typing import Any

import numpy as np

STEPS, WARM_UP = 150, 10
CROWDS = (0, 32, 64, 128, 256)  # walkers


def times(simulator: Any) -> np.ndarray:
    """Tick a simulator whose robot drives in circles; return the seconds of each step (STEPS,)."""
    from graph.codec import encode
    from graph.messages import Drive, Tick

    simulator.on_drive(Drive(measured_at=0, linear=0.3, angular=0.5))
    found = []
    for index in range(WARM_UP + STEPS):
        begun = time.process_time()
        for said in simulator.on_tick(Tick(measured_at=index * 100_000_000, index=index)):
            for port in getattr(said, "__struct_fields__", ()):
                message = getattr(said, port)
                if port != "reason" and message is not None:
                    encode(message)
        found.append(time.process_time() - begun)
    return np.array(found[WARM_UP:])


def row(name: str, value: float, unit: str) -> dict[str, Any]:
    """Return one line of the table; a step has no peer."""
    return {"name": name, "value": value, "unit": unit, "peer": None, "peer_value": None, "ratio": None}


def session(scenario: str) -> tuple[float, float]:
    """Let people walk for a minute; return their mean speed while moving, m/s, and the share still in rooms, %."""
    from sim.world import World

    world = World("default", scenario, "A", 1)
    speeds = []
    for _ in range(600):
        world.walk(0.1)
        speeds.append(np.hypot(*world.crowd.velocity.T)[world.crowd.moving()])
    return float(np.concatenate(speeds).mean()), 100.0 * world.still_there()


def rows() -> list[dict[str, Any]]:
    """Measure the steps of the scenarios, and how they grow with the number of people."""
    from operators.simulator import Simulator  # here: the extra `sim` may be absent
    from sim.scenario import Scenario
    from sim.world import World

    found = []
    for scenario, lidar in (("easy", "paper"), ("extreme", "paper"), ("extreme", "hdl32e")):
        simulator = Simulator(Simulator.Config(scenario=scenario, seed=1, lidar=lidar))
        seconds = times(simulator)
        people = len(simulator.world.person_truth)
        name = f"world step {scenario}, {lidar} lidar, {people} people"
        found.append(row(f"{name}, median", 1000.0 * float(np.median(seconds)), "ms"))
        found.append(row(f"{name}, p95", 1000.0 * float(np.percentile(seconds, 95)), "ms"))
    for scenario in ("easy", "medium", "hard", "extreme"):
        speed, share = session(scenario)
        found.append(row(f"world {scenario}, mean speed of those who move", speed, "m/s"))
        found.append(row(f"world {scenario}, people in their rooms after 60 s", share, "%"))
    medians = []
    for count in CROWDS:
        simulator = Simulator(Simulator.Config(scenario="mapping", seed=1))
        building = simulator.world.building
        crowd = Scenario(tables=(0.0, 0.0), wanderers=count / building.populated_area())
        simulator.world = World(building, crowd, "A", 1)
        medians.append(1000.0 * float(np.median(times(simulator))))
        found.append(row(f"world step with {count} walkers, median", medians[-1], "ms"))
    slopes = np.diff(medians) / np.diff(CROWDS)
    found.append(row("world step, cost of a walker", 1000.0 * float(np.polyfit(CROWDS, medians, 1)[0]), "us"))
    found.append(
        row("world step, cost of a walker, last doubling over the rest", float(slopes[-1] / slopes[:-1].mean()), "")
    )
    return found


if __name__ == "__main__":
    print(json.dumps(rows(), indent=1))
