"""Sparse matrix times features, forwards and backwards, in kernels that are the same on one thread and on several."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import torch
from llvmlite import ir  # type: ignore[import-untyped]
from numba import njit, types
from numba.extending import intrinsic

from operators.kpconv.crew import side_by_side
from operators.kpconv.grid import Floats, Ints
from operators.kpconv.links import Bytes

Halves = npt.NDArray[np.uint16]  # bfloat16: the upper half of a float32

FEW = 4  # rows or channels that are not worth a second thread


@intrinsic
def bits_of(typing_context: Any, value: Any) -> Any:
    """Reinterpret a float32 as uint32."""
    return types.uint32(types.float32), lambda context, builder, kind, args: builder.bitcast(args[0], ir.IntType(32))


@intrinsic
def float_of(typing_context: Any, value: Any) -> Any:
    """Reinterpret a uint32 as float32."""
    return types.float32(types.uint32), lambda context, builder, kind, args: builder.bitcast(args[0], ir.FloatType())


@njit(cache=True, nogil=True, error_model="numpy")
def gather(
    starts: Ints, columns: Ints, places: Bytes, weights: Floats, features: Floats, out: Floats, begin: int, end: int
) -> None:
    """Write the influence-weighted sums of features (m, c) for points begin..end: out (q, k, c)."""
    channels, width = features.shape[1], out.shape[1]
    for q in range(begin, end):
        for p in range(width):
            for c in range(channels):
                out[q, p, c] = np.float32(0.0)
        for e in range(starts[q], starts[q + 1]):
            n, p, weight = columns[e], places[e], weights[e]
            for c in range(channels):
                out[q, p, c] += weight * features[n, c]


@njit(cache=True, nogil=True, error_model="numpy")
def gather_halves(
    starts: Ints, columns: Ints, places: Bytes, weights: Floats, features: Halves, out: Halves, begin: int, end: int
) -> None:
    """Do what `gather` does on bfloat16, with sums in float32."""
    channels, width = features.shape[1], out.shape[1]
    sums = np.empty((width, channels), np.float32)
    for q in range(begin, end):
        for p in range(width):
            for c in range(channels):
                sums[p, c] = np.float32(0.0)
        for e in range(starts[q], starts[q + 1]):
            n, p, weight = columns[e], places[e], weights[e]
            for c in range(channels):
                sums[p, c] += weight * float_of(np.uint32(features[n, c]) << np.uint32(16))
        for p in range(width):
            for c in range(channels):
                bits = bits_of(sums[p, c])
                even = (bits >> np.uint32(16)) & np.uint32(1)
                out[q, p, c] = np.uint16((bits + np.uint32(0x7FFF) + even) >> np.uint32(16))


@njit(cache=True, nogil=True, error_model="numpy")
def scatter(
    starts: Ints, columns: Ints, places: Bytes, weights: Floats, gradient: Floats, out: Floats, begin: int, end: int
) -> None:
    """Add to channels begin..end of out (m, c) what `gather` sends back for a gradient (q, k, c)."""
    for q in range(len(starts) - 1):
        for e in range(starts[q], starts[q + 1]):
            n, p, weight = columns[e], places[e], weights[e]
            for c in range(begin, end):
                out[n, c] += weight * gradient[q, p, c]


@njit(cache=True, nogil=True, error_model="numpy")
def gather_largest(
    starts: Ints, neighbours: Ints, features: Floats, out: Floats, winners: Ints, begin: int, end: int
) -> None:
    """Write the largest feature among each point's neighbours, and whose it is; zero where there is none."""
    for q in range(begin, end):
        for c in range(features.shape[1]):
            out[q, c] = np.float32(0.0)
            winners[q, c] = -1
        for e in range(starts[q], starts[q + 1]):
            n = neighbours[e]
            first = e == starts[q]
            for c in range(features.shape[1]):
                better = first or features[n, c] > out[q, c]
                out[q, c] = features[n, c] if better else out[q, c]
                winners[q, c] = n if better else winners[q, c]


@njit(cache=True, nogil=True, error_model="numpy")
def gather_largest_halves(
    starts: Ints, neighbours: Ints, features: npt.NDArray[np.int16], out: npt.NDArray[np.int16], begin: int, end: int
) -> None:
    """Do what `gather_largest` does on bfloat16, as 16-bit integers: below zero their order is the other way round."""
    mask, low = np.int16(0x7FFF), np.int16(-0x8000)
    for q in range(begin, end):
        for c in range(features.shape[1]):
            out[q, c] = low if starts[q] < starts[q + 1] else np.int16(0)
        for e in range(starts[q], starts[q + 1]):
            n = neighbours[e]
            for c in range(features.shape[1]):
                bits = features[n, c]
                bits = np.int16(bits ^ ((bits >> np.int16(15)) & mask))
                out[q, c] = bits if bits > out[q, c] else out[q, c]
        for c in range(features.shape[1]):
            bits = out[q, c]
            out[q, c] = np.int16(bits ^ ((bits >> np.int16(15)) & mask))


@njit(cache=True, nogil=True)
def scatter_largest(winners: Ints, gradient: Floats, out: Floats, begin: int, end: int) -> None:
    """Add to channels begin..end of out (m, c) what `gather_largest` sends back."""
    for q in range(len(winners)):
        for c in range(begin, end):
            if winners[q, c] >= 0:
                out[winners[q, c], c] += gradient[q, c]


def split(kernel: Callable[..., None], count: int, *arguments: Any) -> None:
    """Run kernel(*arguments, begin, end) over 0..count, in as many parts as torch has threads in this thread.

    Each part writes its own rows or channels, so that the number of parts changes no bit.
    """
    threads = torch.get_num_threads() if count >= FEW else 1
    bounds = [count * part // threads for part in range(threads + 1)]
    parts = itertools.pairwise(bounds)
    side_by_side([functools.partial(kernel, *arguments, begin, end) for begin, end in parts], threads)


class Matrix:
    """The sparse matrix of a convolution, as tensors on a device."""

    def __init__(self, links: Any, kernel_points: int, device: torch.device) -> None:
        self.kernel_points = kernel_points
        self.points, self.sources = len(links.starts) - 1, links.sources
        self.device = device
        self.arrays = links
        if device.type != "cpu":
            self.to_tensors()

    def to_tensors(self) -> Matrix:
        """Make the index tensors that plain torch needs."""
        counts = torch.from_numpy(np.diff(self.arrays.starts)).long()
        points = torch.repeat_interleave(torch.arange(self.points), counts)
        self.rows = (points * self.kernel_points + torch.from_numpy(self.arrays.places).long()).to(self.device)
        self.columns = torch.from_numpy(self.arrays.columns).long().to(self.device)
        self.weights = torch.from_numpy(self.arrays.weights).to(self.device)
        if len(self.arrays.neighbour_starts):
            lengths = torch.from_numpy(np.diff(self.arrays.neighbour_starts)).long()
            self.owners = torch.repeat_interleave(torch.arange(self.points), lengths).to(self.device)
            self.neighbours = torch.from_numpy(self.arrays.neighbours).long().to(self.device)
        return self


class _Aggregate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: torch.Tensor, matrix: Matrix) -> torch.Tensor:
        ctx.matrix = matrix
        links = matrix.arrays
        out = features.new_empty((matrix.points, matrix.kernel_points, features.shape[1]))
        parts = (links.starts, links.columns, links.places, links.weights)
        split(gather, matrix.points, *parts, features.detach().contiguous().numpy(), out.numpy())
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor, None]:
        matrix, gradient = ctx.matrix, gradients[0]
        links = matrix.arrays
        out = gradient.new_zeros((matrix.sources, gradient.shape[2]))
        parts = (links.starts, links.columns, links.places, links.weights)
        split(scatter, gradient.shape[2], *parts, gradient.contiguous().numpy(), out.numpy())
        return out, None


class _Largest(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: torch.Tensor, matrix: Matrix) -> torch.Tensor:
        links = matrix.arrays
        out = features.new_empty((matrix.points, features.shape[1]))
        ctx.winners, ctx.sources = np.empty(tuple(out.shape), np.int32), matrix.sources
        parts = (links.neighbour_starts, links.neighbours, features.detach().contiguous().numpy())
        split(gather_largest, matrix.points, *parts, out.numpy(), ctx.winners)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor, None]:
        gradient = gradients[0].contiguous()
        out = gradient.new_zeros((ctx.sources, gradient.shape[1]))
        split(scatter_largest, gradient.shape[1], ctx.winners, gradient.numpy(), out.numpy())
        return out, None


def aggregate(features: torch.Tensor, matrix: Matrix, *, plain: bool = False) -> torch.Tensor:
    """Sum the neighbours' features (m, c) by their influence on each kernel point: (q, k, c), with gradients.

    plain: by torch's own operations, as on devices other than the CPU.
    """
    if features.device.type == "cpu" and not plain:
        return cast(torch.Tensor, _Aggregate.apply(features, matrix))  # type: ignore[no-untyped-call]
    if not hasattr(matrix, "rows"):
        matrix.to_tensors()
    weighted = features[matrix.columns] * matrix.weights[:, None]
    out = features.new_zeros((matrix.points * matrix.kernel_points, features.shape[1]))
    return out.index_add(0, matrix.rows, weighted).view(matrix.points, matrix.kernel_points, -1)


def largest(features: torch.Tensor, matrix: Matrix, *, plain: bool = False) -> torch.Tensor:
    """Take the largest feature among each point's neighbours: (q, c), with gradients; zero where there is none."""
    if features.device.type == "cpu" and not plain:
        return cast(torch.Tensor, _Largest.apply(features, matrix))  # type: ignore[no-untyped-call]
    if not hasattr(matrix, "rows"):
        matrix.to_tensors()
    owners = matrix.owners[:, None].expand(-1, features.shape[1])
    out = features.new_zeros((matrix.points, features.shape[1]))
    return out.scatter_reduce(0, owners, features[matrix.neighbours], "amax", include_self=False)
