"""A trained network at work: frame in, classified cloud out; one interface for both architectures.

classifier = load_classifier(Path("weights.safetensors"))
classified = classifier.classify(points_lidar, base_from_lidar)
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from graph.geometry import transform
from operators.kpconv.grid import NONE, Floats, Grid, Ints, closest_members, nearest, subsample
from operators.kpconv.inference import FastKPFCNN, best_precision
from operators.kpconv.links import Bytes
from operators.kpconv.network import KPFCNN
from operators.kpconv.projection import back_project, project
from operators.kpconv.pyramid import Pyramid, build
from operators.kpconv.rangenet import FastRangeNet, RangeNet
from operators.kpconv.settings import CLASSES, Settings
from operators.kpconv.spheres import inputs_of
from operators.kpconv.weights import load


class Classified(NamedTuple):
    """A classified, subsampled cloud, and what it says of all points of its frame."""

    points: Floats  # (m, 3) barycentres, metres, lidar's frame
    scores: Floats  # (m, 4) probability of labels 1 to 4
    source: Ints  # (m,) of each voxel the point nearest to its barycentre
    table: Floats  # (t, 4) scores, of which each point of the frame has one row:
    rows: Ints  # (n,) or -1 for points that no network was asked about; none at all where they were not wanted

    @property
    def labels(self) -> Bytes:
        """Return the likeliest label (m,) of each subsampled point, 1 to 4."""
        return likeliest(self.scores)

    def full(self) -> tuple[Bytes, Floats]:
        """Return labels (n,), 0 where unknown, and scores (n, 4) of every point of the frame."""
        known = self.rows != NONE
        labels, scores = np.zeros(len(known), np.uint8), np.full((len(known), len(CLASSES)), 0.25, np.float32)
        labels[known], scores[known] = likeliest(self.table)[self.rows[known]], self.table[self.rows[known]]
        return labels, scores


class Prepared(NamedTuple):
    """A frame on its way to the network: what does not depend on the weights."""

    given: Any  # what the network takes
    grid: Grid  # subsampled frame, base frame
    voxel_rows: Ints  # (n,) subsampled point of each point, or -1
    points_base: Floats  # (n, 3)
    base_from_lidar: npt.NDArray[np.float64]


class Classifier(Protocol):
    """What both architectures do; `classify` is the three others in turn."""

    settings: Settings

    def prepare(self, points: Floats, base_from_lidar: npt.NDArray[Any], ring: Bytes | None = None) -> Prepared:
        """Build the pyramid or the image of points (n, 3) in the lidar's frame."""

    def infer(self, prepared: Prepared) -> Floats:
        """Return the scores (t, 4) of what the network sees."""

    def finish(self, prepared: Prepared, table: Floats, *, full: bool = True) -> Classified:
        """Bring the scores back to the points; full: also to all points of the frame."""

    def classify(
        self, points: Floats, base_from_lidar: npt.NDArray[Any], ring: Bytes | None = None, *, full: bool = True
    ) -> Classified:
        """Classify points (n, 3) in the lidar's frame."""


def likeliest(scores: Floats) -> Bytes:
    """Return the label (n,), 1 to 4, of the largest score (n, 4)."""
    return (scores.argmax(1) + 1).astype(np.uint8) if len(scores) else np.zeros(0, np.uint8)


def in_lidar_frame(points_base: Floats, base_from_lidar: npt.NDArray[np.float64]) -> Floats:
    """Move barycentres back to where the frame came from."""
    return transform(np.linalg.inv(base_from_lidar), points_base)


class KPConvClassifier:
    """A KPFCNN that classifies frames."""

    def __init__(self, network: KPFCNN, settings: Settings, precision: torch.dtype) -> None:
        self.settings = settings
        self.network = FastKPFCNN(network, precision)

    def prepare(self, points: Floats, base_from_lidar: npt.NDArray[Any], ring: Bytes | None = None) -> Prepared:
        """Subsample points (n, 3) of the lidar's frame, and build the pyramid."""
        points_base = transform(base_from_lidar, points)
        grid, rows = subsample(points_base, self.settings.voxel)
        pyramid = build(grid, self.settings.geometry, torch.get_num_threads())
        return Prepared((pyramid, inputs_of(grid.points)), grid, rows, points_base, base_from_lidar)

    def infer(self, prepared: Prepared) -> Floats:
        """Return the scores of the subsampled points."""
        pyramid: Pyramid = prepared.given[0]
        return self.network(*prepared.given) if len(pyramid.points[0]) else np.zeros((0, len(CLASSES)), np.float32)

    def finish(self, prepared: Prepared, table: Floats, *, full: bool = True) -> Classified:
        """Give each point the scores of the nearest subsampled one."""
        grid, rows, points = prepared.grid, prepared.voxel_rows, prepared.points_base
        return Classified(
            in_lidar_frame(grid.points, prepared.base_from_lidar),
            table,
            closest_members(grid, points, rows),
            table,
            nearest(grid, points, rows) if full else np.zeros(0, np.int32),
        )

    def classify(
        self, points: Floats, base_from_lidar: npt.NDArray[Any], ring: Bytes | None = None, *, full: bool = True
    ) -> Classified:
        """Classify points (n, 3) in the lidar's frame."""
        prepared = self.prepare(points, base_from_lidar, ring)
        return self.finish(prepared, self.infer(prepared), full=full)


class RangeClassifier:
    """A RangeNet that classifies frames."""

    def __init__(self, network: RangeNet, settings: Settings, precision: torch.dtype) -> None:
        self.settings = settings
        self.network = FastRangeNet(network, precision)

    def prepare(self, points: Floats, base_from_lidar: npt.NDArray[Any], ring: Bytes | None = None) -> Prepared:
        """Project points (n, 3) of the lidar's frame."""
        points_base = transform(base_from_lidar, points)
        grid, rows = subsample(points_base, self.settings.voxel)
        good = np.flatnonzero(rows != NONE).astype(np.int32)
        level = points_base[good] - np.asarray(base_from_lidar)[:3, 3].astype(np.float32)  # about the sensor, upright
        beams = None if ring is None else ring[good]
        settings = self.settings
        shown = project(level, points_base[good, 2], beams, beams=settings.beams, columns=settings.columns)
        return Prepared((shown, level, good), grid, rows, points_base, base_from_lidar)

    def infer(self, prepared: Prepared) -> Floats:
        """Return the scores of the pixels, row by row."""
        return self.network(prepared.given[0].image)

    def finish(self, prepared: Prepared, table: Floats, *, full: bool = True) -> Classified:
        """Give each point the scores of a pixel, and each voxel those of the point nearest to its barycentre."""
        shown, level, good = prepared.given
        rows = np.full(len(prepared.points_base), NONE, np.int32)
        rows[good] = back_project(level, shown.winners, shown.row, shown.column)
        source = closest_members(prepared.grid, prepared.points_base, prepared.voxel_rows)
        points = in_lidar_frame(prepared.grid.points, prepared.base_from_lidar)
        return Classified(points, table[rows[source]], source, table, rows)

    def classify(
        self, points: Floats, base_from_lidar: npt.NDArray[Any], ring: Bytes | None = None, *, full: bool = True
    ) -> Classified:
        """Classify points (n, 3) in the lidar's frame."""
        prepared = self.prepare(points, base_from_lidar, ring)
        return self.finish(prepared, self.infer(prepared), full=full)


def classifier_of(network: nn.Module, settings: Settings, precision: torch.dtype | None = None) -> Classifier:
    """Put a trained network to work; precision None: bfloat16 where the CPU multiplies it natively, else float32."""
    precision = best_precision() if precision is None else precision
    if isinstance(network, KPFCNN):
        return KPConvClassifier(network, settings, precision)
    assert isinstance(network, RangeNet)
    return RangeClassifier(network, settings, precision)


def load_classifier(path: Path, precision: torch.dtype | None = None) -> Classifier:
    """Read a trained network and put it to work. Raises WeightsError by name of what is wrong with the file."""
    network, header = load(path)
    return classifier_of(network, header.settings, precision)
