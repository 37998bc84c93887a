"""The range image: there and back, round and round; its network against its fast path."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
import torch
from test_kpconv_network import LIDAR, scene

from operators.kpconv.classifier import classifier_of
from operators.kpconv.frames import Frames
from operators.kpconv.plan import Plan
from operators.kpconv.projection import back_project, project, rows_of
from operators.kpconv.rangenet import FastRangeNet, RangeNet, WindowRecipe
from operators.kpconv.settings import Settings
from operators.kpconv.training import Trainer

BEAMS, COLUMNS = 16, 64
TINY = Settings(network="rangenet", voxel=0.25, width=8, beams=BEAMS, columns=COLUMNS, window=32)


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> None:
    torch.set_num_threads(1)


def scan(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points of a scene that a lidar would see, their labels and beams."""
    points, labels = scene(seed, 6000)
    shown = project(points, points[:, 2], None, beams=BEAMS, columns=COLUMNS)
    chosen = shown.winners[shown.winners >= 0]
    return points[chosen], labels[chosen], shown.row[chosen].astype(np.uint8)


def test_a_pixel_shows_its_nearest_point_and_every_point_its_nearest_pixel() -> None:
    points, _ = scene(0, 2000)
    shown = project(points, points[:, 2], None, beams=BEAMS, columns=COLUMNS)
    distance = np.linalg.norm(points, axis=1)
    for n in range(0, len(points), 7):
        winner = shown.winners[shown.row[n], shown.column[n]]
        assert distance[winner] <= distance[n] + 1e-6
    pixels = back_project(points, shown.winners, shown.row, shown.column)
    winners = shown.winners.reshape(-1)
    own = winners[winners >= 0]
    np.testing.assert_array_equal(winners[pixels[own]], own)
    others = np.linalg.norm(points[winners[pixels]] - points, axis=1)
    mine = np.linalg.norm(points[winners[shown.row * COLUMNS + shown.column]] - points, axis=1)
    assert (others <= mine + 1e-6).all()
    np.testing.assert_allclose(shown.image[1][shown.winners >= 0], np.log1p(distance[own]), atol=1e-6)


def test_beams_become_rows() -> None:
    points = np.zeros((4, 3), np.float32)
    assert rows_of(points, np.array([0, 15, 3, 3], np.uint8), 16).tolist() == [0, 15, 3, 3]
    assert rows_of(points, np.array([0, 31, 2, 3], np.uint8), 16).tolist() == [0, 15, 1, 1]
    steep = np.array([[1, 0, -1], [1, 0, 0], [1, 0, 1]], np.float32)
    assert rows_of(steep, None, 3).tolist() == [0, 1, 2]


def test_a_turn_by_whole_columns_turns_the_scores() -> None:
    torch.manual_seed(0)
    network = RangeNet(8).eval()
    image = torch.randn(1, 4, BEAMS, COLUMNS)
    with torch.no_grad():
        turned = network(torch.roll(image, 16, 3))  # whole columns of the coarsest level
        torch.testing.assert_close(turned, torch.roll(network(image), 16, 3), atol=1e-5, rtol=1e-4)


def test_a_window_holds_the_drawn_point() -> None:
    frames = Frames()
    points, labels, ring = scan(1)
    labels[:] = 0
    labels[100] = 3
    frames.add(points, labels, LIDAR, ring)
    for seed in range(10):
        window = WindowRecipe(TINY).sample(frames, np.random.default_rng(seed))
        assert window.image.shape == (4, BEAMS, 32)
        assert (window.targets == 2).sum() == 1


def test_the_network_learns_and_its_fast_path_agrees() -> None:
    frames = Frames()
    scans = [scan(seed) for seed in range(3)]
    for points, labels, ring in scans:
        frames.add(points, labels, LIDAR, ring)
    trainer = Trainer(TINY, Plan(steps=60, batch=3, rate=1e-2), frames)
    trainer.run()
    classifier = classifier_of(trainer.network, TINY, torch.float32)
    points, labels, ring = scans[0]
    result = classifier.classify(points, LIDAR, ring)
    found, scores = result.full()
    assert (found == labels).mean() > 0.8
    np.testing.assert_allclose(scores.sum(1), 1.0, atol=1e-5)
    assert len(result.points) == len(result.scores) == len(result.source) < len(points)
    network = trainer.network.eval()
    assert isinstance(network, RangeNet)
    image = project(points, points[:, 2], ring, beams=BEAMS, columns=COLUMNS).image
    with torch.no_grad():
        wanted = torch.softmax(network(torch.from_numpy(image)[None])[0], 0).flatten(1).T.numpy()
    np.testing.assert_allclose(FastRangeNet(network, torch.float32)(image), wanted, atol=1e-4)
    halves = FastRangeNet(network, torch.bfloat16)(image)
    assert np.abs(halves - wanted).mean() < 0.01
    order = np.random.default_rng(0).permutation(len(points))
    np.testing.assert_array_equal(classifier.classify(points[order], LIDAR, ring[order]).full()[0], found[order])


@pytest.mark.parametrize("columns", [32, 128])
def test_the_number_of_columns_is_a_setting(columns: int) -> None:
    settings = msgspec.structs.replace(TINY, columns=columns)
    points, _, ring = scan(2)
    result = classifier_of(RangeNet(8).eval(), settings).classify(points, LIDAR, ring)
    assert result.full()[0].min() >= 1
