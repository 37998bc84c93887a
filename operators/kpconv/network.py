"""KPFCNN: an encoder of residual kernel point convolutions, a decoder of nearest upsampling, five levels."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from operators.kpconv.aggregation import Matrix, aggregate, largest
from operators.kpconv.grid import Floats
from operators.kpconv.pyramid import Geometry, Pyramid
from operators.kpconv.settings import CLASSES

SLOPE = 0.1  # of the leaky rectifiers


class Batch(NamedTuple):
    """A pyramid on a device, with the features of its finest points."""

    features: Tensor  # (m_0, inputs)
    convolutions: tuple[Matrix, ...]
    pools: tuple[Matrix, ...]
    parents: tuple[Tensor, ...]


def batch_of(pyramid: Pyramid, features: Floats, device: torch.device | str = "cpu", kernel_points: int = 15) -> Batch:
    """Put a pyramid on a device."""
    device = torch.device(device)
    return Batch(
        torch.from_numpy(features).to(device),
        tuple(Matrix(links, kernel_points, device) for links in pyramid.convolutions),
        tuple(Matrix(links, kernel_points, device) for links in pyramid.pools),
        tuple(torch.from_numpy(parents).to(device) for parents in pyramid.parents),
    )


class KPConv(nn.Module):
    """Convolve features on points with a rigid kernel: linear influence, summed (Thomas et al. 2019, section 3.1)."""

    def __init__(self, inputs: int, outputs: int, kernel_points: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(kernel_points, inputs, outputs))
        nn.init.kaiming_uniform_(self.weight.view(kernel_points * inputs, outputs).T, a=5**0.5)

    def forward(self, features: Tensor, matrix: Matrix, *, plain: bool = False) -> Tensor:
        """Map features (m, inputs) to (q, outputs)."""
        return aggregate(features, matrix, plain=plain).flatten(1) @ self.weight.flatten(0, 1)


class Unary(nn.Module):
    """A linear layer, batch norm and, if wanted, a leaky rectifier."""

    def __init__(self, inputs: int, outputs: int, *, rectified: bool = True) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, outputs, bias=False)
        self.norm = nn.BatchNorm1d(outputs)
        self.rectified = rectified

    def forward(self, features: Tensor) -> Tensor:
        """Map (m, inputs) to (m, outputs)."""
        features = self.norm(self.linear(features))
        return nn.functional.leaky_relu(features, SLOPE) if self.rectified else features


class Simple(nn.Module):
    """A kernel point convolution, batch norm, a leaky rectifier."""

    def __init__(self, inputs: int, outputs: int, kernel_points: int) -> None:
        super().__init__()
        self.convolution = KPConv(inputs, outputs, kernel_points)
        self.norm = nn.BatchNorm1d(outputs)

    def forward(self, features: Tensor, matrix: Matrix, *, plain: bool = False) -> Tensor:
        """Map (m, inputs) to (q, outputs)."""
        features = self.norm(self.convolution(features, matrix, plain=plain))
        return nn.functional.leaky_relu(features, SLOPE)


class Residual(nn.Module):
    """A bottleneck: narrow to a quarter, convolve (strided: to fewer points), widen, add the shortcut."""

    def __init__(self, inputs: int, outputs: int, kernel_points: int, *, strided: bool) -> None:
        super().__init__()
        narrow = outputs // 4
        self.narrow = Unary(inputs, narrow) if inputs != narrow else None
        self.convolve = Simple(narrow, narrow, kernel_points)
        self.widen = Unary(narrow, outputs, rectified=False)
        self.shortcut = Unary(inputs, outputs, rectified=False) if inputs != outputs else None
        self.strided = strided

    def forward(self, features: Tensor, matrix: Matrix, *, plain: bool = False) -> Tensor:
        """Map (m, inputs) to (q, outputs)."""
        inner = features if self.narrow is None else self.narrow(features)
        inner = self.widen(self.convolve(inner, matrix, plain=plain))
        shortcut = largest(features, matrix, plain=plain) if self.strided else features
        shortcut = shortcut if self.shortcut is None else self.shortcut(shortcut)
        return nn.functional.leaky_relu(inner + shortcut, SLOPE)


class KPFCNN(nn.Module):
    """Classify the points of a pyramid: simple; 4 x (strided residual, residual); 4 x (upsample, unary); head.

    width: channels of the decoder's last layer, 128 in the paper (16.3 M parameters); all others follow.
    """

    def __init__(self, inputs: int, width: int, geometry: Geometry, classes: int = len(CLASSES)) -> None:
        super().__init__()
        count = geometry.kernel_points
        self.first = Simple(inputs, width // 2, count)
        channels = [width // 2]  # of each level's last encoder layer
        self.strides, self.blocks = nn.ModuleList(), nn.ModuleList()
        for level in range(geometry.levels - 1):
            wide = width * 2**level
            self.strides.append(Residual(channels[-1], wide, count, strided=True))
            self.blocks.append(Residual(wide, 2 * wide, count, strided=False))
            channels.append(2 * wide)
        self.decoders = nn.ModuleList()
        above = channels[-1]
        for level in reversed(range(geometry.levels - 1)):
            self.decoders.append(Unary(above + channels[level], width * 2**level))
            above = width * 2**level
        self.hidden = nn.Linear(above, width)
        self.last = nn.Linear(width, classes)

    def forward(self, batch: Batch, *, plain: bool = False) -> Tensor:
        """Return logits (m_0, classes)."""
        features = self.first(batch.features, batch.convolutions[0], plain=plain)
        skips = [features]
        for level, (stride, block) in enumerate(zip(self.strides, self.blocks, strict=True)):
            features = stride(features, batch.pools[level], plain=plain)
            features = block(features, batch.convolutions[level + 1], plain=plain)
            skips.append(features)
        for level, decoder in zip(reversed(range(len(self.decoders))), self.decoders, strict=True):
            features = decoder(torch.cat([features.index_select(0, batch.parents[level]), skips[level]], 1))
        return self.last(nn.functional.leaky_relu(self.hidden(features), SLOPE))


def folded(weight: Tensor, norm: nn.BatchNorm1d) -> tuple[Tensor, Tensor]:
    """Fold a batch norm's running statistics into the matrix (inputs, outputs) before it; returns matrix and bias."""
    assert norm.running_mean is not None
    assert norm.running_var is not None
    scale = norm.weight / torch.sqrt(norm.running_var + norm.eps)
    return weight * scale, norm.bias - norm.running_mean * scale


def parameters_of(network: nn.Module) -> int:
    """Count the trained numbers of a network."""
    return sum(parameter.numel() for parameter in network.parameters())
