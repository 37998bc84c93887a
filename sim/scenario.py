"""Scenarios: how full a session is, and of what; each a short YAML file."""

from __future__ import annotations

from pathlib import Path

import msgspec
import yaml

from sim.building import BuildingError
from sim.building_file import find
from sim.furniture import TABLES

SHIPPED = Path(__file__).parent / "scenarios"


class Scenario(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Shares and densities of one session (FACTS: simulated world of the paper)."""

    tables: tuple[float, float] = (0.4, 0.4)  # share of the table positions that are filled, drawn by room
    models: list[str] = []  # table models that occur; none named: all
    wanderers: float = 0.0  # people per square metre of the populated rooms
    followers: float = 0.0
    occupied: float = 0.5  # share of the chairs on which somebody sits
    attentive: float = 0.8  # share of the walkers that keep clear of the robot


def load_scenario(path: Path | str) -> Scenario:
    """Read a scenario by name or file. Raises BuildingError by name of file and field."""
    source = find(path, SHIPPED)
    try:
        scenario = msgspec.convert(yaml.safe_load(source.read_text(encoding="utf-8")) or {}, Scenario)
    except (yaml.YAMLError, msgspec.ValidationError) as error:
        raise BuildingError(f"{source}: {error}") from error
    if unknown := [name for name in scenario.models if name not in TABLES]:
        raise BuildingError(f"{source}: there is no table model {unknown[0]!r}; there are {', '.join(TABLES)}")
    return scenario
