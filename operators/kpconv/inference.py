"""The fast path of a trained KPFCNN: folded batch norms, no autograd, bfloat16 where the CPU has it, lasting buffers.

Tolerance against the training path in evaluation mode: class probabilities within 1e-4 in float32 and within 0.1 in
bfloat16, mean difference below 0.005 (tests/test_kpconv_network.py).
"""

from __future__ import annotations

from typing import NamedTuple, cast

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from operators.kpconv.aggregation import gather, gather_halves, gather_largest, gather_largest_halves, split
from operators.kpconv.grid import Floats
from operators.kpconv.links import Links
from operators.kpconv.network import KPFCNN, SLOPE, Residual, Simple, Unary, folded
from operators.kpconv.pyramid import Pyramid


class Affine(NamedTuple):
    """A matrix (inputs, outputs) and a bias, with what follows."""

    weight: Tensor
    bias: Tensor
    rectified: bool


class Bottleneck(NamedTuple):
    """A residual block."""

    narrow: Affine | None
    convolve: Affine
    widen: Affine
    shortcut: Affine | None


def best_precision() -> torch.dtype:
    """Return bfloat16 where the CPU multiplies it natively, else float32."""
    native = (
        getattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)()
        or getattr(torch.cpu, "_is_amx_tile_supported", lambda: False)()
    )
    return torch.bfloat16 if native else torch.float32


def whole(rows: int) -> int:
    """Round up to eighths of a power of two, at least 64.

    Torch's bfloat16 products are compiled anew for each size that they have not met, which takes longer than the
    product itself; and no two frames have equally many points.
    """
    step = max(8, (1 << max(0, rows - 1).bit_length()) // 16)
    return max(64, -(-rows // step) * step)


class FastKPFCNN:
    """A trained network made for inference on the CPU, one frame at a time."""

    def __init__(self, network: KPFCNN, precision: torch.dtype | None = None) -> None:
        self.precision = best_precision() if precision is None else precision
        self.buffers: dict[str, Tensor] = {}
        with torch.no_grad():
            self.first = self.convolution(network.first)
            self.strides = [self.block(cast(Residual, block)) for block in network.strides]
            self.blocks = [self.block(cast(Residual, block)) for block in network.blocks]
            self.decoders = [self.unary(cast(Unary, unary)) for unary in network.decoders]
            self.hidden = self.affine(network.hidden.weight.T, network.hidden.bias, True)
            self.last = self.affine(network.last.weight.T, network.last.bias, False)

    def affine(self, weight: Tensor, bias: Tensor, rectified: bool) -> Affine:
        """Take a matrix and a bias in the path's precision."""
        to = self.precision
        return Affine(weight.detach().to(to).contiguous(), bias.detach().to(to).contiguous(), rectified)

    def convolution(self, layer: Simple) -> Affine:
        """Fold a convolution and its batch norm."""
        return self.affine(*folded(layer.convolution.weight.flatten(0, 1), layer.norm), True)

    def unary(self, layer: Unary) -> Affine:
        """Fold a linear layer and its batch norm."""
        return self.affine(*folded(layer.linear.weight.T, layer.norm), layer.rectified)

    def block(self, block: Residual) -> Bottleneck:
        """Fold a residual block."""
        return Bottleneck(
            None if block.narrow is None else self.unary(block.narrow),
            self.convolution(block.convolve),
            self.unary(block.widen),
            None if block.shortcut is None else self.unary(block.shortcut),
        )

    def room(self, name: str, rows: int, columns: int) -> Tensor:
        """Return a buffer (whole(rows), columns) that stays until its name is asked for again."""
        size = whole(rows) * columns
        buffer = self.buffers.get(name)
        if buffer is None or buffer.numel() < size:
            buffer = torch.zeros(size * 5 // 4, dtype=self.precision)
            self.buffers[name] = buffer
        return buffer[:size].view(-1, columns)

    def apply(self, name: str, layer: Affine, features: Tensor) -> Tensor:
        """Multiply, add, rectify: (m, inputs) to (m, outputs)."""
        out = self.room(name, len(features), layer.weight.shape[1])
        torch.addmm(layer.bias, features, layer.weight, out=out)
        return nn.functional.leaky_relu_(out, SLOPE) if layer.rectified else out

    def aggregate(self, features: Tensor, links: Links, points: int) -> Tensor:
        """Sum neighbours by their influence: (m, c) to (q, k * c)."""
        count, channels = len(links.starts) - 1, features.shape[1]
        out = self.room("aggregate", count, points * channels)
        parts = (links.starts, links.columns, links.places, links.weights)
        if self.precision == torch.float32:
            split(gather, count, *parts, features.numpy(), out.numpy().reshape(-1, points, channels))
        else:
            split(gather_halves, count, *parts, bits(features), bits(out).reshape(-1, points, channels))
        return out

    def largest(self, name: str, features: Tensor, links: Links) -> Tensor:
        """Take the largest of the neighbours: (m, c) to (q, c)."""
        count, channels = len(links.neighbour_starts) - 1, features.shape[1]
        out = self.room(name, count, channels)
        parts = (links.neighbour_starts, links.neighbours)
        if self.precision == torch.float32:
            winners = np.empty((len(out), channels), np.int32)
            split(gather_largest, count, *parts, features.numpy(), out.numpy(), winners)
        else:
            signed = (bits(features).view(np.int16), bits(out).view(np.int16))
            split(gather_largest_halves, count, *parts, *signed)
        return out

    def convolve(self, name: str, layer: Affine, features: Tensor, links: Links) -> Tensor:
        """Apply a kernel point convolution: (m, inputs) to (q, outputs)."""
        points = layer.weight.shape[0] // features.shape[1]
        return self.apply(name, layer, self.aggregate(features, links, points))

    def residual(self, name: str, block: Bottleneck, features: Tensor, links: Links, *, strided: bool) -> Tensor:
        """Apply a residual block: (m, inputs) to (q, outputs)."""
        inner = features if block.narrow is None else self.apply("narrow", block.narrow, features)
        inner = self.apply(name, block.widen, self.convolve("convolved", block.convolve, inner, links))
        shortcut = self.largest("largest", features, links) if strided else features
        if block.shortcut is None:
            inner += shortcut
        else:
            inner += self.apply("shortcut", block.shortcut, shortcut)
        return nn.functional.leaky_relu_(inner, SLOPE)

    @torch.inference_mode()
    def __call__(self, pyramid: Pyramid, inputs: Floats) -> npt.NDArray[np.float32]:
        """Return the class probabilities (m_0, classes) of a pyramid with inputs (m_0, inputs)."""
        features = torch.from_numpy(inputs).to(self.precision)
        features = self.convolve("level 0", self.first, features, pyramid.convolutions[0])
        skips = [features]
        for level, (stride, block) in enumerate(zip(self.strides, self.blocks, strict=True)):
            features = self.residual("stride", stride, features, pyramid.pools[level], strided=True)
            links = pyramid.convolutions[level + 1]
            features = self.residual(f"level {level + 1}", block, features, links, strided=False)
            skips.append(features)
        for level, decoder in zip(reversed(range(len(self.decoders))), self.decoders, strict=True):
            # a linear layer on [upsampled, skip] is a sum of two, and the first may come before upsampling
            above, skip = features.shape[1], skips[level]
            coarse = self.room("coarse", len(features), decoder.weight.shape[1])
            torch.addmm(decoder.bias, features, decoder.weight[:above], out=coarse)
            features = self.room(f"decoder {level}", len(skip), decoder.weight.shape[1])
            parents = torch.from_numpy(pyramid.parents[level])
            torch.index_select(coarse, 0, parents, out=features[: len(parents)])
            features.addmm_(skip, decoder.weight[above:])
            nn.functional.leaky_relu_(features, SLOPE)
        logits = self.apply("last", self.last, self.apply("hidden", self.hidden, features))
        return softmax(logits[: len(inputs)].float().numpy())


def softmax(logits: Floats) -> Floats:
    """Return exp(logits) / sum(exp(logits)) along the last axis; torch is slow on so few columns."""
    powers = np.exp(logits - logits.max(1, keepdims=True, initial=-np.inf))
    return cast(Floats, powers / powers.sum(1, keepdims=True))


def bits(tensor: Tensor) -> npt.NDArray[np.uint16]:
    """View a bfloat16 tensor as the integers that numpy knows."""
    return cast("npt.NDArray[np.uint16]", tensor.view(torch.uint16).numpy())
