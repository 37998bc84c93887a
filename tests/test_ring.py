"""Payloads in shared memory: nothing is overwritten while it is read, and nothing waits for those who are gone."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graph import ring
from graph.ring import Found, RingReader, RingWriter, reserve, retire

SMALL = 1 << 10  # bytes of the largest payload
HEAD = 128


@pytest.fixture(autouse=True, scope="module")
def small() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ring, "SIZE", HEAD + SMALL)
        yield


def put(writer: RingWriter, content: bytes) -> tuple[int, int] | None:
    found = writer.allocate(len(content))
    if found is None:
        return None
    place, memory = found
    memory[:] = content
    return place, len(content)


@settings(deadline=None, max_examples=50)
@given(data=st.data())
def test_what_is_lent_stays_as_it_was_written(data: st.DataObject) -> None:
    descriptor = reserve(2)
    writer, readers = RingWriter(descriptor, 2), [RingReader(descriptor, 2, number) for number in (0, 1)]
    lent: list[list[tuple[memoryview, bytes]]] = [[], []]
    under_way: list[list[tuple[int, int, bytes]]] = [[], []]
    for turn in range(data.draw(st.integers(1, 30))):
        what = data.draw(st.sampled_from(["put", "read 0", "read 1", "let go 0", "let go 1", "start again"]))
        who = int(what[-1]) if what[-1].isdigit() else 0
        if what == "put":
            content = bytes([turn]) * data.draw(st.integers(1, SMALL))
            if (found := put(writer, content)) is not None:
                for queue in under_way:
                    queue.append((*found, content))
            else:
                assert any(lent) or any(under_way)
        elif what == "start again":
            writer = RingWriter(descriptor, 2)
        elif what.startswith("read") and under_way[who]:
            place, length, content = under_way[who].pop(0)
            lent[who].append((readers[who].read(place, length), content))  # type: ignore[arg-type]
        elif what.startswith("let go") and lent[who]:
            lent[who].pop(data.draw(st.integers(0, len(lent[who]) - 1)))
        assert all(memory == content for memory, content in lent[0] + lent[1])
    for queue, reader in zip(under_way, readers, strict=True):
        for place, length, content in queue:
            assert reader.read(place, length) == content
    lent.clear()
    assert writer.allocate(SMALL) is not None
    os.close(descriptor)


def test_it_is_full_until_the_slowest_reader_lets_go() -> None:
    descriptor = reserve(2)
    writer = RingWriter(descriptor, 2)
    quick, slow = (RingReader(descriptor, 2, number) for number in (0, 1))
    place, length = put(writer, b"a" * 600) or (0, 0)
    quick.read(place, length)
    assert writer.allocate(600) is None
    held = slow.read(place, length)
    assert writer.allocate(600) is None
    del held
    assert writer.allocate(600) is not None


def test_a_reader_that_copies_keeps_nothing() -> None:
    descriptor = reserve(1)
    writer, reader = RingWriter(descriptor, 1), RingReader(descriptor, 1, 0, copy=True)
    place, length = put(writer, b"a" * 1000) or (0, 0)
    held = reader.read(place, length)
    put(writer, b"b" * 1000)
    assert held == b"a" * 1000


def test_those_who_are_gone_are_not_waited_for() -> None:
    descriptor = reserve(2)
    writer, reader = RingWriter(descriptor, 2), RingReader(descriptor, 2, 0)
    RingReader(descriptor, 2, 1)
    place, length = put(writer, b"a" * 1000) or (0, 0)
    reader.read(place, length)
    assert writer.allocate(1000) is None
    retire(descriptor, 1)
    assert writer.allocate(1000) is not None


def test_one_who_comes_later_begins_where_the_writer_is() -> None:
    descriptor = reserve(1)
    writer, _ = RingWriter(descriptor, 1), RingReader(descriptor, 1, 0)
    put(writer, b"a" * 1000)
    assert writer.allocate(1000) is None
    reader = RingReader(descriptor, 1, 0)
    place, length = put(writer, b"b" * 1000) or (0, 0)
    assert reader.read(place, length) == b"b" * 1000


def test_beginning_again_at_the_start_wastes_no_room() -> None:
    descriptor = reserve(1)
    writer, reader = RingWriter(descriptor, 1), RingReader(descriptor, 1, 0)
    place, length = put(writer, b"a" * 300) or (0, 0)
    reader.read(place, length)
    assert put(writer, b"b" * 300) is not None
    writer = RingWriter(descriptor, 1)  # died, and was brought back
    assert put(writer, b"c" * 300) is not None
    assert put(writer, b"d" * 300) is None


def test_a_payload_larger_than_all_of_it_finds_no_room() -> None:
    descriptor = reserve(1)
    assert RingWriter(descriptor, 1).allocate(SMALL + 1) is None


def test_pieces_begin_on_a_cache_line_and_lie_apart() -> None:
    descriptor = reserve(1)
    writer = RingWriter(descriptor, 1)
    places = [(put(writer, b"x" * 100) or (-1, 0))[0] for _ in range(4)]
    assert all(place % 64 == 0 for place in places)
    assert all(later - earlier == 128 + HEAD for earlier, later in pairwise(places))
    assert writer.allocate(1) is None


PROGRAM = """
import sys
from graph import ring
ring.SIZE = int(sys.argv[2])
reader = ring.RingReader(int(sys.argv[1]), 1, 0)
print("ready", flush=True)
place, length = map(int, input().split())
print(bytes(reader.read(place, length)).decode())
"""


def test_another_process_reads_it() -> None:
    descriptor = reserve(1)
    command = [sys.executable, "-c", PROGRAM, str(descriptor), str(HEAD + SMALL)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, pass_fds=[descriptor]
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "ready\n"
        place, length = put(RingWriter(descriptor, 1), b"from here") or (0, 0)
        said, _ = other.communicate(f"{place} {length}\n", timeout=30)
    assert said == "from here\n"


def test_the_newest_is_seen_from_its_beginning_until_it_is_let_go() -> None:
    descriptor = reserve(1)
    writer, reader = RingWriter(descriptor, 1), RingReader(descriptor, 1, 0)
    place, memory = writer.allocate(100, (3, 7, 50)) or (0, memoryview(b""))
    assert reader.look() == Found(place, 100, (3, 7, 50), None)
    memory[:] = b"a" * 100
    writer.publish(place, b"mark")
    assert reader.look() == Found(place, 100, (3, 7, 50), b"mark")
    held = reader.read(place, 100)
    assert reader.look() == Found(place, 100, (3, 7, 50), b"mark")
    del held
    assert reader.look() is None


def test_what_was_there_before_a_reader_came_is_not_seen() -> None:
    descriptor = reserve(1)
    writer = RingWriter(descriptor, 1)
    put(writer, b"a" * 100)
    assert RingReader(descriptor, 1, 0).look() is None


def test_a_mark_that_finds_no_room_leaves_the_payload_to_zenoh() -> None:
    descriptor = reserve(1)
    writer, reader = RingWriter(descriptor, 1), RingReader(descriptor, 1, 0)
    place, _ = writer.allocate(100) or (0, None)
    writer.publish(place, b"m" * (ring.MARK + 1))
    found = reader.look()
    assert found is not None
    assert found.mark is None
    writer.publish(place, b"m" * ring.MARK)
    found = reader.look()
    assert found is not None
    assert found.mark == b"m" * ring.MARK


def test_bells_ring_when_a_payload_is_there_and_never_block() -> None:
    descriptor, (hearing, ringing) = reserve(1), os.pipe()
    for end in (hearing, ringing):
        os.set_blocking(end, False)
    writer = RingWriter(descriptor, 1, (ringing,))
    place, _ = writer.allocate(100) or (0, None)
    writer.publish(place, b"")
    assert os.read(hearing, 10) == b"!"
    for _ in range(1 << 17):  # more than a pipe holds
        writer.call()
    assert len(os.read(hearing, 1 << 20)) < 1 << 17
