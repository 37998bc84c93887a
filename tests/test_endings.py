"""How runs come to an end in their own processes: by a source, by nobody, by a deadline, with last words."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from graph import launcher
from graph.check import require
from graph.codec import decode
from graph.launcher import launch
from graph.recording import Recording
from graph.replay import replay
from tests.conftest import Write
from tests.sample_operators import Count

Run = Callable[[str], Recording]

COUNTER = "counter: {run: tests.sample_operators:Counter, inputs: {tick: timer/%s}}"


@pytest.fixture
def run(graph_file: Write, tmp_path: Path) -> Run:
    """Launch a graph from here and open its recording; nothing of the run is left."""

    def start(text: str) -> Recording:
        outcome = launch(require(graph_file(text)), record=tmp_path / "run.mcap", quiet=True)
        left = [item for item in psutil.Process().children(recursive=True) if "graph.worker" in item.cmdline()]
        assert not left
        assert not (tmp_path / "run.shards").exists()
        return Recording(outcome.recording)

    return start


def graph(mode: str, *operators: str, **clock: str) -> str:
    more = "".join(f", {key}: {value}" for key, value in clock.items())
    return f"clock: {{mode: {mode}{more}}}\noperators:\n" + "".join(f"  {item}\n" for item in operators)


SCANS = "scans: {run: tests.sample_operators:Scans, config: {count: 6, period: 50000000}}"
RELAY = "relay: {run: tests.sample_operators:Relay, inputs: {count: scans/count}}"


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_a_source_that_runs_dry_ends_the_run(run: Run, mode: str) -> None:
    recording = run(graph(mode, SCANS, RELAY, end="scans"))
    assert recording.verdict.verdict == "COMPLETE", recording.verdict.reasons
    assert recording.verdict.end == 250_000_000
    assert recording.counts["relay/count"] == 6
    assert replay(recording).equal


def test_a_run_that_nobody_will_end_is_ended_and_says_so(run: Run) -> None:
    recording = run(graph("lockstep", SCANS, RELAY, end="scans").replace("relay:", "x:").replace("end: scans", "end: x")
                    .replace("count: scans/count", "count: {from: scans/count, delay: 1ms}"))  # fmt: skip
    assert recording.verdict.verdict == "INCOMPLETE"
    assert recording.verdict.reasons == ["clock.end names x; nothing is left to do, and it has not said End"]
    assert recording.counts["x/count"] == 6
    assert recording.summaries() == {}
    assert replay(recording).equal


def test_what_a_process_started_ends_with_it(run: Run) -> None:
    parent = "parent: {run: tests.trial_operators:Parent, inputs: {count: counter/count}}"
    recording = run(graph("lockstep", COUNTER % "10hz", parent, duration="1s"))
    (number,) = {decode(entry.payload, Count).value for entry in recording.messages("parent/count")}
    assert not psutil.pid_exists(number) or psutil.Process(number).status() == psutil.STATUS_ZOMBIE


def test_an_operator_that_leaves_as_if_nothing_were_wrong_stops_the_graph(run: Run) -> None:
    leaving = "leaving: {run: tests.trial_operators:Leaving, inputs: {count: counter/count}}"
    recording = run(graph("lockstep", COUNTER % "10hz", leaving, duration="100s"))
    assert recording.verdict.verdict == "INCOMPLETE"
    assert "leaving left before the end" in recording.verdict.reasons
    assert recording.counts["leaving/count"] == 5
    assert replay(recording).equal


def test_what_is_left_in_realtime_after_the_drain_is_noted_as_unhandled(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(launcher, "DRAIN", 0.3)
    slow = "slow: {run: tests.sample_operators:Slow, inputs: {count: counter/count}, config: {seconds: 0.2}}"
    recording = run(graph("realtime", COUNTER % "50hz", slow, duration="1s"))
    assert recording.verdict.verdict == "INCOMPLETE"
    (reason,) = recording.verdict.reasons
    assert reason.endswith("messages were left unhandled by slow")
    (account,) = recording.verdict.accounts
    assert account.lost == 0
    assert recording.summaries()["counter"]["ticks"] == account.emitted  # on_end ran
    assert replay(recording).equal


def test_last_words_in_realtime_are_accounted_for(run: Run) -> None:
    words = "words: {run: tests.trial_operators:LastWords, inputs: {count: counter/count}}"
    relay = "relay: {run: tests.sample_operators:Relay, inputs: {count: words/count}}"
    recording = run(graph("realtime", COUNTER % "50hz", words, relay, duration="500ms"))
    assert recording.verdict.verdict == "COMPLETE", recording.verdict.reasons
    skips = [skip.why for _, _, step in recording.steps("relay") for skip in step.skipped]
    accounts = {(item.topic, item.operator): item for item in recording.verdict.accounts}
    account = accounts["words/count", "relay"]
    assert account.emitted == account.consumed + account.skipped
    assert account.lost == 0
    assert set(skips) <= {"end"}
    assert replay(recording).equal


def test_what_a_failing_call_had_said_in_realtime_is_in_the_recording(run: Run) -> None:
    stutter = "stutter: {run: tests.trial_operators:Stuttering, inputs: {count: counter/count}, restart: on-failure}"
    until = (
        "until: {run: tests.trial_operators:Mixer, config: {last: 15}, inputs: {a: {from: stutter/count, queue: 1000}}}"
    )
    recording = run(graph("realtime", COUNTER % "50hz", stutter, until, end="until"))
    assert {incarnation for _, incarnation, _ in recording.steps("stutter")} == {0, 1}
    said = {(entry.incarnation, entry.sequence): entry for entry in recording.messages("stutter/count")}
    first = [decode(entry.payload, Count).value for (incarnation, _), entry in said.items() if incarnation == 0]
    assert first == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5]
    heard = [(ref.incarnation, ref.sequence) for _, _, step in recording.steps("until") for ref in step.consumed]
    assert heard[:11] == [(0, number) for number in range(11)]
    assert heard[11:15] == [(1, number) for number in range(4)]
    assert set(heard) <= set(said)
    assert replay(recording).equal


def test_a_failing_call_of_an_operator_that_stays_away_is_in_the_recording_too(run: Run) -> None:
    stutter = "stutter: {run: tests.trial_operators:Stuttering, inputs: {count: counter/count}}"
    relay = "relay: {run: tests.sample_operators:Relay, inputs: {count: stutter/count}}"
    recording = run(graph("realtime", COUNTER % "50hz", stutter, relay, duration="30s"))
    assert "stutter failed (exit code 1)" in recording.verdict.reasons
    said = [decode(entry.payload, Count).value for entry in recording.messages("stutter/count")]
    assert said == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5]
    assert replay(recording).equal


def test_logs_are_kept_in_the_recording(run: Run) -> None:
    failing = "failing: {run: tests.sample_operators:Failing, inputs: {count: counter/count}}"
    recording = run(graph("lockstep", COUNTER % "10hz", failing, duration="100s"))
    logs = {item.name: item.data.decode() for item in recording.attachments()}
    assert set(logs) == {"log/failing.txt"}
    assert "RuntimeError: failed at 5, as configured" in logs["log/failing.txt"]


def test_the_error_of_a_source_is_shown_once(run: Run) -> None:
    source = "scans: {run: tests.trial_operators:Blocking, config: {fails: true}}"
    recording = run(graph("lockstep", source, RELAY, duration="1s"))
    assert "scans failed (exit code 1)" in recording.verdict.reasons
    (log,) = [item.data.decode() for item in recording.attachments()]
    assert log.count("Traceback") == 1
    assert log.endswith("RuntimeError: unplugged\n")
    assert replay(recording).equal


def interrupt_when(shard: Path, word: bytes, times: int) -> threading.Thread:
    """Press Ctrl-C, as it were, once a word stands so many times in a shard."""

    def watch() -> None:
        until = time.monotonic() + 60.0
        while time.monotonic() < until and not (shard.exists() and shard.read_bytes().count(word) >= times):
            time.sleep(0.02)
        if shard.exists():
            os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=watch)
    thread.start()
    return thread


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_a_source_that_waits_does_not_hold_up_ctrl_c(run: Run, tmp_path: Path, mode: str) -> None:
    source = "scans: {run: tests.trial_operators:Blocking}"
    shard = tmp_path / "run.shards" / "relay.0.mcap"
    thread = interrupt_when(shard, b"scans/count", 3)
    recording = run(graph(mode, source, RELAY, duration="600s"))
    thread.join()
    assert recording.verdict.verdict == "COMPLETE", recording.verdict.reasons
    assert recording.verdict.end == 2000
    assert recording.counts["relay/count"] == 3
    assert replay(recording).equal
