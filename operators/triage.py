"""Triage: which points the localizer, the planner and the tracker get to see.

triage:
  run: operators.triage:Triage
  inputs: {frame: segmenter/classified}
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from graph.contract import Operator, Summary
from graph.messages import PointCloud

Label = Literal["uncertain", "ground", "permanent", "longT", "shortT"]

LABELS: tuple[Label, ...] = ("uncertain", "ground", "permanent", "longT", "shortT")  # 0 to 4
NOT_SHORT: tuple[Label, ...] = ("uncertain", "ground", "permanent", "longT")
STANDING: tuple[Label, ...] = ("uncertain", "permanent", "longT")
# consumer, column: what it sees. The columns are the paper, the authors' code, and ours.
TABLE: dict[tuple[str, str], tuple[Label, ...]] = {
    ("pointmap", "paper"): ("ground", "permanent"),
    ("pointmap", "authors"): NOT_SHORT,
    ("pointmap", "ours"): ("ground", "permanent"),
    ("amcl", "authors"): ("permanent",),
    ("amcl", "ours"): ("permanent",),
    ("gmapping", "authors"): STANDING,
    ("gmapping", "ours"): STANDING,
    ("planner", "paper"): NOT_SHORT,
    ("planner", "authors"): STANDING,
    ("planner", "ours"): STANDING,
}
ARRAYS = ("points", "ring", "time_offset", "label", "scores", "truth", "moving", "instance")


def chosen(label: npt.NDArray[np.uint8], names: tuple[Label, ...] | list[Label]) -> npt.NDArray[np.bool_]:
    """Say which of the labels (n,) bear one of the names."""
    among = np.zeros(256, np.bool_)
    among[[LABELS.index(name) for name in names]] = True
    return among[label]


def part(cloud: PointCloud, keep: npt.NDArray[np.bool_]) -> PointCloud:
    """Return some of the points (n,) of a cloud, with all that is known of each."""
    arrays = {name: values[keep] for name in ARRAYS if (values := getattr(cloud, name)) is not None}
    return msgspec.structs.replace(cloud, **arrays)


class Triage(Operator):
    """Split a classified frame by who may use which class; global and local planner share one cloud.

    A frame without labels goes to localization whole, and to planning what stands above the floor.
    """

    class Config(msgspec.Struct, forbid_unknown_fields=True):
        """A column of the table, and what differs from it."""

        column: Literal["ours", "paper", "authors"] = "ours"
        localizer: Literal["pointmap", "amcl", "gmapping"] = "pointmap"
        localization: Annotated[list[Label], msgspec.Meta(min_length=1)] | None = None  # classes, not the table's
        planning: Annotated[list[Label], msgspec.Meta(min_length=1)] | None = None
        floor: float = 0.1  # metres above the floor below which a robot of this size drives over what it does not know

    class Outputs(msgspec.Struct):
        """The frame's parts; `people` only where there are labels."""

        localization: PointCloud | None = None
        planning: PointCloud | None = None
        people: PointCloud | None = None

    def __init__(self, config: Config | None = None) -> None:
        """Look the classes up. Raises ValueError where the paper says nothing of a localizer."""
        super().__init__(config)
        c: Triage.Config = self.config
        if (c.localizer, c.column) not in TABLE and c.localization is None:
            known = ", ".join(column for consumer, column in TABLE if consumer == c.localizer)
            raise ValueError(f"column {c.column!r} says nothing of {c.localizer}; there are {known} for it")
        self.localization = c.localization or TABLE[c.localizer, c.column]
        self.planning = c.planning or TABLE["planner", c.column]
        self.points = {"localization": 0, "planning": 0, "people": 0}
        self.frames = 0

    def on_frame(self, frame: PointCloud) -> Outputs:
        """Hand each consumer its part."""
        if frame.label is None:
            up = frame.base_from_lidar[2]
            height = frame.points @ up[:3].astype(np.float32) + np.float32(up[3])
            outputs = self.Outputs(frame, part(frame, height > self.config.floor))
        else:
            outputs = self.Outputs(
                part(frame, chosen(frame.label, self.localization)),
                part(frame, chosen(frame.label, self.planning)),
                part(frame, chosen(frame.label, ["shortT"])),
            )
        self.frames += 1
        for name in self.points:
            cloud = getattr(outputs, name)
            self.points[name] += 0 if cloud is None else len(cloud.points)
        return outputs

    def on_end(self) -> Summary:
        """Tell how many points a frame each consumer got."""
        return Summary(points_a_frame={name: count / max(1, self.frames) for name, count in self.points.items()})
