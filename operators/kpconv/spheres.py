"""Training input of KPFCNN: spheres of frames, turned, mirrored, stretched, subsampled."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from operators.kpconv.frames import Frames
from operators.kpconv.grid import Floats, Ints, subsample
from operators.kpconv.links import Bytes
from operators.kpconv.network import KPFCNN, Batch, batch_of
from operators.kpconv.pyramid import Pyramid, build, stacked
from operators.kpconv.settings import CLASSES, Settings

INPUTS = 2  # channels of `inputs_of`
HIGHEST = 3.0  # metres; heights beyond are cut off
STRETCH = 0.1  # axes are scaled by 1 +- this, each alone
NOISE = 0.001  # metres
FEWEST = 64  # subsampled points of a sphere; smaller ones are drawn again
IGNORED = -1  # target of uncertain points


class Sphere(NamedTuple):
    """One sphere, ready for a batch."""

    pyramid: Pyramid
    inputs: Floats  # (m, INPUTS)
    targets: npt.NDArray[np.int64]  # (m,) class from 0, or IGNORED


def inputs_of(points_base: Floats) -> Floats:
    """Return what the network is told of each point (m, 2): one, and its height over the ground in metres."""
    return np.stack([np.ones(len(points_base), np.float32), np.clip(points_base[:, 2], -HIGHEST, HIGHEST)], 1)


def augmentation(generator: np.random.Generator) -> npt.NDArray[np.float64]:
    """Draw a matrix (3, 3): a turn about z, a mirror along x, a scale of each axis."""
    angle = generator.uniform(0.0, 2.0 * np.pi)
    cosine, sine = np.cos(angle), np.sin(angle)
    scale = generator.uniform(1.0 - STRETCH, 1.0 + STRETCH, 3)
    scale[0] *= 1.0 if generator.random() < 0.5 else -1.0
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]) @ np.diag(scale)


def majority(labels: Bytes, rows: Ints, count: int) -> npt.NDArray[np.int64]:
    """Return the commonest label of each voxel (count,) as a class from 0; IGNORED where that is uncertain."""
    kinds = len(CLASSES) + 1
    votes = np.bincount(rows.astype(np.int64) * kinds + labels, minlength=count * kinds).reshape(count, kinds)
    return votes.argmax(1) - 1


class SphereRecipe:
    """Makes a KPFCNN and feeds it with spheres."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings

    def network(self) -> nn.Module:
        """Return a fresh network, its weights drawn by torch's generator."""
        return KPFCNN(INPUTS, self.settings.width, self.settings.geometry)

    def sample(self, frames: Frames, generator: np.random.Generator) -> Sphere:
        """Draw a sphere about a point of a class drawn evenly."""
        while True:
            number, centre = frames.draw(generator)
            frame = frames[number]
            near = ((frame.points - frame.points[centre]) ** 2).sum(1) < self.settings.sphere**2
            points = frame.points[near].astype(np.float64) @ augmentation(generator).T
            points += generator.normal(0.0, NOISE, points.shape)
            grid, rows = subsample(points, self.settings.voxel)
            if len(grid.points) >= FEWEST:
                break
        targets = majority(frame.labels[near], rows, len(grid.points))
        return Sphere(build(grid, self.settings.geometry), inputs_of(grid.points), targets)

    def collate(self, spheres: Sequence[Sphere], device: torch.device) -> tuple[Batch, Tensor]:
        """Make one input of several spheres, and the targets of its points."""
        pyramid = stacked([sphere.pyramid for sphere in spheres])
        inputs = np.concatenate([sphere.inputs for sphere in spheres])
        targets = torch.from_numpy(np.concatenate([sphere.targets for sphere in spheres]))
        return batch_of(pyramid, inputs, device, self.settings.kernel_points), targets.to(device)
