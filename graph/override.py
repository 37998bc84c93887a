"""Overrides of a graph that is no file any more: the one in a recording."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import msgspec

from graph.check import require
from graph.graphfile import Graph, to_yaml


def override(graph: Graph, sets: Sequence[str], swaps: Sequence[str]) -> Graph:
    """Apply `operator.key=value` and `operator=module:Class` to a graph. Raises GraphError with all mistakes."""
    if graph.root not in sys.path:
        sys.path.append(graph.root)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{graph.name}.yaml"
        path.write_text(to_yaml(graph))
        return msgspec.structs.replace(require(path, sets, swaps), root=graph.root)
