"""Buildings from files: our YAML, boxes in an ASCII PLY, a ROS map; mistakes of form by name, all of them."""

from __future__ import annotations

import difflib
import typing
from pathlib import Path
from typing import Any

import msgspec
import yaml

from sim.boxes import read_boxes
from sim.building import Building, BuildingError
from sim.rosmap import read_map

SHIPPED = Path(__file__).parent / "buildings"


def find(path: Path | str, shipped: Path = SHIPPED) -> Path:
    """Return the file that a path means: as it is, or one that comes with the package. Raises BuildingError."""
    path = Path(path)
    for candidate in (path, shipped.parents[1] / path, shipped / path, shipped / f"{path.name}.yaml"):
        if candidate.is_file():
            return candidate
    raise BuildingError(
        f"no file {path}; shipped are {', '.join(sorted(entry.stem for entry in shipped.glob('*.yaml')))}"
    )


def load(path: Path | str) -> Building:
    """Read a building: a YAML file, a PLY of boxes, or the map.yaml of a ROS map.

    A YAML file may take its walls from a PLY (`boxes: FILE`) or a ROS map (`map: FILE`) that lies beside it. Raises
    BuildingError with the file and every field that is not of the form. Geometry is not judged here.
    """
    source = find(path)
    if source.suffix.lower() == ".ply":
        return Building(name=source.stem, blocks=read_boxes(source))
    try:
        content = yaml.safe_load(source.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise BuildingError(f"{source}: not YAML: {error}") from error
    if not isinstance(content, dict):
        raise BuildingError(f"{source}: a building is a mapping of walls, doors, rooms and so on; this is {content!r}")
    if "image" in content and "resolution" in content:
        building = Building(name=source.stem)
        return msgspec.structs.replace(building, blocks=read_map(source, building.wall.height))
    if mistakes := [f"{source}: {mistake}" for mistake in _mistakes(content)]:
        raise BuildingError("\n".join(mistakes))
    building = msgspec.convert(content, Building)
    blocks = list(building.blocks)
    for file, key in ((building.boxes, "boxes"), (building.map, "map")):
        if file is None:
            continue
        beside = source.parent / file
        if not beside.is_file():
            raise BuildingError(f"{source}: {key}: there is no file {beside}")
        blocks += read_boxes(beside) if key == "boxes" else read_map(beside, building.wall.height)
    return msgspec.structs.replace(building, blocks=blocks)


def _mistakes(content: dict[Any, Any]) -> list[str]:
    """Return what is not of a building's form: unknown keys, and each item of the wrong kind."""
    kinds = typing.get_type_hints(Building)
    found = []
    for key, value in content.items():
        if key not in kinds:
            near = difflib.get_close_matches(str(key), kinds, 1)
            found.append(f"there is no {key!r} in a building; {_alternative(near, list(kinds))}")
        elif typing.get_origin(kinds[key]) is list and isinstance(value, list):
            inner = typing.get_args(kinds[key])[0]
            found += [text for n, item in enumerate(value) if (text := _complaint(item, inner, f"{key}[{n}]"))]
        elif typing.get_origin(kinds[key]) is dict and isinstance(value, dict):
            inner = typing.get_args(kinds[key])[1]
            found += [text for name, item in value.items() if (text := _complaint(item, inner, f"{key}.{name}"))]
        elif text := _complaint(value, kinds[key], str(key)):
            found.append(text)
    return found


def _alternative(near: list[str], known: list[str]) -> str:
    return f"did you mean {near[0]!r}?" if near else f"there are {', '.join(known)}"


def _complaint(value: Any, kind: Any, place: str) -> str:
    try:
        msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        name = f" ({value['name']})" if isinstance(value, dict) and "name" in value else ""
        return f"{place}{name}: {str(error).replace('`$.', '`').replace('`$', '`')}"
    return ""
