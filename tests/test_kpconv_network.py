"""KPConv, KPFCNN and its fast path: against dense sums, finite differences, and each other."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch

from operators.kpconv.aggregation import Matrix, aggregate, largest, split
from operators.kpconv.classifier import classifier_of
from operators.kpconv.frames import Frames
from operators.kpconv.grid import subsample
from operators.kpconv.inference import FastKPFCNN
from operators.kpconv.links import kernel_of, link
from operators.kpconv.network import KPFCNN, KPConv, batch_of, parameters_of
from operators.kpconv.plan import Plan
from operators.kpconv.pyramid import Geometry, Pyramid, build
from operators.kpconv.settings import Settings
from operators.kpconv.spheres import INPUTS, inputs_of
from operators.kpconv.training import Trainer

TINY = Settings(voxel=0.25, width=16, levels=3)
LIDAR = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0.64], [0, 0, 0, 1.0]])


def scene(seed: int, count: int = 3000) -> tuple[np.ndarray, np.ndarray]:
    """Draw a room in the lidar's frame: a floor, two walls, low boxes, thin columns; and its labels 1 to 4."""
    generator = np.random.default_rng(seed)
    labels = generator.choice([1, 2, 3, 4], count, p=[0.4, 0.3, 0.15, 0.15]).astype(np.uint8)
    points = generator.uniform(-4.0, 4.0, (count, 3))
    points[labels == 1, 2] = 0.0
    wall = np.flatnonzero(labels == 2)
    points[wall[::2], 0], points[wall[1::2], 1] = 4.0, -4.0
    points[wall, 2] = generator.uniform(0.0, 2.5, len(wall))
    for label, size, height in ((3, 0.6, 0.7), (4, 0.2, 1.8)):
        middles = generator.uniform(-3.0, 3.0, (3, 2))
        mine = np.flatnonzero(labels == label)
        points[mine, :2] = middles[mine % 3] + generator.uniform(-size, size, (len(mine), 2))
        points[mine, 2] = generator.uniform(0.1, height, len(mine))
    points[:, 2] -= LIDAR[2, 3]
    return points.astype(np.float32), labels


@pytest.fixture(scope="module")
def pyramid() -> Pyramid:
    points, _ = scene(0)
    return build(subsample(points, TINY.voxel)[0], TINY.geometry)


@pytest.fixture(scope="module")
def trained() -> Trainer:
    """A tiny network that knows the scenes."""
    frames = Frames()
    for seed in range(4):
        points, labels = scene(seed)
        frames.add(points, labels, LIDAR)
    torch.set_num_threads(1)
    trainer = Trainer(TINY, Plan(steps=60, batch=4, rate=1e-2), frames)
    trainer.run()
    return trainer


@pytest.fixture
def two_threads() -> Iterator[None]:
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(1)


def test_the_papers_network_has_as_many_parameters_as_the_authors() -> None:
    assert parameters_of(KPFCNN(1, 128, Geometry(0.04))) == pytest.approx(16.3e6, rel=0.005)
    assert parameters_of(KPFCNN(1, 32, Geometry(0.04))) == pytest.approx(1.0e6, rel=0.03)


def test_a_convolution_is_the_sum_over_neighbours_and_kernel_points() -> None:
    grid, _ = subsample(scene(1, 60)[0], TINY.voxel)
    radius, extent = 2.5 * TINY.voxel, 1.2 * TINY.voxel
    kernel = kernel_of(15, 1.2 / 2.5)
    layer = KPConv(3, 5, 15)
    features = torch.randn(len(grid.points), 3, generator=torch.Generator().manual_seed(0))
    matrix = Matrix(link(grid, grid.points, radius=radius, kernel=kernel), 15, torch.device("cpu"))
    wanted = np.zeros((len(grid.points), 5))
    weight = layer.weight.detach().double().numpy()
    for row, x in enumerate(grid.points.astype(float)):  # Thomas et al. 2019, eq. 1
        for y, feature in zip(grid.points.astype(float), features.double().numpy(), strict=True):
            if np.linalg.norm(y - x) <= radius:
                influence = 1.0 - np.linalg.norm(y - x - radius * kernel.points, axis=1) / extent
                wanted[row] += np.einsum("k,kio,i->o", np.maximum(influence, 0.0), weight, feature)
    np.testing.assert_allclose(layer(features, matrix).detach().numpy(), wanted, atol=1e-5)


def test_gradients_are_those_of_finite_differences(pyramid: Pyramid) -> None:
    generator = torch.Generator().manual_seed(0)
    layer = KPConv(4, 3, 15).double()
    for links, take in ((pyramid.pools[0], True), (pyramid.convolutions[1], False)):
        matrix = Matrix(links, 15, torch.device("cpu"))
        features = torch.randn(links.sources, 4, generator=generator, dtype=torch.float64, requires_grad=True)
        mix = torch.randn(matrix.points, 3, generator=generator, dtype=torch.float64)
        step = torch.randn(features.shape, generator=generator, dtype=torch.float64)
        weight_step = torch.randn(layer.weight.shape, generator=generator, dtype=torch.float64)

        def value(features: torch.Tensor, weight: torch.Tensor, matrix: Matrix = matrix) -> torch.Tensor:
            return (aggregate(features, matrix).flatten(1) @ weight.flatten(0, 1) * mix).sum()  # noqa: B023

        by_features, by_weight = torch.autograd.grad(value(features, layer.weight), [features, layer.weight])
        tiny = 1e-6
        for slope, plus, minus in (
            (
                (by_features * step).sum(),
                (features + tiny * step, layer.weight),
                (features - tiny * step, layer.weight),
            ),
            (
                (by_weight * weight_step).sum(),
                (features, layer.weight + tiny * weight_step),
                (features, layer.weight - tiny * weight_step),
            ),
        ):
            difference = (value(*plus) - value(*minus)) / (2 * tiny)
            assert difference.item() == pytest.approx(slope.item(), rel=1e-5)
        if take:
            (gradient,) = torch.autograd.grad((largest(features, matrix)[:, :3] * mix).sum(), [features])
            sums = [(largest(features + sign * tiny * step, matrix)[:, :3] * mix).sum() for sign in (1, -1)]
            assert (sums[0] - sums[1]).item() / (2 * tiny) == pytest.approx((gradient * step).sum().item(), rel=1e-5)


def test_the_kernels_do_what_torch_does(pyramid: Pyramid) -> None:
    features = torch.randn(len(pyramid.points[0]), 8, generator=torch.Generator().manual_seed(1))
    matrix = Matrix(pyramid.pools[0], 15, torch.device("cpu"))
    for one in (aggregate, largest):
        mine, theirs = features.clone().requires_grad_(), features.clone().requires_grad_()
        fast, plain = one(mine, matrix), one(theirs, matrix, plain=True)
        torch.testing.assert_close(fast, plain, atol=1e-5, rtol=1e-5)
        fast.square().sum().backward()
        plain.square().sum().backward()
        torch.testing.assert_close(mine.grad, theirs.grad, atol=1e-4, rtol=1e-4)


def test_threads_change_no_bit_of_a_kernel(pyramid: Pyramid, two_threads: None) -> None:
    features = torch.randn(len(pyramid.points[0]), 8, generator=torch.Generator().manual_seed(1), requires_grad=True)
    matrix = Matrix(pyramid.pools[0], 15, torch.device("cpu"))
    results = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        value = aggregate(features, matrix)
        results.append((value.detach(), *torch.autograd.grad(value.square().sum(), [features])))
    for one, two in zip(*results, strict=True):
        assert torch.equal(one, two)
    seen: list[tuple[int, int]] = []
    split(lambda begin, end: seen.append((begin, end)), 5)
    assert sorted(seen) == [(0, 2), (2, 5)]


def test_the_network_learns_the_scenes(trained: Trainer) -> None:
    classifier = classifier_of(trained.network, TINY, torch.float32)
    points, labels = scene(0)
    found, scores = classifier.classify(points, LIDAR).full()
    recall = [(found[labels == label] == label).mean() for label in (1, 2, 3, 4)]
    assert min(recall) > 0.85
    np.testing.assert_allclose(scores.sum(1), 1.0, atol=1e-5)
    assert trained.state.history[-1]["loss"] < 0.5 * trained.state.history[0]["loss"]


def test_the_order_of_the_points_changes_no_prediction(trained: Trainer) -> None:
    classifier = classifier_of(trained.network, TINY)
    points, _ = scene(5)
    order = np.random.default_rng(2).permutation(len(points))
    one, other = classifier.classify(points, LIDAR), classifier.classify(points[order], LIDAR)
    np.testing.assert_array_equal(one.points, other.points)
    np.testing.assert_array_equal(one.scores, other.scores)
    np.testing.assert_array_equal(one.full()[0][order], other.full()[0])


@pytest.mark.parametrize("turn", [0.4, 1.9, np.pi])
def test_a_turned_cloud_keeps_its_classes(trained: Trainer, turn: float) -> None:
    classifier = classifier_of(trained.network, TINY, torch.float32)
    points, _ = scene(1)
    cosine, sine = np.cos(turn), np.sin(turn)
    turned = (points @ np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])).astype(np.float32)
    before, after = (classifier.classify(given, LIDAR).full()[0] for given in (points, turned))
    assert (before == after).mean() > 0.93


def test_the_fast_path_is_the_training_path(trained: Trainer) -> None:
    points, _ = scene(7)
    grid, _ = subsample(points + LIDAR[:3, 3].astype(np.float32), TINY.voxel)
    pyramid = build(grid, TINY.geometry)
    inputs = inputs_of(grid.points)
    network = trained.network.eval()
    assert isinstance(network, KPFCNN)
    with torch.no_grad():
        wanted = torch.softmax(network(batch_of(pyramid, inputs)), 1).numpy()
        plain = torch.softmax(network(batch_of(pyramid, inputs), plain=True), 1).numpy()
    np.testing.assert_allclose(plain, wanted, atol=1e-5)
    np.testing.assert_allclose(FastKPFCNN(network, torch.float32)(pyramid, inputs), wanted, atol=1e-4)
    halves = FastKPFCNN(network, torch.bfloat16)
    first = halves(pyramid, inputs)
    assert np.abs(first - wanted).max() < 0.1
    assert np.abs(first - wanted).mean() < 0.005
    small = build(subsample(grid.points[:40], TINY.voxel)[0], TINY.geometry)
    halves(small, inputs_of(small.points[0]))
    np.testing.assert_array_equal(halves(pyramid, inputs), first)  # buffers hold nothing over


def test_no_points_are_no_problem(trained: Trainer) -> None:
    classifier = classifier_of(trained.network, TINY)
    result = classifier.classify(np.zeros((0, 3), np.float32), LIDAR)
    assert result.points.shape == (0, 3)
    assert result.scores.shape == (0, 4)
    lost = classifier.classify(np.array([[np.nan, 0, 0], [1, 1, 0]], np.float32), LIDAR)
    assert lost.full()[0][0] == 0
    assert lost.full()[0][1] > 0
    assert inputs_of(lost.points).shape == (1, INPUTS)
