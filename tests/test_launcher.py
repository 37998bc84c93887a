"""Launches: the same bits whatever happens to the machine; operators that die, and people who press Ctrl-C."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

from graph.diff import compare
from graph.recording import Recording
from graph.recover import recover
from graph.replay import replay
from tests.conftest import ROOT, Write

LIMIT = 60.0  # seconds that any of these runs may take on a busy machine; most take one or two

SLOW_CHAIN = """
clock: {mode: lockstep, end: counter}
operators:
  counter: {run: tests.sample_operators:Counter, inputs: {tick: timer/10hz}, config: {last: 100000}}
  relay: {run: tests.sample_operators:Slow, inputs: {count: counter/count}, config: {seconds: 0.005}}
  adder: {run: tests.sample_operators:Adder, inputs: {left: relay/count, right: counter/count}}
"""

REALTIME = """
clock: {mode: realtime, duration: 2s}
operators:
  counter: {run: tests.sample_operators:Counter, inputs: {tick: timer/100hz}}
  slow:
    run: tests.sample_operators:Slow
    inputs: {count: {from: counter/count, queue: latest, delay: 1ms}}
    config: {seconds: 0.03}
  few: {run: tests.sample_operators:Slow, inputs: {count: {from: counter/count, queue: 3}}, config: {seconds: 0.03}}
  adder: {run: tests.sample_operators:Adder, inputs: {left: slow/count, right: few/count}}
"""


BURSTS = """
clock: {mode: lockstep, duration: 2s}
operators:
  maker: {run: tests.sample_operators:BlobBurst, inputs: {tick: timer/10hz}, config: {size: 3000000}, record: digest}
  relay: {run: tests.sample_operators:BlobRelay, inputs: {blob: maker/blob}, record: digest}
  again: {run: tests.sample_operators:BlobRelay, inputs: {blob: relay/blob}, record: digest}
  aside: {run: tests.sample_operators:BlobRelay, inputs: {blob: maker/blob}, record: digest}
"""


def start(graph: Path, recording: Path, *more: str, **environment: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "graph.cli", "launch", str(graph), "--record", str(recording), *more]
    return subprocess.Popen(
        command, cwd=ROOT, env={**os.environ, **environment}, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def run(graph: Path, recording: Path, *more: str, **environment: str) -> tuple[int, str, str]:
    process = start(graph, recording, *more, **environment)
    out, err = process.communicate(timeout=LIMIT)
    return process.returncode, out, err


def workers(process: subprocess.Popen[str]) -> list[psutil.Process]:
    try:
        return psutil.Process(process.pid).children(recursive=True)
    except psutil.NoSuchProcess:
        return []


def under_way(process: subprocess.Popen[str], shards: Path, count: int, size: int = 20_000) -> list[psutil.Process]:
    """Wait until all operators are there and the counter has written so many bytes; return their processes."""
    until = time.monotonic() + LIMIT
    while time.monotonic() < until and process.poll() is None:
        children = workers(process)
        files = list(shards.glob("*.mcap")) if shards.exists() else []
        if len(children) >= count and len(files) >= count and _written(shards) > size:
            return children
        time.sleep(0.05)
    raise AssertionError(f"the run did not get under way: {process.communicate()}")


def _written(shards: Path) -> int:
    return sum(file.stat().st_size for file in shards.glob("counter*.mcap"))


def gone(processes: list[psutil.Process]) -> bool:
    until = time.monotonic() + 10.0
    while time.monotonic() < until:
        if not any(item.is_running() and item.status() != psutil.STATUS_ZOMBIE for item in processes):
            return True
        time.sleep(0.05)
    return False


@contextmanager
def burden(count: int) -> Iterator[None]:
    """Keep the cores busy."""
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for item in busy:
            item.kill()
            item.wait()


def test_launches_are_equal_under_load_with_other_hashes_paced_and_in_one_process(
    graph_file: Write, tmp_path: Path
) -> None:
    graph = graph_file()
    paths = {name: tmp_path / f"{name}.mcap" for name in ("plain", "busy", "paced", "local")}
    code, out, _ = run(graph, paths["plain"], "--json", "--quiet")
    assert code == 0
    told = json.loads(out)
    assert told["verdict"] == "COMPLETE"
    assert told["recording"] == str(paths["plain"])
    assert told["sim_seconds"] == pytest.approx(2.9)
    assert told["operators"]["counter"]["steps"] == 32
    assert {"p50_ms", "p95_ms", "skipped"} <= set(told["operators"]["counter"])
    assert told["ticks"] in (30, 59)
    with burden(2):
        assert run(graph, paths["busy"], PYTHONHASHSEED="4711")[0] == 0
    assert run(graph, paths["paced"], "--set", "clock.pace=realtime")[0] == 0
    assert run(graph, paths["local"], "--in-process")[0] == 0
    plain = Recording(paths["plain"])
    assert plain.verdict.verdict == "COMPLETE"
    assert replay(plain).equal
    for path in paths.values():
        assert compare(plain, Recording(path)).equal, path


def test_small_and_large_messages_in_any_order_are_the_same_in_rings_and_without(
    graph_file: Write, tmp_path: Path
) -> None:
    graph = graph_file(BURSTS)
    code, out, err = run(graph, tmp_path / "rings.mcap")
    assert code == 0, out + err
    assert run(graph, tmp_path / "without.mcap", "--in-process")[0] == 0
    rings = Recording(tmp_path / "rings.mcap")
    assert compare(rings, Recording(tmp_path / "without.mcap")).equal
    assert replay(rings).equal
    assert sum(len(step.emitted) for _, _, step in rings.steps("again")) == 6 * 21


def test_an_operator_that_is_stopped_for_two_seconds_changes_nothing(graph_file: Write, tmp_path: Path) -> None:
    text = SLOW_CHAIN.replace("100000", "150")
    graph = graph_file(text)
    process = start(graph, tmp_path / "stopped.mcap")
    children = under_way(process, tmp_path / "stopped.shards", 3, 5000)
    children[1].send_signal(signal.SIGSTOP)
    time.sleep(2.0)
    children[1].send_signal(signal.SIGCONT)
    _, err = process.communicate(timeout=LIMIT)
    assert process.returncode == 0, err
    assert run(graph, tmp_path / "plain.mcap", "--in-process")[0] == 0
    assert compare(Recording(tmp_path / "stopped.mcap"), Recording(tmp_path / "plain.mcap")).equal


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ("raise", ["RuntimeError: failed at 10, as configured", "relay failed (exit code 1)"]),
        ("exit", ["relay failed (exit code 3)"]),
        ("kill", ["relay was ended by signal 9 (SIGKILL)"]),
    ],
)
def test_an_operator_that_dies_stops_the_graph(graph_file: Write, tmp_path: Path, how: str, words: list[str]) -> None:
    text = SLOW_CHAIN.replace("Slow", "Failing").replace("{seconds: 0.005}", f"{{at: 10, how: {how}}}")
    code, out, err = run(graph_file(text), tmp_path / "run.mcap")
    assert code == 1
    for sentence in words:
        assert sentence in err
    assert "INCOMPLETE" in out
    recording = Recording(tmp_path / "run.mcap")
    assert recording.verdict.verdict == "INCOMPLETE"
    assert words[-1] in recording.verdict.reasons
    assert recording.counts["counter/count"] > 10
    assert recording.counts["relay/count"] == 10
    assert not (tmp_path / "run.shards").exists()
    assert replay(recording).equal


def test_a_killed_operator_is_noticed_within_two_seconds(graph_file: Write, tmp_path: Path) -> None:
    process = start(graph_file(SLOW_CHAIN), tmp_path / "run.mcap")
    children = under_way(process, tmp_path / "run.shards", 3)
    children[0].kill()
    begin = time.monotonic()
    assert process.stderr is not None
    for line in process.stderr:
        if line.startswith("stopping:"):
            break
    assert time.monotonic() - begin < 2.0
    process.communicate(timeout=LIMIT)
    assert process.returncode == 1
    assert gone(children)


def test_ctrl_c_drains_merges_and_says_where_the_recording_is(graph_file: Write, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    process = start(graph_file(SLOW_CHAIN), path)
    children = under_way(process, tmp_path / "run.shards", 3)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=LIMIT)
    assert f"recording: {path}" in out, err
    recording = Recording(path)
    assert recording.verdict.verdict == "COMPLETE", recording.verdict.reasons
    assert process.returncode == 0
    assert replay(recording).equal
    assert gone(children)


def test_a_second_ctrl_c_kills(graph_file: Write, tmp_path: Path) -> None:
    text = SLOW_CHAIN.replace("0.005", "0.9")
    process = start(graph_file(text), tmp_path / "run.mcap")
    children = under_way(process, tmp_path / "run.shards", 3, 5000)
    process.send_signal(signal.SIGINT)
    time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=LIMIT)
    assert process.returncode == 1
    assert "INCOMPLETE" in out
    assert Recording(tmp_path / "run.mcap").verdict.verdict == "INCOMPLETE"
    assert gone(children)


def test_a_killed_launcher_leaves_no_process_and_its_shards_recover(graph_file: Write, tmp_path: Path) -> None:
    process = start(graph_file(SLOW_CHAIN), tmp_path / "run.mcap")
    children = under_way(process, tmp_path / "run.shards", 3)
    process.kill()
    process.communicate()
    assert gone(children)
    assert not (tmp_path / "run.mcap").exists()
    result = recover(tmp_path / "run.shards", tmp_path / "back.mcap")
    assert result.messages > 20
    recording = Recording(tmp_path / "back.mcap")
    assert recording.verdict.verdict == "INCOMPLETE"
    assert replay(recording).equal


def test_realtime_under_load_accounts_for_every_message_and_replays(graph_file: Write, tmp_path: Path) -> None:
    with burden(2):
        code, out, err = run(graph_file(REALTIME), tmp_path / "run.mcap")
    assert code == 0, out + err
    recording = Recording(tmp_path / "run.mcap")
    assert recording.verdict.verdict == "COMPLETE"
    accounts = {(item.topic, item.operator): item for item in recording.verdict.accounts}
    assert accounts["counter/count", "slow"].skipped > 20
    assert accounts["counter/count", "few"].skipped > 20
    assert all(item.lost == 0 for item in accounts.values())
    steps = list(recording.steps("slow"))
    assert any(step.late for _, _, step in steps)
    assert {skip.why for _, _, step in steps for skip in step.skipped} == {"queue"}
    assert replay(recording).equal


def test_realtime_brings_a_failed_operator_back(graph_file: Write, tmp_path: Path) -> None:
    text = """
clock: {mode: realtime}
operators:
  counter: {run: tests.sample_operators:Counter, inputs: {tick: timer/50hz}}
  relay: {run: tests.sample_operators:Relay, inputs: {count: counter/count}, restart: on-failure}
  adder: {run: tests.sample_operators:Adder, inputs: {left: relay/count, right: relay/count}}
"""
    process = start(graph_file(text), tmp_path / "run.mcap")
    children = under_way(process, tmp_path / "run.shards", 3, 10_000)
    relay = next(item for item in children if (tmp_path / "run.shards" / "relay.0.mcap") in _files(item))
    relay.kill()
    returned, until = tmp_path / "run.shards" / "relay.1.mcap", time.monotonic() + LIMIT
    while not (returned.exists() and returned.stat().st_size > 5000) and time.monotonic() < until:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=LIMIT)
    assert "relay was ended by signal 9 (SIGKILL); starting it again" in err
    recording = Recording(tmp_path / "run.mcap")
    incarnations = {incarnation for _, incarnation, _ in recording.steps("relay")}
    assert incarnations == {0, 1}, out + err
    assert replay(recording).equal


def _files(process: psutil.Process) -> list[Path]:
    return [Path(item.path) for item in process.open_files()]


def test_a_sink_that_dies_holds_back_nobody(graph_file: Write, tmp_path: Path) -> None:
    text = SLOW_CHAIN.replace("100000", "100") + (
        "  screen: {run: tests.trial_operators:Stumbling, inputs: {count: counter/count}}\n"
    )
    code, out, err = run(graph_file(text), tmp_path / "run.mcap")
    assert code == 0, out + err
    assert "screen failed (exit code 1); the run goes on without it" in err
    assert Recording(tmp_path / "run.mcap").verdict.verdict == "COMPLETE"


def test_live_operators_run_with_recorded_ones(graph_file: Write, tmp_path: Path) -> None:
    graph, path = graph_file(), tmp_path / "run.mcap"
    assert run(graph, path, "--in-process")[0] == 0
    code, _, err = run(graph, tmp_path / "mixed.mcap", "--from", str(path), "--sources", "counter,maker")
    assert code == 0, err
    one, two = Recording(path), Recording(tmp_path / "mixed.mcap")
    assert list(one.messages()) == list(two.messages())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["launch", "nowhere.yaml"], "nowhere.yaml"),
        (["launch", "{graph}", "--from", "x.mcap"], "--from RECORDING and --sources OPERATORS go together"),
        (["launch", "{graph}", "--from", "x.mcap", "--sources", "counter"], "x.mcap: no such recording"),
        (["launch", "{graph}", "--record", "{tmp}/run.txt"], "a recording is an .mcap file"),
        (["launch", "{graph}", "--record", "{graph}/run.mcap"], "no recording can be written to"),
        (["launch", "{graph}", "--host", "300.1.1.1"], "nobody can listen on 300.1.1.1: "),
        (["launch", "{graph}", "--set", "counter.lst=3"], "did you mean 'last'"),
        (["launch", "{graph}", "--swap", "relay=tests.sample_operators:Relai"], "did you mean 'Relay'"),
        (["replay", "{graph}"], "is not an MCAP file"),
        (["diff", "{graph}", "{graph}"], "is not an MCAP file"),
        (["info", "{tmp}"], "is a folder; a recording is an .mcap file"),
        (["recover", "{tmp}/none", "-o", "{tmp}/x.mcap"], "no such file or folder"),
        (["check", "{tmp}"], "this is a directory"),
    ],
)
def test_bad_input_gets_one_sentence_and_no_traceback(
    graph_file: Write, tmp_path: Path, arguments: list[str], words: str
) -> None:
    graph = graph_file()
    filled = [item.format(graph=graph, tmp=tmp_path) for item in arguments]
    done = subprocess.run(
        [sys.executable, "-m", "graph.cli", *filled],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=LIMIT,
        check=False,
    )
    assert done.returncode == 2, done
    assert words in done.stderr
    assert "Traceback" not in done.stderr
