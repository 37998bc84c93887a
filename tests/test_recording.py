"""Recordings: what they hold, and what is said of those that are broken: one clear sentence, and never a wrong byte."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from graph.codec import digest
from graph.diff import compare
from graph.errors import UserError
from graph.info import describe, text
from graph.ledger import Step
from graph.recording import RUN, VERDICT, Recording, RecordingError
from graph.replay import replay
from graph.replay_report import lines

Record = Callable[..., Recording]


def read_all(path: Path) -> list[tuple[object, ...]]:
    return [tuple(entry) for entry in Recording(path).entries()]


def test_a_recording_holds_every_message_every_step_and_the_graph(record: Record) -> None:
    recording = record()
    assert recording.verdict.verdict == "COMPLETE"
    assert list(recording.graph.operators) == ["counter", "relay", "adder", "feedback", "maker", "blobs", "screen"]
    assert recording.counts["counter/count"] == 30
    assert {"numpy", "msgspec", "python"} <= set(recording.run.versions)
    assert all(account.lost == 0 for account in recording.verdict.accounts)
    digests = {}
    for operator, _, step in recording.steps():
        assert isinstance(step, Step)
        for item in step.emitted:
            digests[operator, item.port, item.sequence] = item.digest
    for entry in recording.messages():
        assert digests.pop((entry.operator, entry.port, entry.sequence)) == digest(entry.payload)
    assert not digests
    order = [(entry.stamp, list(recording.graph.operators).index(entry.operator)) for entry in recording.entries()]
    assert order == sorted(order)


def test_info_says_what_is_there(record: Record) -> None:
    info = describe(record())
    topics = {topic.topic: topic for topic in info.topics}
    assert topics["counter/count"].messages == 30
    assert topics["counter/count"].rate_hz == pytest.approx(10.0)
    assert topics["feedback/count"].rate_hz == pytest.approx(20.0)
    assert topics["counter/count"].longest_gap_s == pytest.approx(0.1)
    assert info.summaries["counter"] == {"ticks": 30}
    page = text(info)
    assert "COMPLETE" in page
    assert "counter/count -> relay" in page


def _foreign(path: Path) -> None:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("pose", "jsonschema", b"{}")
        channel = writer.register_channel("/pose", "json", schema)
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()


def _damage(path: Path, kind: str, data: bytes) -> None:
    """Break a whole recording in one of many ways."""
    word, _, number = kind.partition(" ")
    rng = random.Random(number)
    if word == "cut":
        path.write_bytes(data[: int(len(data) * float(number))])
    elif word == "tail":
        path.write_bytes(data[: -int(number)])
    elif word == "empty":
        path.write_bytes(b"")
    elif word == "text":
        path.write_bytes(b"operators: {}\n" * 100)
    elif word == "zeros":
        middle = len(data) // 2
        path.write_bytes(data[:middle] + bytes(500) + data[middle + 500 :])
    elif word == "magic":
        path.write_bytes(b"\x00" + data[1:])
    elif word == "foreign":
        _foreign(path)
    elif word == "format":
        _rewrite_run(path, data, b'"format":1', b'"format":2')
    elif word == "metadata":
        _rewrite_run(path, data, b'"cpu":', b'"cqu":')
    elif word == "doubled":
        path.write_bytes(data + data)
    else:
        place = rng.randrange(8, len(data) - 8)
        path.write_bytes(data[:place] + bytes([data[place] ^ (1 << rng.randrange(8))]) + data[place + 1 :])


def _rewrite_run(path: Path, data: bytes, old: bytes, new: bytes) -> None:
    """Change a word in the run's metadata; `format` also gets the digest that fits."""
    assert old in data
    changed = data.replace(old, new)
    if b"format" in new:
        begin = data.index(b'{"graph"')
        end = data.index(b'"format":1}', begin) + len(b'"format":1}')
        changed = changed.replace(digest(data[begin:end]).hex().encode(), digest(changed[begin:end]).hex().encode())
    path.write_bytes(changed)


BROKEN = [
    *(f"cut {share}" for share in (0.01, 0.1, 0.25, 0.5, 0.75, 0.9, 0.99)),
    *(f"tail {count}" for count in (1, 8, 20, 37)),
    *("empty", "text", "zeros", "magic", "foreign", "format", "metadata", "doubled"),
    *(f"flip {number}" for number in range(24)),
]


@pytest.mark.parametrize("kind", BROKEN)
def test_a_broken_recording_gets_one_clear_sentence_or_reads_the_same(
    record: Record, tmp_path: Path, kind: str
) -> None:
    recording = record()
    whole = read_all(recording.path)
    path = tmp_path / "broken.mcap"
    _damage(path, kind, recording.path.read_bytes())
    found, sentence = _read(path)
    if sentence:
        assert str(path) in sentence
        assert "\n" not in sentence
        assert len(sentence) < 400
    else:
        assert kind.startswith(("flip", "doubled")), f"{kind} went unnoticed"
        assert found == whole


def _read(path: Path) -> tuple[list[tuple[object, ...]], str]:
    """Use a recording in every way; return its entries, or the sentence that refuses it."""
    try:
        replay(Recording(path))
        describe(Recording(path))
        return read_all(path), ""
    except UserError as error:
        return [], str(error)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("cut 0.5", "is cut short; `retracer recover"),
        ("empty", "is empty; a recording is an MCAP file"),
        ("text", "is not an MCAP file"),
        ("foreign", "is an MCAP file, but not a recording of retracer"),
        ("format", "it is of recording format 2; this version of retracer reads format 1"),
        ("metadata", f"its {RUN} record is damaged"),
        ("zeros", "is damaged"),
    ],
)
def test_the_sentence_says_what_is_wrong(record: Record, tmp_path: Path, kind: str, words: str) -> None:
    path = tmp_path / "broken.mcap"
    _damage(path, kind, record().path.read_bytes())
    with pytest.raises(UserError) as raised:
        read_all(path)
    assert words in str(raised.value)


def _remade(recording: Recording, path: Path, change: Callable[[str, bytes], bytes]) -> Path:
    """Write a whole recording again, sound to the last checksum, with other content."""
    with recording.path.open("rb") as stream, path.open("wb") as out:
        reader, writer = make_reader(stream), Writer(out)
        writer.start("retracer")
        summary = reader.get_summary()
        assert summary is not None
        for item in summary.schemas.values():
            writer.register_schema(item.name, item.encoding, change(f"schema {item.name}", item.data))
        for item in summary.channels.values():
            writer.register_channel(item.topic, item.message_encoding, item.schema_id, item.metadata)
        for _, channel, message in reader.iter_messages():
            data = change(channel.topic, message.data)
            writer.add_message(message.channel_id, message.log_time, data, message.publish_time, message.sequence)
        for name, struct in ((RUN, recording.run), (VERDICT, recording.verdict)):
            told = change(name, msgspec.json.encode(struct))
            writer.add_metadata(name, {"json": told.decode(), "digest": digest(told).hex()})
        writer.finish()
    return path


def test_a_recording_that_is_written_again_reads_the_same(record: Record, tmp_path: Path) -> None:
    recording = record()
    path = _remade(recording, tmp_path / "again.mcap", lambda name, data: data)
    assert compare(recording, Recording(path)).equal
    assert replay(Recording(path)).equal


@pytest.mark.parametrize(
    ("where", "old", "new", "words"),
    [
        (RUN, b'"cpu":', b'"processor":', "does not fit this version of retracer: Object missing required field `cpu`"),
        (RUN, b'"specs":[', b'"specs":[3,', "does not fit this version of retracer: Expected `object`, got `int`"),
        (
            VERDICT,
            b'"accounts":[',
            b'"accounts":["',
            "its retracer.verdict record does not fit this version of retracer: JSON is malformed",
        ),
        (VERDICT, b'"end":', b'"ende":', "its retracer.verdict record does not fit this version of retracer"),
        ("schema retracer.Step", b"integer", b"number", "its ledger is of another version of retracer"),
        ("schema tests.sample_operators.Count", b'"value"', b'"number"', "Count.value is not in the recording"),
        ("schema tests.sample_operators.Count", b"{", b"", "the schema of counter/count cannot be read"),
        ("relay/step", b"\x9a", b"\x99", "relay/step number 0 is no step of a ledger"),
        ("counter/count", b"\xa5value", b"\xa5valve", "it raised CodecError: not a Count"),
    ],
)
def test_a_sound_file_with_other_content_is_refused_by_name(
    record: Record, tmp_path: Path, where: str, old: bytes, new: bytes, words: str
) -> None:
    def change(name: str, data: bytes) -> bytes:
        return data.replace(old, new, 1) if name == where else data

    recording = record()
    _, sentence = _read(_remade(recording, tmp_path / "other.mcap", change))
    if not sentence:
        sentence = "\n".join(lines(replay(Recording(tmp_path / "other.mcap"))))
    assert words in sentence


def test_missing_files_and_folders_are_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no such recording"):
        Recording(tmp_path / "none.mcap")
    with pytest.raises(RecordingError, match=r"is a folder; a recording is an \.mcap file"):
        Recording(tmp_path)


def test_equal_runs_compare_equal_and_others_by_the_first_difference(record: Record) -> None:
    one, two = record(), record(name="two.mcap")
    assert compare(one, two).equal
    other = compare(one, record(name="three.mcap", sets=("relay.offset=2",)))
    assert not other.equal
    first = {item.operator: item.first for item in other.operators}
    assert first["counter"] == ""
    assert first["relay"] == "relay/count number 0 at 0.000 s: value was 1, is 2, largest difference 1"
    shorter = compare(one, record(name="four.mcap", sets=("counter.last=20",)))
    assert "maker/blob number 10 at 2.000 s meets maker/step" in str(shorter.operators)


def test_summaries_are_read_back(record: Record) -> None:
    assert record().summaries()["feedback"]["ticks"] == 59
    assert msgspec.json.decode(msgspec.json.encode(describe(record(name="b.mcap"))))["verdict"] == "COMPLETE"
