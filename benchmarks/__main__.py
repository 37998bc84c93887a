"""Speeds side by side with peers: `python -m benchmarks` measures all, `python -m benchmarks transport chain` some.

Prints a table and writes build/bench.json, a list of {name, value, unit, peer, peer_value, ratio}; the ratio is ours
over the peer's, both measured in this run.
"""

from __future__ import annotations

import importlib
import json
import pkgutil
import sys
from pathlib import Path
from typing import Any

import benchmarks

OUT = Path("build/bench.json")
KEYS = ("name", "value", "unit", "peer", "peer_value", "ratio")


def modules() -> list[str]:
    """Name the modules here that offer rows()."""
    names = [item.name for item in pkgutil.iter_modules(benchmarks.__path__)]
    folder = Path(next(iter(benchmarks.__path__)))
    return [name for name in sorted(names) if "\ndef rows(" in (folder / f"{name}.py").read_text(encoding="utf-8")]


def line(row: dict[str, Any]) -> str:
    """Lay one row out."""
    text = f"{row['name']:52} {row['value']:10.3f} {row['unit']:9}"
    if row.get("peer_value") is not None:
        text += f" {row['peer']:28} {row['peer_value']:10.3f}   ratio {row['ratio']:.2f}"
    return text


def merged(old: list[dict[str, Any]], new: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Replace rows of the same name and peer; keep the others."""
    fresh = {(row["name"], row.get("peer")) for row in new}
    return [row for row in old if (row["name"], row.get("peer")) not in fresh] + new


def main(names: list[str]) -> int:
    """Measure; a module that cannot run says why in one line, and the rest goes on. Returns 1 if one could not."""
    known = modules()
    if unknown := [name for name in names if name not in known]:
        print(f"there is no benchmark '{unknown[0]}'; there are {', '.join(known)}", file=sys.stderr)
        return 2
    OUT.parent.mkdir(exist_ok=True)
    rows: list[dict[str, Any]] = json.loads(OUT.read_text()) if names and OUT.exists() else []
    failed = False
    for name in names or known:
        print(f"-- {name}", flush=True)
        try:
            new = [dict.fromkeys(KEYS) | row for row in importlib.import_module(f"benchmarks.{name}").rows()]
        except Exception as error:  # a peer that is not installed, a machine that is too small
            print(f"{name} could not run: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
            failed = True
            continue
        for row in new:
            print(line(row), flush=True)
        rows = merged(rows, new)
        OUT.write_text(json.dumps(rows, indent=1) + "\n")
    print(f"written to {OUT}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
