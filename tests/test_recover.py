"""What a crash leaves: every whole chunk, every complete call comes back, and what is lost is said."""

from __future__ import annotations

import random
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.records import Chunk
from mcap.stream_reader import StreamReader

from graph import merge
from graph.errors import UserError
from graph.recording import Recording, RecordingError
from graph.recover import recover
from graph.replay import replay
from graph.shard import STEP, SUMMARY

Record = Callable[..., Recording]


@pytest.fixture
def chunked(record: Record, monkeypatch: pytest.MonkeyPatch) -> Recording:
    """A recording of many small chunks."""
    monkeypatch.setattr(merge, "CHUNK_BYTES", 2000)
    return record()


def messages_in_whole_chunks(data: bytes) -> int:
    """Count the messages of the chunks that lie wholly within some bytes, by the library's own reader."""
    import io

    count = 0
    try:
        for item in StreamReader(io.BytesIO(data), emit_chunks=True).records:
            if isinstance(item, Chunk) and len(item.data) > 0:
                from mcap.stream_reader import breakup_chunk

                for part in breakup_chunk(item, validate_crc=True):
                    count += type(part).__name__ == "Message"
    except Exception:
        return count
    return count


@pytest.mark.parametrize("seed", range(8))
def test_a_truncated_recording_gives_back_every_whole_chunk(chunked: Recording, tmp_path: Path, seed: int) -> None:
    data = chunked.path.read_bytes()
    cut = random.Random(seed).randrange(len(data) // 3, len(data) - 100)
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(data[:cut])
    result = recover(broken, tmp_path / "out.mcap")
    recording = Recording(tmp_path / "out.mcap")
    entries = list(recording.entries())
    assert len(entries) == messages_in_whole_chunks(data[:cut])
    assert entries == list(chunked.entries())[: len(entries)]
    assert recording.verdict.verdict == "INCOMPLETE"
    assert result.lost


def test_a_damaged_chunk_costs_only_itself(chunked: Recording, tmp_path: Path) -> None:
    data = bytearray(chunked.path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(bytes(data))
    result = recover(broken, tmp_path / "out.mcap")
    back = [entry for entry in Recording(tmp_path / "out.mcap").entries()]
    whole = list(chunked.entries())
    assert 0.5 * len(whole) < len(back) < len(whole)
    assert set(back) < set(whole)
    assert any("chunk at byte" in lost for lost in result.lost)


def test_shards_of_a_killed_launcher_merge_and_replay(
    record: Record, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = tmp_path / "kept.shards"
    monkeypatch.setattr("graph.inprocess.shutil.rmtree", lambda path, **_: shutil.copytree(path, kept))
    recording = record()
    import msgspec

    (kept / "run.json").write_bytes(msgspec.json.encode(recording.run))
    shard = kept / "relay.0.mcap"
    shard.write_bytes(shard.read_bytes()[:-5000])  # the footer and some calls are gone
    result = recover(kept, tmp_path / "out.mcap")
    back = Recording(tmp_path / "out.mcap")
    assert back.verdict.verdict == "INCOMPLETE"
    assert "relay did not come to its end" in " ".join(back.verdict.reasons)
    assert result.messages == back.verdict.messages
    steps = {name: 0 for name in back.graph.operators}
    for operator, _, _ in back.steps():
        steps[operator] += 1
    assert 0 < steps["relay"] < 32
    assert steps["counter"] == 32
    report = replay(back, operators=["counter", "relay", "feedback"])
    assert report.equal


def test_nothing_to_recover_is_said_by_name(record: Record, tmp_path: Path) -> None:
    whole = record().path
    (tmp_path / "empty.mcap").write_bytes(b"")
    (tmp_path / "text.mcap").write_bytes(b"hello world, hello world")
    (tmp_path / "head.mcap").write_bytes(whole.read_bytes()[:60])
    (tmp_path / "folder").mkdir()
    for name, words in (
        ("empty.mcap", "is empty"),
        ("text.mcap", "is not an MCAP file"),
        ("head.mcap", "its retracer.run record is gone"),
        ("folder", "holds no shards"),
        ("none", "no such file or folder"),
    ):
        with pytest.raises(UserError, match=words):
            recover(tmp_path / name, tmp_path / "out.mcap")
        assert not (tmp_path / "out.mcap").exists()
    with pytest.raises(RecordingError, match="exists already"):
        recover(whole, whole)


def test_a_whole_recording_recovers_whole(record: Record, tmp_path: Path) -> None:
    recording = record()
    recovery = recover(recording.path, tmp_path / "out.mcap")
    again = Recording(tmp_path / "out.mcap")
    assert list(again.entries()) == list(recording.entries())
    assert (recovery.lost, again.verdict) == ([], recording.verdict)
    assert again.verdict.verdict == "COMPLETE"
    assert {STEP, SUMMARY} == {"step", "summary"}
