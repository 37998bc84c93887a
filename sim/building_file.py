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
    building, mistakes = read(path)
    if mistakes:
        raise BuildingError("\n".join(mistakes))
    return building


def read(path: Path | str) -> tuple[Building, list[str]]:
    """Read a building as `load` does, without the parts that are not of the form; name these.

    Raises BuildingError where there is no building to speak of.
    """
    source = find(path)
    if source.suffix.lower() == ".ply":
        return Building(name=source.stem, blocks=read_boxes(source)), []
    try:
        content = yaml.safe_load(source.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise BuildingError(f"{source}: not YAML: {error}") from error
    if not isinstance(content, dict):
        raise BuildingError(f"{source}: a building is a mapping of walls, doors, rooms and so on; this is {content!r}")
    if "image" in content and "resolution" in content:
        building = Building(name=source.stem)
        return msgspec.structs.replace(building, blocks=read_map(source, building.wall.height)), []
    kept, mistakes = _sorted_out(content)
    building = msgspec.convert(kept, Building)
    blocks = list(building.blocks)
    for file, key in ((building.boxes, "boxes"), (building.map, "map")):
        if file is None:
            continue
        beside = source.parent / file
        try:
            if not beside.is_file():
                raise BuildingError(f"{key}: there is no file {beside}")
            blocks += read_boxes(beside) if key == "boxes" else read_map(beside, building.wall.height)
        except BuildingError as error:
            mistakes.append(str(error))
    return msgspec.structs.replace(building, blocks=blocks), [f"{source}: {mistake}" for mistake in mistakes]


def _sorted_out(content: dict[Any, Any]) -> tuple[dict[str, Any], list[str]]:
    """Return what is of a building's form, and what is not: unknown keys, and each item of the wrong kind."""
    kinds = typing.get_type_hints(Building)
    kept: dict[str, Any] = {}
    mistakes = []
    for key, value in content.items():
        if key not in kinds:
            near = difflib.get_close_matches(str(key), kinds, 1)
            mistakes.append(f"there is no {key!r} in a building; {_alternative(near, list(kinds))}")
        elif typing.get_origin(kinds[key]) is list and isinstance(value, list):
            inner = typing.get_args(kinds[key])[0]
            complaints = [_complaint(item, inner, f"{key}[{index}]") for index, item in enumerate(value)]
            kept[key] = [item for item, complaint in zip(value, complaints, strict=True) if not complaint]
            mistakes += filter(None, complaints)
        elif typing.get_origin(kinds[key]) is dict and isinstance(value, dict):
            inner = typing.get_args(kinds[key])[1]
            named = {name: _complaint(item, inner, f"{key}.{name}") for name, item in value.items()}
            kept[key] = {str(name): value[name] for name, complaint in named.items() if not complaint}
            mistakes += filter(None, named.values())
        elif complaint := _complaint(value, kinds[key], str(key)):
            mistakes.append(complaint)
        else:
            kept[key] = value
    return kept, mistakes


def _alternative(near: list[str], known: list[str]) -> str:
    return f"did you mean {near[0]!r}?" if near else f"there are {', '.join(known)}"


def _complaint(value: Any, kind: Any, place: str) -> str:
    try:
        msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        name = f" ({value['name']})" if isinstance(value, dict) and "name" in value else ""
        return f"{place}{name}: {str(error).replace('`$.', '`').replace('`$', '`')}"
    return ""
