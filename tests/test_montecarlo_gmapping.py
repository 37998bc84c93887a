"""Grid mapping: patches that share memory, scan matching, and the whole."""

from __future__ import annotations

import math

import numpy as np
import pytest
from test_montecarlo_filter import room, scan_from, seen

from operators.montecarlo import Gmapping, Settings
from operators.montecarlo.matching import NO_HIT, climb, judge
from operators.montecarlo.motion import Spread, compose, shake
from operators.montecarlo.patches import FULL, SIDE, Patches, X, Y

SENSOR = np.zeros(2)


def entered(maps=2, seed=0, beams=40) -> Patches:
    """One scan of random beams in the first map."""
    patches = Patches(maps, 0.05)
    ends = np.random.default_rng(seed).uniform(-4, 4, (beams, 2))
    patches.enter(0, np.array([0.3, 0.2]), ends, np.ones(beams, np.bool_))
    return patches


def test_each_beam_ends_in_its_cell_and_passes_all_on_its_way():
    patches = Patches(1, 0.05)
    ends = np.random.default_rng(0).uniform(-4, 4, (40, 2))
    sensor = np.array([0.3, 0.2])
    patches.enter(0, sensor, ends, np.ones(40, np.bool_))
    hits, visits = patches.dense(0)
    columns, rows = np.floor((ends - patches.origin) / 0.05).astype(int).T
    expected = np.zeros_like(hits)
    np.add.at(expected, (rows, columns), 1.0)
    assert np.array_equal(hits, expected)
    first = np.floor((sensor - patches.origin) / 0.05).astype(int)
    assert visits[first[1], first[0]] == 40.0
    steps = np.abs(np.stack([columns, rows], axis=1) - first).max(axis=1)
    assert visits.sum() == (steps + 1).sum()


def test_maps_share_patches_until_one_writes():
    patches = entered()
    used = patches.in_use()
    patches.choose(np.array([0, 0]))
    assert patches.in_use() == used
    before = patches.dense(0)[1].copy()
    patches.enter(1, np.array([0.3, 0.2]), np.array([[0.5, 0.2]]), np.ones(1, np.bool_))
    assert patches.in_use() == used + 1
    assert np.array_equal(patches.dense(0)[1], before)
    assert patches.dense(1)[1].sum() > before.sum()
    patches.choose(np.array([0, 0]))
    assert patches.in_use() == used  # what nobody shows is free again


def test_a_scan_is_entered_into_each_map_at_its_own_pose():
    ends, hits, sensor = np.random.default_rng(3).uniform(-4, 4, (40, 2)), np.ones(40, np.bool_), np.array([0.1, 0.0])
    poses = np.array([[0.5, -0.3, 0.7], [90.0, 2.0, -2.0]])
    each, single = Patches(2, 0.05), Patches(1, 0.05)
    each.enter_each(poses, sensor, ends, hits)
    x, y, heading = poses[1]
    turn = np.array([[math.cos(heading), math.sin(heading)], [-math.sin(heading), math.cos(heading)]])
    single.enter(0, sensor @ turn + (x, y), ends @ turn + (x, y), hits)
    for known, found in zip(single.dense(0), each.dense(1), strict=True):
        assert known[known > 0].tolist() == found[found > 0].tolist()


def test_the_bits_of_a_row_say_which_cells_are_often_hit():
    patches = entered(1, beams=400)
    hits, visits = patches.dense(0)
    rows = patches.store.often[patches.directory[0]].transpose(0, 2, 1).reshape(hits.shape[0], -1)
    bits = (rows[:, :, None] >> np.arange(SIDE, dtype=np.uint32)) & 1
    assert np.array_equal(bits.reshape(hits.shape), hits > FULL * visits)


def test_a_map_grows_without_forgetting():
    patches = entered()
    ends, far = patches.dense(0)[0].sum(), np.array([[60.0, -70.0]])
    patches.enter(0, np.array([59.0, -70.0]), far, np.ones(1, np.bool_))
    assert patches.dense(0)[0].sum() == ends + 1
    assert (patches.origin <= far[0]).all()


def plain_judge(patches: Patches, pose, ends, sigma: float, logarithmic: bool) -> float:
    """Say the same in plain numpy, cell by cell."""
    hits, visits = patches.dense(0)
    store, directory = patches.store, patches.directory[0]

    def mean(x, y):
        place = directory[y // SIDE, x // SIDE], (y % SIDE) * SIDE + x % SIDE
        return np.array([x * 0.05, y * 0.05]) + store.ends[place][[X, Y]]

    total, (cosine, sine) = 0.0, (math.cos(pose[2]), math.sin(pose[2]))
    for beam in ends:
        end = pose[:2] + np.array([cosine * beam[0] - sine * beam[1], sine * beam[0] + cosine * beam[1]])
        before = end - (end - pose[:2]) / np.linalg.norm(beam) * 0.05 * math.sqrt(2)
        cell, shift = (
            np.floor(end / 0.05).astype(int),
            np.floor(before / 0.05).astype(int) - np.floor(end / 0.05).astype(int),
        )
        gaps = []
        for dx in (-1, 0, 1):
            for dy in (-1, 0, 1):
                x, y = cell[0] + dx, cell[1] + dy
                u, v = x + shift[0], y + shift[1]
                if hits[y, x] > FULL * visits[y, x] and not hits[v, u] > FULL * visits[v, u]:
                    gaps.append(float(((end - mean(x, y)) ** 2).sum()))
        if logarithmic:
            total += -min(gaps) / sigma if gaps else NO_HIT
        elif gaps:
            total += math.exp(-min(gaps) / sigma)
    return total


@pytest.mark.parametrize("logarithmic", [False, True])
def test_the_score_is_that_of_plain_numpy(logarithmic: bool):
    patches, pose = Patches(1, 0.05), np.array([3.0, 2.5, 0.4])
    ends = scan_from(pose)
    turn = np.array([[math.cos(0.4), math.sin(0.4)], [-math.sin(0.4), math.cos(0.4)]])
    patches.enter(0, pose[:2], ends @ turn + pose[:2], np.ones(len(ends), np.bool_))
    for offset in ((0, 0, 0), (0.03, -0.02, 0.01), (0.3, 0.3, 0.3)):
        local = pose - np.append(patches.origin, 0.0) + offset
        found = judge(patches.directory[0], patches.store, local, ends, SENSOR, 0.05, 1, 0.05, logarithmic)
        assert np.isclose(found, plain_judge(patches, local, ends, 0.05, logarithmic), rtol=1e-4)


def test_climbing_finds_back_and_never_scores_less():
    patches, pose = Patches(1, 0.05), np.array([3.0, 2.5, 0.0])
    ends = scan_from(pose)
    patches.enter(0, pose[:2], ends + pose[:2], np.ones(len(ends), np.bool_))
    true = pose - np.append(patches.origin, 0.0)
    scene = patches.directory[0], patches.store
    for offset in ((0.08, 0.0, 0.0), (0.0, -0.1, 0.05), (-0.05, 0.06, -0.08)):
        start = true + offset
        found, score = climb(*scene, start, ends, SENSOR, 0.05, 1, 0.05, 0.05, 0.05, 5)
        assert score >= judge(*scene, start, ends, SENSOR, 0.05, 1, 0.05, False)
        assert np.abs(found - true).max() < 0.02


def test_particles_spread_with_the_motion_alone():
    start = np.zeros((2000, 3))
    assert not shake(start, np.zeros(3), Spread(), np.random.default_rng(0)).any()
    spread = shake(start, np.array([0.5, 0.0, 0.0]), Spread(), np.random.default_rng(0)).std(axis=0)
    assert 0.04 < spread[0] < 0.06
    assert 0.09 < spread[2] < 0.11


def mapped(seed=0, steps=20, **settings) -> tuple[list[float], Gmapping, list]:
    """Map the room along an arc; odometry drives and turns too much."""
    first, _ = seen(0)
    gmapping = Gmapping(Settings(particles=6, lskip=0, seed=seed, **settings), start=tuple(first.tolist()))
    errors, told, odometry = [], [], np.zeros(3)
    for n in range(steps):
        pose, ends = seen(n)
        if n:
            odometry = compose(odometry[None], np.array([0.124, 0.0, 0.0064]))[0]
        slam = gmapping.step(odometry, ends, SENSOR)
        told.append(slam)
        errors.append(float(np.hypot(*(slam.pose - pose)[:2])))
    return errors, gmapping, told


def test_a_room_is_mapped_where_it_is():
    errors, gmapping, _ = mapped()
    assert max(errors) < 0.06
    grid = gmapping.grid()
    rows, columns = np.nonzero(grid.cells == 100)
    found = grid.origin + grid.resolution * (np.stack([columns, rows], axis=1) + 0.5)
    known = room()
    cells = np.round((found - known.origin) / 0.05 - 0.5).astype(int)
    near = [known.cells[max(0, y - 2) : y + 3, max(0, x - 2) : x + 3].max() == 100 for x, y in cells]
    assert np.mean(near) > 0.98
    assert (grid.cells == 0).sum() > 8000
    for side in (grid.cells[:SIDE], grid.cells[-SIDE:], grid.cells[:, :SIDE], grid.cells[:, -SIDE:]):
        assert (side >= 0).any()  # it ends where nothing more was seen
    assert Gmapping(Settings(particles=2)).grid().cells.size == 0


def test_the_same_seed_says_the_same_bits_also_after_resampling():
    one, two = (mapped(seed=1, steps=8, resampleThreshold=1.5) for _ in range(2))
    assert one[1].resamplings > 3
    assert [slam.pose.tobytes() for slam in one[2]] == [slam.pose.tobytes() for slam in two[2]]
    assert one[1].grid().cells.tobytes() == two[1].grid().cells.tobytes()
    assert one[1].patches.in_use() < 6 * two[1].patches.in_use()


def test_scans_without_returns_are_no_scans_and_settings_that_fit_nothing_are_refused():
    gmapping = Gmapping(Settings(particles=2))
    assert not gmapping.step(np.zeros(3), np.zeros((0, 2)), SENSOR).updated
    assert gmapping.scans == 0
    with pytest.raises(ValueError, match="delta"):
        Gmapping(Settings(delta=0.0))
    with pytest.raises(ValueError, match="kernelSize of 0 to 3"):
        Gmapping(Settings(kernelSize=4))
    with pytest.raises(ValueError, match="particle"):
        Gmapping(Settings(particles=0))
