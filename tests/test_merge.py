"""From shards to a verdict: what adds up, what does not, and what a crash makes of it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader

from graph.ledger import Step
from graph.merge import ShardReader, merge
from graph.recording import Recording
from graph.recover import recover
from graph.replay import replay
from graph.shard import STEP

Record = Callable[..., Recording]
Keep = Callable[..., tuple[Recording, Path]]


@pytest.fixture
def kept(record: Record, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Keep:
    """Run a graph and keep its shards beside the recording, as a killed launcher would leave them."""

    def run(*arguments: str) -> tuple[Recording, Path]:
        folder = tmp_path / "kept.shards"
        with monkeypatch.context() as patch:
            patch.setattr("graph.inprocess.shutil.rmtree", lambda path, **_: shutil.copytree(path, folder))
            recording = record(*arguments)
        (folder / "run.json").write_bytes(msgspec.json.encode(recording.run))
        return recording, folder

    return run


def cut_after(shard: Path, calls: int, *, messages: int = 0) -> None:
    """Truncate a shard behind some calls, as a kill would, or behind the first messages of the call that follows."""
    ports = [entry.port for entry in ShardReader(shard).entries()]
    last = [number for number, port in enumerate(ports) if port == STEP][calls - 1] + messages
    data, ends, place = shard.read_bytes(), [], 8
    while place < len(data):
        opcode, length = data[place], int.from_bytes(data[place + 1 : place + 9], "little")
        place += 9 + length
        if opcode == Opcode.MESSAGE:
            ends.append(place)
    shard.write_bytes(data[: ends[last]])


def steps_of(recording: Recording, operator: str) -> list[Step]:
    return [step for _, _, step in recording.steps(operator)]


@pytest.mark.parametrize("calls", [1, 7, 20])
def test_what_was_consumed_and_never_written_takes_its_calls_with_it(kept: Keep, tmp_path: Path, calls: int) -> None:
    whole, folder = kept()
    cut_after(folder / "relay.0.mcap", calls)
    result = recover(folder, tmp_path / "back.mcap")
    back = Recording(tmp_path / "back.mcap")
    assert len(steps_of(back, "relay")) == calls
    consumed = {ref.sequence for step in steps_of(back, "adder") for ref in step.consumed if ref.topic == "relay/count"}
    assert consumed == set(range(calls - 1))
    assert steps_of(back, "counter") == steps_of(whole, "counter")
    assert replay(back).equal
    assert "calls of adder from number" in " ".join(result.lost)
    assert set(back.entries()) <= set(whole.entries())


def test_messages_that_were_written_without_their_step_are_kept(kept: Keep, tmp_path: Path) -> None:
    _, folder = kept()
    cut_after(folder / "relay.0.mcap", 8, messages=1)
    recover(folder, tmp_path / "back.mcap")
    back = Recording(tmp_path / "back.mcap")
    assert len(steps_of(back, "relay")) == 8
    assert back.counts["relay/count"] == 8  # the first call, on_start, says nothing
    assert replay(back).equal
    account = next(item for item in back.verdict.accounts if (item.topic, item.operator) == ("relay/count", "adder"))
    assert (account.emitted, account.consumed, account.lost) == (8, 8, 0)


def test_an_undamaged_run_is_left_as_it_is(kept: Keep, tmp_path: Path) -> None:
    whole, folder = kept()
    recover(folder, tmp_path / "back.mcap")
    assert list(Recording(tmp_path / "back.mcap").entries()) == list(whole.entries())


def test_every_edge_adds_up(record: Record) -> None:
    recording = record()
    accounts = recording.verdict.accounts
    assert {(item.topic, item.operator) for item in accounts} == {
        (edge.topic, spec.name) for spec in recording.run.specs for edge in spec.inputs if edge.period is None
    }
    for item in accounts:
        if item.operator != "screen":
            assert item.emitted == item.consumed + item.skipped + item.later + item.lost
            assert item.lost == 0
    adder = next(item for item in accounts if (item.topic, item.operator) == ("relay/count", "adder"))
    assert adder.later == 1  # the last one would have come 30 ms after the end


def test_a_lost_message_and_a_changed_one_make_a_run_incomplete(kept: Keep, tmp_path: Path) -> None:
    recording, folder = kept()
    shard = folder / "counter.0.mcap"
    data = shard.read_bytes()
    with shard.open("rb") as stream:
        payload = next(entry.payload for entry in ShardReader(shard).entries() if entry.port == "count")
        assert stream.read(8) == data[:8]
    changed = payload.replace(b"\xa5value\x00", b"\xa5value\x01")
    assert data.count(payload) == 1
    shard.write_bytes(data.replace(payload, changed))
    verdict = merge(sorted(folder.glob("*.mcap")), tmp_path / "out.mcap", recording.run)
    assert verdict.verdict == "INCOMPLETE"
    assert verdict.reasons == ["counter/count number 0 is not what its step says"]


def test_a_recording_is_an_mcap_file_for_anybody(record: Record) -> None:
    recording = record()
    with recording.path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        topics = {channel.topic for channel in summary.channels.values()}
        stamps = [message.log_time for _, _, message in reader.iter_messages()]
    assert {"counter/count", "counter/step", "maker/blob", "counter/summary"} <= topics
    assert stamps == sorted(stamps)
    assert len(stamps) == sum(recording.counts.values())
    assert all(schema.encoding == "jsonschema" for schema in summary.schemas.values())
