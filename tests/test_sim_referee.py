"""The rules of a tour, on hand-made poses."""

from __future__ import annotations

import numpy as np
import pytest

from graph.geometry import planar
from sim.referee import FINISHED, FREE_SPEED, LOST_WAY, STUCK, TIME_UP, Referee

TARGETS = np.array([[2.0, 0.0], [4.0, 0.0]])


def drive(referee: Referee, xs: list[float], *, offset: float | None = None, dt: float = 0.1) -> str:
    """Drive along x; the robot believes to be `offset` metres ahead. Returns the last verdict."""
    verdict = ""
    for n, x in enumerate(xs):
        true = planar(x, 0.0, 0.0)
        if offset is not None:
            referee.judge(planar(x + offset, 0.0, 0.0), true)
        verdict = referee.watch(n * dt, true)
        if verdict:
            break
    return verdict


def test_a_tour_ends_with_its_last_target() -> None:
    referee = Referee(TARGETS, 4.0)
    assert drive(referee, list(np.arange(0.0, 5.0, 0.1))) == FINISHED
    summary = referee.summary()
    assert (summary["targets"], summary["reached"]) == (2, 2)
    assert summary["ending"] == {"tour_finished": 1, "stuck": 0, "lost": 0, "time_is_up": 0}
    assert summary["driven_m"] == pytest.approx(3.2, abs=0.11)  # 0.9 m before the last target
    assert summary["mean_speed"] == pytest.approx(1.0, abs=0.01)


def test_the_robot_must_believe_it_and_it_must_be_about_true() -> None:
    shy = Referee(TARGETS[:1], 4.0)
    assert drive(shy, [0.0, 1.2, 1.3], offset=-1.0) == ""  # it is there, and believes it is not
    bold = Referee(TARGETS[:1], 4.0)
    assert drive(bold, [0.0, 0.3, 0.4], offset=1.5) == ""  # it believes to be there, and is 1.6 m away
    assert bold.watch(0.3, planar(0.6, 0.0, 0.0)) == FINISHED  # 1.4 m
    alone = Referee(TARGETS[:1], 4.0)
    assert drive(alone, [0.0, 0.6]) == ""  # without an estimate, the truth within 0.9 m
    assert alone.watch(0.2, planar(1.2, 0.0, 0.0)) == FINISHED


def test_one_look_reaches_one_target() -> None:
    near = Referee(np.array([[0.1, 0.0], [0.2, 0.0]]), 1.0)
    assert near.watch(0.0, planar(0.0, 0.0, 0.0)) == ""
    assert near.watch(0.1, planar(0.0, 0.0, 0.0)) == FINISHED


def test_a_robot_is_stuck_after_fifteen_slow_seconds() -> None:
    referee = Referee(TARGETS, 400.0)
    verdicts = [referee.watch(n * 0.1, planar(0.0, 0.0, 0.0)) for n in range(200)]
    assert verdicts[148] == ""
    assert STUCK in verdicts
    assert 14.9 <= verdicts.index(STUCK) * 0.1 <= 15.1
    creeping = Referee(TARGETS, 400.0)
    assert drive(creeping, [0.004 * n for n in range(200)]) == ""  # 0.04 m/s
    turning_back = Referee(TARGETS, 400.0)  # moves, though it gets nowhere
    assert drive(turning_back, [0.1 * (n % 2) for n in range(200)]) == ""


def test_a_robot_is_stuck_wherever_it_stops() -> None:
    referee = Referee(TARGETS + 50.0, 400.0)
    xs = [0.05 * n for n in range(100)] + [5.0] * 200
    assert drive(referee, xs) == STUCK
    assert referee.time == pytest.approx(9.9 + 15.0, abs=1.1)


def test_a_robot_is_lost_beyond_two_metres() -> None:
    assert drive(Referee(TARGETS, 4.0), [0.0, 0.1], offset=1.99) == ""
    referee = Referee(TARGETS, 4.0)
    assert drive(referee, [0.0, 0.1], offset=2.01) == LOST_WAY
    assert referee.summary()["ending"]["lost"] == 1


def test_time_is_up_after_five_free_drives() -> None:
    referee = Referee(TARGETS + 90.0, 1.0)
    xs = [0.01 * n for n in range(200)]
    assert drive(referee, xs) == TIME_UP
    assert referee.time == pytest.approx(5.0 * 1.0 / FREE_SPEED + 0.1, abs=0.11)


def test_errors_are_judged_in_the_plane() -> None:
    referee = Referee(TARGETS, 4.0)
    assert referee.summary()["localization_error_m"] == {"median": 0.0, "p95": 0.0, "max": 0.0}
    for error in (0.1, 0.2, 0.9):
        referee.judge(planar(1.0 + error, 2.0, 3.0, z=5.0), planar(1.0, 2.0, 0.0))
    errors = referee.summary()["localization_error_m"]
    assert errors["median"] == pytest.approx(0.2)
    assert errors["max"] == pytest.approx(0.9)
    assert 0.2 < errors["p95"] < 0.9


def test_a_skipped_target_is_not_reached_and_the_tour_goes_on() -> None:
    referee = Referee(TARGETS, 4.0)
    referee.skip()
    assert drive(referee, list(np.arange(0.0, 5.0, 0.1))) == FINISHED
    summary = referee.summary()
    assert (summary["targets"], summary["reached"], summary["skipped"]) == (2, 1, 1)
    assert summary["driven_m"] == pytest.approx(3.2, abs=0.11)  # the second target was still driven to
    referee.skip()
    assert referee.summary()["skipped"] == 1  # no target is left
