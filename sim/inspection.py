"""What is wrong with a building: every mistake by name and place."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Iterator

import msgspec
import numpy as np
import numpy.typing as npt

from sim.building import Building, BuildingError, Door, Passage, Point, Room, WallStyle
from sim.clearance import Clearance, clearance, route
from sim.furniture import TABLES, table_body
from sim.layout import RESOLUTION, ROBOT_RADIUS, WALL_CLEAR, fixed_leaves, sampled
from sim.masonry import lies_on, place_on, wall_bodies
from sim.solids import Body

Array = npt.NDArray[np.float64]

SAMPLE = 0.05  # metres between the points at which a room's rim is looked at
SMALL_GAP = 0.12  # metres of a room's rim that may stand open
JAMB = 0.3  # metres from a block within which a door without a wall line must begin and end
OVERLAP = 0.25  # square metres that two rooms may share


def inspect(building: Building, tours: Iterable[str] | None = None) -> list[str]:
    """Return every mistake of a building, one sentence each; an empty list if it can be used.

    tours: those to be judged; all of them where none are named.
    """
    if not building.segments() and not building.blocks:
        return ["there are no walls; give walls, or boxes, or a map"]
    impossible = list(_measures(building))
    found = [mistake for _, _, mistake in impossible]
    building = _without(building, {(field, place) for field, place, _ in impossible})
    if not building.segments() and not building.blocks:
        return found
    found += [*_names(building), *_openings(building), *_rooms(building)]
    bodies = wall_bodies(building)
    free = clearance(bodies + fixed_leaves(building), building.bounds(), RESOLUTION)
    found += _tables(building, free, bodies)
    for name in building.tours if tours is None else tours:
        if ("tours", name) not in {(field, place) for field, place, _ in impossible}:
            found += _tour(building, name, free, bodies)
    return found


def require(building: Building, tours: Iterable[str] | None = None) -> None:
    """Raise BuildingError with every mistake of a building, one a line."""
    if mistakes := inspect(building, tours):
        raise BuildingError("\n".join(f"building {building.name}: {mistake}" for mistake in mistakes))


def _at(point: Iterable[float]) -> str:
    return "(" + ", ".join(f"{value:g}" for value in np.round(list(point), 2)) + ")"


def _door_name(index: int, door: Door | Passage) -> str:
    if isinstance(door, Passage):
        return f"passage {index} at {_at(door.start)}"
    return f"door {door.name or index} at {_at(door.hinge)}"


def _without(building: Building, places: set[tuple[str, int | str]]) -> Building:
    """Leave out the items, by field and index or name, over which further questions would stumble."""
    kept: dict[str, object] = {}
    for field in {field for field, _ in places}:
        items = getattr(building, field)
        if isinstance(items, dict):
            kept[field] = {name: item for name, item in items.items() if (field, name) not in places}
        elif isinstance(items, list):
            kept[field] = [item for index, item in enumerate(items) if (field, index) not in places]
        else:
            kept[field] = None if field == "start" else WallStyle()
    return msgspec.structs.replace(building, **kept)


def _measures(building: Building) -> Iterator[tuple[str, int | str, str]]:
    """Find numbers that are none, lengths that are not positive, and rooms without an inside: field, index, mistake."""
    for field, place, name, values in _numbers(building):
        if not all(math.isfinite(value) for value in values):
            yield field, place, f"{name}: {_at(values)} is no place"
    for name, value in (("thickness", building.wall.thickness), ("height", building.wall.height)):
        if not value > 0:
            yield "wall", 0, f"wall: a {name} of {value:g} m"
    for index, wall in enumerate(building.walls):
        points = wall if isinstance(wall, list) else wall.line
        if len(points) < 2:
            yield "walls", index, f"wall {index}: {len(points)} points; a wall has at least two"
    for segment in building.segments():
        where = f"wall {segment.wall} at {_at(segment.start)}"
        if math.dist(segment.start, segment.end) < 0.01:
            yield "walls", segment.wall, f"{where}: begins and ends at the same place"
        if segment.thickness <= 0 or segment.height <= 0:
            yield "walls", segment.wall, f"{where}: {segment.thickness:g} m thick, {segment.height:g} m high"
    for index, block in enumerate(building.blocks):
        if min(np.subtract(block.high, block.low)) <= 0:
            corners = f"its upper corner {_at(block.high)} is not above its lower {_at(block.low)}"
            yield "blocks", index, f"block {index}: {corners}"
    for index, pillar in enumerate(building.pillars):
        if min(pillar.size) <= 0:
            yield "pillars", index, f"pillar {index} at {_at(pillar.at)}: a size of {_at(pillar.size)} m"
    for index, door in enumerate(building.doors):
        name = _door_name(index, door)
        if door.width < 0.3 or door.lintel <= 0:
            yield "doors", index, f"{name}: {door.width:g} m wide and {door.lintel:g} m high; nobody fits through"
        if isinstance(door.angle, float) and not 0 <= door.angle <= 180:
            yield "doors", index, f"{name}: open by {door.angle:g} degrees; 0 to 180 are possible"
    for index, room in enumerate(building.rooms):
        if len(room.polygon) < 3:
            yield "rooms", index, f"room {room.name}: {len(room.polygon)} corners; a room has at least three"
        elif crossing := _crossing(room):
            yield "rooms", index, f"room {room.name}: its rim crosses itself near {_at(crossing)}"
        elif room.area(building.wall) <= 0:
            yield "rooms", index, f"room {room.name}: has no floor between its walls at {_at(room.polygon[0])}"


def _numbers(building: Building) -> Iterator[tuple[str, int | str, str, tuple[float, ...]]]:
    for segment in building.segments():
        yield "walls", segment.wall, f"wall {segment.wall}", (*segment.start, *segment.end)
    for index, block in enumerate(building.blocks):
        yield "blocks", index, f"block {index}", (*block.low, *block.high, block.heading)
    for index, pillar in enumerate(building.pillars):
        yield "pillars", index, f"pillar {index}", (*pillar.at, *pillar.size, pillar.heading)
    for index, door in enumerate(building.doors):
        yield "doors", index, f"door {door.name or index}", (*door.hinge, door.heading, door.width, door.lintel)
    for index, room in enumerate(building.rooms):
        yield "rooms", index, f"room {room.name}", tuple(value for point in room.polygon for value in point)
    for index, table in enumerate(building.tables):
        yield "tables", index, f"table position {index}", (*table.at, table.heading)
    for name, tour in building.tours.items():
        values = tuple(value for point in tour.targets for value in point)
        yield "tours", name, f"tour {name}", values + (tour.start or ())
    yield "start", 0, "start", building.start or ()


def _crossing(room: Room) -> Point | None:
    """Return where two edges of a polygon that are no neighbours meet."""
    ring = [np.array(point) for point in room.polygon]
    edges = list(zip(ring, ring[1:] + ring[:1], strict=True))
    for i, j in itertools.combinations(range(len(edges)), 2):
        if j == i + 1 or (i == 0 and j == len(edges) - 1):
            continue
        (a, b), (c, d) = edges[i], edges[j]
        r, s = b - a, d - c
        cross = r[0] * s[1] - r[1] * s[0]
        if abs(cross) < 1e-12:
            continue
        t = ((c - a)[0] * s[1] - (c - a)[1] * s[0]) / cross
        u = ((c - a)[0] * r[1] - (c - a)[1] * r[0]) / cross
        if 0 <= t <= 1 and 0 <= u <= 1:
            x, y = a + t * r
            return float(x), float(y)
    return None


def _names(building: Building) -> Iterator[str]:
    for kind, names in (
        ("rooms", [room.name for room in building.rooms]),
        ("doors", [door.name for door in building.doors if door.name]),
    ):
        for name, count in Counter(names).items():
            if count > 1:
                yield f"{count} {kind} are named {name}"


def _openings(building: Building) -> Iterator[str]:
    """Find doors and passages without a wall, higher than their wall, or in each other's place."""
    segments = building.segments()
    blocks = np.array([[*block.low[:2], *block.high[:2]] for block in building.blocks]).reshape(-1, 4)
    spans: dict[int, list[tuple[float, float, str]]] = {}
    gaps: list[tuple[int, Door | Passage]] = [*enumerate(building.doors), *enumerate(building.passages)]
    for index, gap in gaps:
        name = _door_name(index, gap)
        ends = (gap.hinge, gap.end()) if isinstance(gap, Door) else (gap.start, gap.end)
        on = [n for n, segment in enumerate(segments) if all(lies_on(end, segment) for end in ends)]
        if not on:
            touched = [any(lies_on(end, segment) for segment in segments) for end in ends]
            if isinstance(gap, Door) and all(_near_block(end, blocks) for end in ends):
                continue
            if any(touched):
                yield f"{name}: reaches beyond the end of its wall; it goes to {_at(ends[1])}"
            else:
                yield f"{name}: no wall there; it goes to {_at(ends[1])}"
        for n in on:
            along = sorted(place_on(end, segments[n])[0] for end in ends)
            spans.setdefault(n, []).append((along[0], along[1], name))
            if gap.lintel is not None and gap.lintel > segments[n].height:
                yield f"{name}: {gap.lintel:g} m high in a wall of {segments[n].height:g} m"
    for held in spans.values():
        for (_, end, first), (begin, _, second) in itertools.pairwise(sorted(held)):
            if begin < end - 0.01:
                yield f"{second}: overlaps {first}"


def _near_block(point: Point, blocks: Array) -> bool:
    gap = np.maximum(np.maximum(blocks[:, :2] - point, np.array(point) - blocks[:, 2:]), 0.0)
    return bool(len(blocks)) and float(np.hypot(*gap.T).min()) < JAMB


def _rooms(building: Building) -> Iterator[str]:
    """Find rooms with a gap in their walls, and rooms in each other's place."""
    segments = building.segments()
    if segments and not building.blocks:  # a map or boxes have doorways that nobody names
        for room in building.rooms:
            for first, last in _gaps(room, building):
                yield f"room {room.name} is not closed: no wall from {_at(first)} to {_at(last)}"
    for one, other in itertools.combinations(building.rooms, 2):
        low = np.maximum(np.min(one.polygon, 0), np.min(other.polygon, 0))
        high = np.minimum(np.max(one.polygon, 0), np.max(other.polygon, 0))
        if (high - low < SAMPLE).any():
            continue
        axes = [np.arange(a + SAMPLE, b, 2 * SAMPLE) for a, b in zip(low, high, strict=True)]
        x, y = np.meshgrid(*axes)
        points = np.stack([x.ravel(), y.ravel()], 1)
        both = points[one.contains(points) & other.contains(points)]
        if len(both) * (2 * SAMPLE) ** 2 > OVERLAP:
            yield f"rooms {one.name} and {other.name} overlap around {_at(both.mean(0))}"


def _gaps(room: Room, building: Building) -> Iterator[tuple[Array, Array]]:
    """Return the stretches of a room's rim, longer than SMALL_GAP, along which there is no wall."""
    segments = building.segments()
    starts = np.array([segment.start for segment in segments])
    reach = np.array([segment.end for segment in segments]) - starts
    half = np.array([segment.thickness for segment in segments]) / 2
    length2 = np.maximum((reach**2).sum(1), 1e-12)
    for a, b in zip(room.polygon, room.polygon[1:] + room.polygon[:1], strict=True):
        count = max(math.ceil(math.dist(a, b) / SAMPLE), 1)
        points = np.array(a) + (np.arange(count + 1) / count)[:, None] * np.subtract(b, a)
        away = points[:, None] - starts
        share = np.clip((away * reach).sum(2) / length2, 0.0, 1.0)
        distance = np.linalg.norm(away - share[..., None] * reach, axis=2)
        open_ = (distance > half + 0.01).all(1)
        edges = np.diff(np.concatenate([[0], open_.astype(np.int8), [0]]))
        for first, end in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True):
            if np.linalg.norm(points[end - 1] - points[first]) > SMALL_GAP:
                yield points[first], points[end - 1]


def _inside(point: Point, bodies: list[Body]) -> str:
    """Return the name of the body that holds a point of the floor, or nothing."""
    for body in bodies:
        for part in body.parts:
            if part.z - part.dz / 2 > 0.5:
                continue
            ring = part.footprint()
            edge, away = np.roll(ring, -1, axis=0) - ring, np.array(point) - ring
            if (edge[:, 0] * away[:, 1] - edge[:, 1] * away[:, 0] >= 0).all():
                return body.name
    return ""


def _tables(building: Building, free: Clearance, bodies: list[Body]) -> Iterator[str]:
    for index, place in enumerate(building.tables):
        name = f"table position {index} at {_at(place.at)}"
        if unknown := [model for model in place.models if model not in TABLES]:
            yield f"{name}: there is no table model {unknown[0]!r}; there are {', '.join(TABLES)}"
            continue
        if building.rooms and building.room_of(place.at) < 0:
            yield f"{name}: is in no room"
        if inside := _inside(place.at, bodies):
            yield f"{name}: is inside {inside}"
            continue
        for model in place.models or TABLES:
            table = table_body(model, *place.at, math.radians(place.heading))
            points = np.concatenate([sampled(part.footprint()) for part in table.parts])
            if free.at(points).min() >= WALL_CLEAR:
                break
        else:
            gap = float(free.at(np.array([place.at]))[0])
            yield f"{name}: none of its models fits; the nearest wall is {gap:.2f} m off"


def _tour(building: Building, name: str, free: Clearance, bodies: list[Body]) -> Iterator[str]:
    """Find targets that cannot be stood on, and those that cannot be reached from the one before."""
    if name not in building.tours:
        yield f"there is no tour {name!r}; there are {', '.join(building.tours) or 'none'}"
        return
    tour = building.tours[name]
    if not tour.targets:
        yield f"tour {name}: no targets"
    start = tour.start or building.start
    if start is None:
        yield f"tour {name}: no start, and the building has none"
    stops: list[tuple[str, Point]] = [] if start is None else [("the start", start[:2])]
    stops += [(f"target {index}", target) for index, target in enumerate(tour.targets)]
    x0, y0, x1, y1 = building.bounds()
    last: tuple[str, Point] | None = None
    for what, point in stops:
        where = f"tour {name}: {what} at {_at(point)}"
        room = float(free.at(np.array([point]))[0])
        if not (x0 < point[0] < x1 and y0 < point[1] < y1):
            yield f"{where} is outside the building"
        elif inside := _inside(point, bodies):
            yield f"{where} is inside {inside}"
        elif room < ROBOT_RADIUS:
            yield f"{where} is {room:.2f} m from a wall; the robot needs {ROBOT_RADIUS:g} m"
        else:
            if last is not None and route(free, last[1], point, radius=ROBOT_RADIUS) is None:
                yield f"{where} cannot be reached from {last[0]} at {_at(last[1])}"
            last = what, point
