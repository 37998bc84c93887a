"""Axis-aligned boxes from an ASCII PLY: element `box` with min_x min_y min_z max_x max_y max_z."""

from __future__ import annotations

from pathlib import Path

from sim.building import Block, BuildingError

LOW, HIGH = ("min_x", "min_y", "min_z"), ("max_x", "max_y", "max_z")


def read_boxes(path: Path) -> list[Block]:
    """Read the boxes of an ASCII PLY as blocks, metres; other elements are passed over.

    Raises BuildingError with file and line if the file is binary, has no element `box`, or a row is no box.
    """
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except UnicodeDecodeError as error:
        raise BuildingError(f"{path}: not an ASCII PLY: {error.reason} at byte {error.start}") from error
    elements, row = _header(path, lines)
    blocks = []
    for name, count, properties in elements:
        if name == "box":
            blocks += [_block(path, row + index, properties, lines) for index in range(count)]
        row += count
    return blocks


def _header(path: Path, lines: list[str]) -> tuple[list[tuple[str, int, list[str]]], int]:
    """Return the elements as (name, count, properties), and the line at which their rows begin."""
    if not lines or lines[0].strip() != "ply":
        raise BuildingError(f"{path}: line 1: a PLY file begins with 'ply'")
    elements: list[tuple[str, int, list[str]]] = []
    for number, line in enumerate(lines[1:], 2):
        match line.split():
            case ["format", kind, *_] if kind != "ascii":
                raise BuildingError(f"{path}: line {number}: format {kind}; boxes are read from format ascii")
            case ["element", name, count] if count.isdigit():
                elements.append((name, int(count), []))
            case ["property", _, *_, name] if elements:
                elements[-1][2].append(name)
            case ["end_header"]:
                boxes = [properties for name, _, properties in elements if name == "box"]
                if not boxes:
                    there = ", ".join(name for name, _, _ in elements) or "none"
                    raise BuildingError(f"{path}: no element 'box'; there is {there}")
                if missing := [name for name in LOW + HIGH if name not in boxes[0]]:
                    raise BuildingError(f"{path}: element box has no property {', '.join(missing)}")
                return elements, number
            case ["format" | "comment" | "obj_info", *_] | []:
                pass
            case _:
                raise BuildingError(f"{path}: line {number}: {line.strip()!r} is not understood")
    raise BuildingError(f"{path}: the header has no end_header")


def _block(path: Path, row: int, properties: list[str], lines: list[str]) -> Block:
    if row >= len(lines):
        raise BuildingError(f"{path}: ends at line {len(lines)}, before its last box")
    try:
        values = dict(zip(properties, map(float, lines[row].split()), strict=True))
    except ValueError:
        wanted = " ".join(properties)
        raise BuildingError(f"{path}: line {row + 1}: {lines[row].strip()!r} is not {wanted}") from None
    low, high = (tuple(values[name] for name in names) for names in (LOW, HIGH))
    return Block(low=(low[0], low[1], low[2]), high=(high[0], high[1], high[2]))
