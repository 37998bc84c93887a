"""A small U-Net on range images, after RangeNet++ (Milioto et al. 2019): the second architecture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from operators.kpconv.frames import Frames
from operators.kpconv.grid import Floats
from operators.kpconv.network import SLOPE
from operators.kpconv.projection import CHANNELS, project
from operators.kpconv.settings import CLASSES, Settings
from operators.kpconv.spheres import IGNORED, NOISE, STRETCH

STRIDES = ((1, 2), (2, 2), (2, 2), (2, 2))  # rows, columns: an image has few beams, so the first halves columns alone
WIDTHS = (1.0, 1.5, 2.0, 3.0, 4.0)  # of the levels, in units of the network's width


class Convolution(nn.Module):
    """A 3 x 3 convolution whose columns go round, batch norm, a leaky rectifier."""

    def __init__(self, inputs: int, outputs: int, stride: tuple[int, int] = (1, 1)) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(inputs, outputs, 3, stride, bias=False)
        self.norm = nn.BatchNorm2d(outputs)

    def forward(self, image: Tensor) -> Tensor:
        """Map (b, inputs, rows, columns) to (b, outputs, rows / stride, columns / stride)."""
        image = nn.functional.pad(nn.functional.pad(image, (1, 1, 0, 0), mode="circular"), (0, 0, 1, 1))
        return nn.functional.leaky_relu_(self.norm(self.convolution(image)), SLOPE)


class Residual(nn.Module):
    """Two convolutions and a shortcut."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.one, self.two = Convolution(channels, channels), Convolution(channels, channels)

    def forward(self, image: Tensor) -> Tensor:
        """Keep the shape."""
        return image + self.two(self.one(image))


class RangeNet(nn.Module):
    """Classify the pixels of range images; width: channels of the finest level."""

    def __init__(self, width: int, classes: int = len(CLASSES)) -> None:
        super().__init__()
        channels = [round(width * factor) for factor in WIDTHS]
        self.stem = Convolution(CHANNELS, channels[0])
        self.downs, self.ups, self.merges = nn.ModuleList(), nn.ModuleList(), nn.ModuleList()
        for fine, coarse, stride in zip(channels[:-1], channels[1:], STRIDES, strict=True):
            self.downs.append(nn.Sequential(Convolution(fine, coarse, stride), Residual(coarse)))
        for fine, coarse, stride in reversed(list(zip(channels[:-1], channels[1:], STRIDES, strict=True))):
            self.ups.append(nn.Sequential(nn.Conv2d(coarse, fine, 1), nn.Upsample(scale_factor=stride)))
            self.merges.append(Convolution(fine, fine))
        self.last = nn.Conv2d(channels[0], classes, 1)

    def forward(self, image: Tensor) -> Tensor:
        """Return logits (b, classes, rows, columns) of images (b, CHANNELS, rows, columns)."""
        features = self.stem(image)
        skips = []
        for down in self.downs:
            skips.append(features)
            features = down(features)
        for up, merge in zip(self.ups, self.merges, strict=True):
            features = merge(up(features) + skips.pop())
        return self.last(features)


class Window(NamedTuple):
    """Some columns of a range image, with targets."""

    image: Floats  # (CHANNELS, rows, columns)
    targets: npt.NDArray[np.int64]  # (rows, columns)


class WindowRecipe:
    """Makes a RangeNet and feeds it with windows of range images about a point of a class drawn evenly."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings

    def network(self) -> nn.Module:
        """Return a fresh network, its weights drawn by torch's generator."""
        return RangeNet(self.settings.width)

    def sample(self, frames: Frames, generator: np.random.Generator) -> Window:
        """Draw a window: mirrored, stretched alike in all directions, which keeps each point on its ray."""
        number, centre = frames.draw(generator)
        frame, settings = frames[number], self.settings
        scale = generator.uniform(1.0 - STRETCH, 1.0 + STRETCH)
        points = ((frame.points - frame.origin) * scale).astype(np.float32)
        points *= 1.0 + (generator.normal(0.0, NOISE, len(points)) / 5.0)[:, None].astype(np.float32)
        if generator.random() < 0.5:
            points[:, 0] *= -1.0
        heights = points[:, 2] + np.float32(frame.origin[2] * scale)
        shown = project(points, heights, frame.ring, beams=settings.beams, columns=settings.columns)
        targets = np.full(shown.winners.shape, IGNORED, np.int64)
        filled = shown.winners >= 0
        targets[filled] = frame.labels[shown.winners[filled]].astype(np.int64) - 1
        first = int(shown.column[centre]) + int(generator.integers(-settings.window // 2, 1))
        chosen = np.arange(first, first + settings.window) % settings.columns
        return Window(np.ascontiguousarray(shown.image[:, :, chosen]), targets[:, chosen])

    def collate(self, windows: Sequence[Window], device: torch.device) -> tuple[Tensor, Tensor]:
        """Make one input of several windows, and the targets of its pixels."""
        images = torch.from_numpy(np.stack([window.image for window in windows]))
        targets = torch.from_numpy(np.stack([window.targets for window in windows]))
        return images.to(device, memory_format=torch.channels_last), targets.to(device)


class FastRangeNet:
    """A trained network made for inference on the CPU: folded batch norms, channels last, bfloat16 if wanted."""

    def __init__(self, network: RangeNet, precision: torch.dtype) -> None:
        self.precision = precision
        self.network = RangeNet(network.last.in_channels)
        self.network.load_state_dict(network.state_dict())
        self.network.eval()
        for module in self.network.modules():
            if isinstance(module, Convolution):
                module.convolution = nn.utils.fuse_conv_bn_eval(module.convolution, module.norm)
                module.norm = nn.Identity()  # type: ignore[assignment]
        self.network.to(precision).to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    @torch.inference_mode()
    def __call__(self, image: Floats) -> npt.NDArray[np.float32]:
        """Return the class probabilities (rows * columns, classes) of an image (CHANNELS, rows, columns)."""
        given = torch.from_numpy(image)[None].to(self.precision).to(memory_format=torch.channels_last)
        scores = torch.softmax(self.network(given)[0].float(), 0)
        return scores.flatten(1).T.contiguous().numpy()
