"""Training: sampling, repeatability, resuming, early stop, weights on disk."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch
from test_kpconv_network import LIDAR, TINY, scene

from operators.kpconv.frames import Frames
from operators.kpconv.plan import WARM_UP, Plan
from operators.kpconv.settings import Settings
from operators.kpconv.spheres import IGNORED, SphereRecipe, augmentation, majority
from operators.kpconv.training import Progress, Trainer
from operators.kpconv.weights import Header, WeightsError, halved, load, save

SMALL = msgspec.structs.replace(TINY, width=8)
RANGE = Settings(network="rangenet", voxel=0.25, width=4, beams=16, columns=64, window=32)


def frames(*seeds: int, count: int = 800) -> Frames:
    """Pack some scenes."""
    result = Frames()
    for seed in seeds:
        points, labels = scene(seed, count)
        result.add(points, labels, LIDAR)
    return result


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def test_a_frame_is_kept_to_the_millimetre() -> None:
    points, labels = scene(0)
    points[5] = np.nan
    kept = Frames()
    kept.add(points, labels, LIDAR, np.zeros(len(points), np.uint8))
    frame = kept[0]
    good = np.isfinite(points).all(1)
    np.testing.assert_allclose(frame.points, points[good] + LIDAR[:3, 3], atol=1e-3)
    np.testing.assert_array_equal(frame.labels, labels[good])


def test_classes_are_drawn_alike_and_their_points_too() -> None:
    generator = np.random.default_rng(0)
    kept = Frames()
    for labels in ([1] * 90 + [0] * 50 + [4], [1] * 30 + [3] * 2, [0, 0]):
        kept.add(generator.normal(size=(len(labels), 3)).astype(np.float32), np.array(labels, np.uint8), LIDAR)
    drawn = [kept.draw(generator) for _ in range(3000)]
    classes = np.array([kept.labels[frame][point] for frame, point in drawn])
    np.testing.assert_allclose(np.bincount(classes, minlength=5) / 3000, [0, 1 / 3, 0, 1 / 3, 1 / 3], atol=0.04)
    of_ground = np.array([frame for (frame, _), label in zip(drawn, classes, strict=True) if label == 1])
    assert np.mean(of_ground == 0) == pytest.approx(0.75, abs=0.06)


def test_frames_without_classes_are_refused() -> None:
    kept = Frames()
    kept.add(np.ones((5, 3), np.float32), np.zeros(5, np.uint8), LIDAR)
    with pytest.raises(ValueError, match="none has a point of the classes ground"):
        kept.draw(np.random.default_rng(0))


def test_an_augmentation_keeps_what_is_up() -> None:
    for seed in range(20):
        matrix = augmentation(np.random.default_rng(seed))
        np.testing.assert_allclose(matrix[2, :2], 0.0)
        np.testing.assert_allclose(matrix[:2, 2], 0.0)
        assert 0.9 <= matrix[2, 2] <= 1.1
        scales = np.linalg.svd(matrix[:2, :2], compute_uv=False)
        assert 0.9 - 1e-9 <= scales.min() <= scales.max() <= 1.1 + 1e-9


def test_a_voxel_votes() -> None:
    rows = np.array([0, 0, 0, 1, 1, 2], np.int32)
    labels = np.array([3, 3, 1, 0, 0, 4], np.uint8)
    assert majority(labels, rows, 3).tolist() == [2, IGNORED, 3]


def test_a_sphere_is_a_sphere() -> None:
    settings = msgspec.structs.replace(SMALL, sphere=1.5)
    sphere = SphereRecipe(settings).sample(frames(0, 1, count=3000), np.random.default_rng(3))
    points = sphere.pyramid.points[0]
    assert np.linalg.norm(points - points.mean(0), axis=1).max() < 1.1 * 2 * 1.5
    assert len(points) == len(sphere.targets) == len(sphere.inputs)
    assert set(np.unique(sphere.targets)) <= {0, 1, 2, 3}


@pytest.mark.parametrize("settings", [SMALL, RANGE], ids=["kpconv", "rangenet"])
def test_the_same_seed_gives_the_same_weights_also_when_interrupted(settings: Settings, tmp_path: Path) -> None:
    plan = Plan(steps=24, batch=1, check=8)
    data, held_out = frames(0, 1), frames(2)
    whole, again, first = (Trainer(settings, plan, data, held_out=held_out) for _ in range(3))
    whole.run()
    again.run(checkpoint=tmp_path / "checkpoint", save_every=0.0)
    first.run(checkpoint=tmp_path / "first", stop_at=11)
    second = Trainer(settings, plan, data, held_out=held_out)
    second.resume(tmp_path / "first")
    assert second.state.step == 11
    second.run()
    for other in (again, second):
        for name, tensor in whole.weights().items():
            assert torch.equal(tensor, other.weights()[name]), name
        assert [entry["step"] for entry in other.state.history] == [entry["step"] for entry in whole.state.history]
    third = Trainer(settings, plan, data)
    third.run()
    fourth = Trainer(settings, msgspec.structs.replace(plan, seed=1), data)
    fourth.run()
    assert any(not torch.equal(third.weights()[name], tensor) for name, tensor in fourth.weights().items())


def test_a_checkpoint_of_another_plan_is_refused(tmp_path: Path) -> None:
    trainer = Trainer(SMALL, Plan(steps=20, batch=2), frames(0))
    trainer.write(tmp_path / "checkpoint")
    with pytest.raises(WeightsError, match="written with batch = 2; now 4 is given"):
        Trainer(SMALL, Plan(steps=20, batch=4), frames(0)).resume(tmp_path / "checkpoint")


def test_a_budget_becomes_a_number_of_steps_that_can_be_repeated() -> None:
    told: list[Progress] = []
    data = frames(0)
    trainer = Trainer(SMALL, Plan(steps=10**9, batch=1), data)
    state = trainer.run(budget=1.0, tell=told.append)
    assert WARM_UP <= state.plan.steps < 10**5
    assert state.step == state.plan.steps == told[-1].step
    if state.plan.steps < 400:
        repeated = Trainer(SMALL, Plan(steps=state.plan.steps, batch=1), data)
        repeated.run()
        for name, tensor in trainer.weights().items():
            assert torch.equal(tensor, repeated.weights()[name]), name


def test_training_stops_when_the_held_out_session_gets_no_better() -> None:
    trainer = Trainer(SMALL, Plan(steps=200, batch=1, rate=0.0, check=5, patience=2), frames(0), held_out=frames(1))
    trainer.network.eval()
    state = trainer.run()
    assert state.step < 200
    assert state.best_step <= state.step - 2 * 5
    assert "held_out" in state.history[-1]


def test_the_rate_falls() -> None:
    for schedule in ("cosine", "authors"):
        plan = Plan(steps=1000, rate=1.0, schedule=schedule)
        rates = [plan.rate_at(step) for step in range(1000)]
        assert rates[0] == pytest.approx(1 / WARM_UP)
        assert max(rates) <= 1.0
        assert all(before >= after for before, after in zip(rates[WARM_UP:], rates[WARM_UP + 1 :], strict=False))
        longer = Plan(steps=5000, rate=1.0, schedule=schedule)
        assert [longer.rate_at(step) for step in range(WARM_UP)] == rates[:WARM_UP]  # so that they can be timed


def test_weights_come_back_and_say_what_differs(tmp_path: Path) -> None:
    network = SphereRecipe(SMALL).network()
    path = tmp_path / "w.safetensors"
    header = Header(SMALL, sessions=["a.mcap"], training={"steps": 3}, metrics={"x": 0.5})
    save(path, network.state_dict(), header)
    back, read = load(path)
    assert read == header
    for name, tensor in network.state_dict().items():
        assert torch.equal(tensor, back.state_dict()[name])
    wrong: list[tuple[str, dict[str, torch.Tensor], Header]] = []
    state = network.state_dict()
    wide = msgspec.structs.replace(header, settings=msgspec.structs.replace(SMALL, width=16))
    wrong.append((r"first.convolution.weight is \(15, 2, 4\); the network wants \(15, 2, 8\)", state, wide))
    lacking = {name: tensor for name, tensor in state.items() if name != "last.bias"}
    wrong.append((r"wants last.bias \(4,\); the file has no such entry", lacking, header))
    wrong.append((r"the file has extra \(1,\)", state | {"extra": torch.zeros(1)}, header))
    other = msgspec.structs.replace(header, classes=("a", "b"))
    wrong.append(("predicts a, b; wanted are ground", state, other))
    for message, tensors, told in wrong:
        save(path, tensors, told)
        with pytest.raises(WeightsError, match=message):
            load(path)
    path.write_bytes(b"nothing of the kind")
    with pytest.raises(WeightsError, match="no safetensors file"):
        load(path)
    with pytest.raises(WeightsError, match="no such file"):
        load(tmp_path / "nowhere.safetensors")


def test_half_the_bits_are_a_smaller_file_of_the_same_network(tmp_path: Path) -> None:
    network = SphereRecipe(SMALL).network()
    whole, half = tmp_path / "whole.safetensors", tmp_path / "half.safetensors"
    save(whole, network.state_dict(), Header(SMALL))
    save(half, halved(network.state_dict()), Header(SMALL))
    assert half.stat().st_size < 0.8 * whole.stat().st_size
    back, _ = load(half)
    for name, tensor in network.state_dict().items():
        assert back.state_dict()[name].dtype == tensor.dtype
        torch.testing.assert_close(back.state_dict()[name], tensor, rtol=1e-3, atol=1e-6)


def test_optimizers_are_the_authors_or_adam(tmp_path: Path) -> None:
    plan = Plan(steps=22, batch=1, optimizer="sgd", rate=1e-2, schedule="authors")
    trainer = Trainer(SMALL, plan, frames(0))
    trainer.run(stop_at=21, checkpoint=tmp_path / "c")
    assert re.search("SGD", type(trainer.optimizer).__name__)
    again = Trainer(SMALL, plan, frames(0))
    again.resume(tmp_path / "c")
    trainer.run()
    again.run()
    for name, tensor in trainer.weights().items():
        assert torch.equal(tensor, again.weights()[name]), name
