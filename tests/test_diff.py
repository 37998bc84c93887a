"""Differences: between two messages field by field, and between two recordings operator by operator."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from graph.arrays import Array
from graph.compare import differences
from graph.diff import compare
from graph.messages import Drive, Pose
from graph.recording import Recording
from tests.conftest import CHAIN

FIXED = settings(
    derandomize=True, deadline=None, database=None, max_examples=80, suppress_health_check=list(HealthCheck)
)
Record = Callable[..., Recording]

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=2), inner, max_size=3),
    max_leaves=8,
)
ARRAYS = hnp.arrays(
    st.sampled_from([np.dtype(name) for name in ("float32", "float64", "uint8", "bool", "int64", "complex64")]),
    hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3),
)


@settings(FIXED)
@given(VALUES | ARRAYS)
def test_nothing_differs_from_its_copy(value: Any) -> None:
    assert list(differences(value, copy.deepcopy(value))) == []


@settings(FIXED)
@given(ARRAYS, st.integers(0, 10**6))
def test_one_changed_entry_is_found_where_it_is(values: Array, place: int) -> None:
    if values.size == 0:
        return
    changed = values.copy()
    index = np.unravel_index(place % values.size, values.shape)
    changed[index] = (not changed[index]) if values.dtype == np.bool_ else changed[index] * 0 + 3
    found = list(differences({"a": values}, {"a": changed}))
    if changed.tobytes() == values.tobytes():
        assert found == []
    else:
        (difference,) = found
        assert difference.field == "a"
        assert difference.index == tuple(int(item) for item in index)
        assert difference.share == pytest.approx(1.0 / values.size)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (1, 2, " was 1, is 2, largest difference 1"),
        (1, 1.0, " was 1, is 1.0, largest difference 0"),
        (True, 1, " was True, is 1"),
        (0.0, -0.0, " was 0.0, is -0.0, largest difference 0"),
        ("a", "b", " was 'a', is 'b'"),
        (None, 3, " was None, is 3"),
        ([1, 2], [1], " was [1, 2], is [1]"),
        ([1, 2], [1, 5], "[1] was 2, is 5, largest difference 3"),
        ({"a": 1}, {"b": 1}, " was {'a': 1}, is {'b': 1}"),
        (np.zeros(3), np.zeros(4), " was float64 (3,), is float64 (4,)"),
        (np.zeros(3), np.zeros(3, np.float32), " was float64 (3,), is float32 (3,)"),
        (np.array([1.0, 2.0, 9.0]), np.array([1.0, 2.5, 3.0]), "[1] was 2.0, is 2.5, largest difference 6"),
        (np.array([np.inf]), np.array([-np.inf]), "[0] was inf, is -inf"),
        (np.array([np.inf, 1.0]), np.array([np.inf, 2.0]), "[1] was 1.0, is 2.0, largest difference 1"),
        (np.array([np.nan, 1.0]), np.array([np.nan, 3.0]), "[1] was 1.0, is 3.0, largest difference 2"),
        (np.array([0, 255], np.uint8), np.array([255, 0], np.uint8), "[0] was 0, is 255, largest difference 255"),
        (np.array([True]), np.array([False]), "[0] was True, is False, largest difference 1"),
        (np.array([1 + 1j]), np.array([1 - 1j]), "[0] was (1+1j), is (1-1j), largest difference 2"),
    ],
    ids=range(18),
)
def test_a_difference_is_said_in_words(old: Any, new: Any, said: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (difference,) = differences({"f": old}, {"f": new})
        assert str(difference) == f"f{said}"


def test_fields_of_messages_are_named_and_all_that_differ() -> None:
    old = Drive(measured_at=1, linear=0.5, angular=0.25)
    new = Drive(measured_at=1, linear=0.75, angular=0.5)
    assert [item.field for item in differences(old, new)] == ["linear", "angular"]
    pose = np.eye(4)
    pose[2, 3] = 1e-9
    (difference,) = differences(
        Pose(measured_at=0, world_from_base=np.eye(4)), Pose(measured_at=0, world_from_base=pose)
    )
    assert str(difference) == "world_from_base[2, 3] was 0.0, is 1e-09, largest difference 1e-09"
    assert next(differences(old, "else")).recorded.startswith("Drive(")


def test_only_the_operator_that_differs_differs(record: Record) -> None:
    one, two = record(), record(name="two.mcap", sets=("maker.seed=1",))
    result = compare(one, two)
    assert not result.equal
    different = {item.operator: item.different for item in result.operators if item.different}
    assert set(different) == {"maker", "blobs"}
    first = next(item.first for item in result.operators if item.operator == "maker")
    assert first.startswith("maker/blob number 0 at 0.000 s: data[0] was ")
    assert compare(two, one).equal is False


def test_a_sink_more_or_less_does_not_matter_but_an_operator_does(record: Record) -> None:
    lines = CHAIN.splitlines()
    without_screen = "\n".join(line for line in lines if "screen" not in line)
    without_blobs = "\n".join(line for line in lines if "blobs" not in line)
    one = record()
    assert compare(one, record(without_screen, name="two.mcap")).equal
    result = compare(one, record(without_blobs, name="three.mcap"))
    assert [item.operator for item in result.operators if item.different] == ["blobs"]
    assert "is only in the first" in result.operators[5].first


def test_digests_differ_where_bytes_were_not_recorded(record: Record) -> None:
    text = CHAIN.replace("config: {size: 3000}}", "config: {size: 3000}, record: digest}")
    one, two = record(text), record(text, name="two.mcap", sets=("maker.seed=1",))
    assert compare(one, record(text, name="three.mcap")).equal
    result = compare(one, two)
    first = next(item.first for item in result.operators if item.operator == "maker")
    assert first.startswith("maker/step number 1 at 0.000 s: emitted was ")


def test_classes_that_are_gone_are_no_obstacle(record: Record) -> None:
    one, two = record(), record(name="two.mcap", sets=("relay.offset=5",))
    one.graph.operators["relay"].run = "nowhere:Relay"
    first = next(item.first for item in compare(one, two).operators if item.operator == "relay")
    assert first == "relay/count number 0 at 0.000 s: other bytes"
