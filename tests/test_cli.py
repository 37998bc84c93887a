"""The command line: every verb says what it does, exits 0 on success only, and answers bad input with one sentence."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from graph.cli import DOMAIN, RUNTIME, main
from graph.recording import Recording
from tests.conftest import CHAIN, ROOT, Write

Record = Callable[..., Recording]
Run = Callable[..., tuple[int, str, str]]

DIGESTS = CHAIN.replace("config: {size: 3000}}", "config: {size: 3000}, record: digest}")


@pytest.fixture
def retracer(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Run:
    """Run a verb in this process; return exit code, what it printed, and what it complained of."""
    monkeypatch.chdir(ROOT)

    def run(*arguments: object) -> tuple[int, str, str]:
        capsys.readouterr()
        try:
            code = main([str(item) for item in arguments])
        except SystemExit as error:  # of argparse
            code = int(error.code or 0)
        out, err = capsys.readouterr()
        return code, out, err

    return run


@pytest.mark.parametrize("verb", list(RUNTIME))
def test_every_verb_has_help_with_an_example(retracer: Run, verb: str) -> None:
    code, out, _ = retracer(verb, "--help")
    assert code == 0
    assert f"example: retracer {verb}" in " ".join(out.split())


def test_the_list_of_verbs_needs_no_verb_loaded() -> None:
    program = (
        "import sys; from graph.cli import main\ntry: main(['--help'])\nexcept SystemExit: pass\nprint(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    *help_lines, modules = done.stdout.splitlines()
    for verb in (*RUNTIME, *DOMAIN):
        assert any(line.strip().startswith(verb) for line in help_lines), verb
    assert not {"zenoh", "numba", "torch", "rerun", "pybullet"} & set(modules.split())


def test_verbs_of_other_packages_are_loaded_when_they_are_called(
    retracer: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "trial_verb.py").write_text(
        '"""Do a trial.\n\nretracer trial --much 3\n"""\n'
        "def add_arguments(parser): parser.add_argument('--much', type=int)\n"
        "def run(args): print('much', args.much); return 7\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(DOMAIN, "trial", ("trial_verb", "do a trial"))
    monkeypatch.setitem(DOMAIN, "missing", ("nowhere.verb", "not there"))
    assert retracer("trial", "--much", 3) == (7, "much 3\n", "")
    assert "retracer trial --much 3" in retracer("trial", "--help")[1]
    code, _, err = retracer("missing")
    assert (code, err) == (2, "retracer: there is no module 'nowhere'\n")


@pytest.mark.parametrize("arguments", [[], ["fly"], ["replay"], ["diff", "one.mcap"], ["launch", "--nonsense"]])
def test_a_command_that_is_none_is_refused_with_the_usage(retracer: Run, arguments: list[str]) -> None:
    code, _, err = retracer(*arguments)
    assert code == 2
    assert "usage: retracer" in err


def test_launch_prints_an_outcome_for_scripts(retracer: Run, graph_file: Write, tmp_path: Path) -> None:
    code, out, _ = retracer("launch", graph_file(), "--in-process", "--json", "--record", tmp_path / "run.mcap")
    told = json.loads(out)
    assert code == 0
    assert (told["verdict"], told["recording"], told["sim_seconds"]) == ("COMPLETE", str(tmp_path / "run.mcap"), 2.9)
    assert told["operators"]["relay"] == {"steps": 32, "skipped": 0} | {
        name: told["operators"]["relay"][name] for name in ("p50_ms", "p95_ms")
    }
    assert told["summaries"]["counter"] == {"ticks": 30}
    assert told["total"] == told["summaries"]["feedback"]["total"]


def test_launch_prints_an_outcome_for_people(retracer: Run, graph_file: Write, tmp_path: Path) -> None:
    code, out, _ = retracer("launch", graph_file(), "--in-process", "--record", tmp_path / "run.mcap")
    assert code == 0
    assert "counter: ticks 30" in out
    assert "COMPLETE: 2.9 s in" in out
    assert out.endswith(f"recording: {tmp_path / 'run.mcap'}\n")
    code, _, err = retracer("launch", graph_file(), "--in-process", "--record", tmp_path / "run.mcap")
    assert (code, err) == (2, f"retracer: {tmp_path / 'run.mcap'} exists already; name another recording\n")


def test_a_recording_without_a_name_gets_one_by_graph_and_time(
    graph_file: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = graph_file()
    monkeypatch.chdir(tmp_path)
    for number in (1, 2):
        assert main(["launch", str(path), "--in-process"]) == 0
        assert len(list((tmp_path / "recordings").glob("chain-*.mcap"))) == number
    assert "recording: recordings/chain-" in capsys.readouterr().out


def test_replay_says_equal_or_where_not(retracer: Run, record: Record) -> None:
    path = record().path
    code, out, _ = retracer("replay", path)
    assert code == 0
    assert "relay: equal to the bit, 32 steps, 30 messages" in out
    code, out, _ = retracer("replay", path, "--set", "relay.offset=7")
    assert code == 1
    assert "relay: DIVERGES in 30 of 32 steps, first at step 1 at 0.000 s, relay/count: value was 1, is 7" in out
    code, out, _ = retracer("replay", path, "--operators", "relay,adder", "--json")
    told = json.loads(out)
    assert code == 0
    assert told["equal"] is True
    assert [item["operator"] for item in told["operators"]] == ["relay", "adder"]


@pytest.mark.parametrize(
    ("cheat", "sentence"),
    [
        ("WallClock", "relay: DIVERGES in 30 of 32 steps, first at step 1 at 0.000 s, relay/count: value was"),
        ("Unseeded", "relay: DIVERGES in 30 of 32 steps, first at step 1 at 0.000 s, relay/count: value was"),
    ],
)
def test_replay_names_an_operator_that_cheats(retracer: Run, record: Record, cheat: str, sentence: str) -> None:
    code, out, _ = retracer("replay", record(swaps=(f"relay=tests.sample_operators:{cheat}",)).path)
    assert code == 1
    assert sentence in out
    assert out.count("DIVERGES") == 1


def test_replay_of_a_swap_is_compared_field_by_field(retracer: Run, record: Record, tmp_path: Path) -> None:
    out_path = tmp_path / "swapped.mcap"
    code, out, _ = retracer(
        "replay", record().path, "--swap", "relay=tests.sample_operators:Slow", "--set", "relay.offset=3",
        "--record", out_path,
    )  # fmt: skip
    assert code == 0
    assert "relay: swapped" in out
    assert "count.value: equal 0, compared 30, median 2.0, largest 2.0" in out
    assert Recording(out_path).graph.operators["relay"].run == "tests.sample_operators:Slow"
    assert [item.value for item in _values(Recording(out_path))] == [n + 3 for n in range(30)]


def _values(recording: Recording) -> list[Any]:
    from graph.codec import decode
    from tests.sample_operators import Count

    return [decode(entry.payload, Count) for entry in recording.messages("relay/count")]


def test_replay_of_what_was_recorded_as_digests(retracer: Run, record: Record) -> None:
    path = record(DIGESTS).path
    assert retracer("replay", path)[0] == 0
    code, out, _ = retracer("replay", path, "--operators", "maker,blobs", "--set", "maker.seed=4")
    assert code == 1
    assert "maker/blob: other bytes (recorded as a digest only)" in out
    assert "blobs: not judged (16 steps lie downstream of a divergence)" in out


def test_diff_exits_zero_on_equal_only(retracer: Run, record: Record) -> None:
    one, two = record().path, record(name="two.mcap").path
    other = record(name="three.mcap", sets=("relay.offset=2",)).path
    code, out, _ = retracer("diff", one, two)
    assert (code, out.splitlines()[-1]) == (0, "equal")
    code, out, _ = retracer("diff", one, other, "--json")
    assert (code, json.loads(out)["equal"]) == (1, False)
    code, out, _ = retracer("diff", one, other)
    assert (code, out.splitlines()[-1]) == (1, "different")
    assert "relay/count number 0 at 0.000 s: value was 1, is 2" in out


def test_info_says_what_is_in_a_recording(retracer: Run, record: Record) -> None:
    path = record().path
    code, out, _ = retracer("info", path, "--json")
    told = json.loads(out)
    assert code == 0
    topics = {item["topic"]: item for item in told["topics"]}
    assert topics["counter/count"] | {"bytes": 0} == {
        "topic": "counter/count", "type": "tests.sample_operators.Count", "messages": 30, "recorded": 30,
        "rate_hz": 10.0, "bytes": 0, "longest_gap_s": 0.1,
    }  # fmt: skip
    assert (told["verdict"], told["sim_seconds"]) == ("COMPLETE", 2.9)
    assert {item["operator"] for item in told["operators"]} == set(Recording(path).graph.operators)
    code, out, _ = retracer("info", path)
    assert code == 0
    assert "COMPLETE, 2.9 s" in out
    assert "counter/count -> relay" in out
    code, _, err = retracer("info", path, "--log", "relay")
    assert (code, err) == (2, f"retracer: {path} holds no log of 'relay'; there is none at all\n")


def test_info_of_digests_says_so(retracer: Run, record: Record) -> None:
    assert "(15 as digests)" in retracer("info", record(DIGESTS).path)[1]


def test_recover_says_what_is_back_and_what_is_lost(retracer: Run, record: Record, tmp_path: Path) -> None:
    data = record().path.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[:-200])
    code, out, _ = retracer("recover", tmp_path / "cut.mcap", "-o", tmp_path / "back.mcap")
    assert code == 0
    assert "messages are back, INCOMPLETE" in out
    assert "  lost: " in out
    assert retracer("replay", tmp_path / "back.mcap")[0] == 0


@pytest.mark.parametrize("verb", [["replay"], ["info"], ["info", "--json"], ["diff"], ["launch"], ["recover"]])
@pytest.mark.parametrize("damage", ["cut", "flip", "empty", "text", "gone"])
def test_a_broken_recording_gets_one_sentence_from_every_verb(
    retracer: Run, record: Record, graph_file: Write, tmp_path: Path, verb: list[str], damage: str
) -> None:
    data = record().path.read_bytes()
    half = len(data) // 2
    path = tmp_path / "broken.mcap"
    if damage != "gone":
        flipped = data[:half] + bytes([data[half] ^ 0x10]) + data[half + 1 :]
        path.write_bytes({"cut": data[:half], "flip": flipped, "empty": b"", "text": b"clock: {}\n" * 9}[damage])
    more: list[object] = [path]
    if verb == ["diff"]:
        more = [path, path]
    elif verb == ["launch"]:
        record_path = tmp_path / "out.mcap"
        more = [graph_file(), "--from", path, "--sources", "counter", "--in-process", "--record", record_path]
    elif verb == ["recover"]:
        more = [path, "-o", tmp_path / "back.mcap"]
    code, _, err = retracer(*verb, *more)
    if verb == ["recover"] and damage in ("cut", "flip"):
        assert code in (0, 2)
    else:
        assert code == 2
    if code:
        assert err.startswith(f"retracer: {path}")
        assert err.count("\n") == 1
    assert not list(tmp_path.glob("out.*"))


def test_other_mistakes_are_one_sentence_too(retracer: Run, record: Record, tmp_path: Path, graph_file: Write) -> None:
    path = record().path
    for arguments, words in (
        (["replay", path, "--operators", "relai"], "there is no operator 'relai'"),
        (["replay", path, "--set", "relay.ofset=3"], "did you mean 'offset'"),
        (["replay", path, "--swap", "relay=tests.sample_operators:Scans"], "which takes no inputs"),
        (["recover", path, "-o", path], "exists already"),
        (["recover", path, "-o", tmp_path / "none" / "x.mcap"], "No such file or directory"),
        (["launch", graph_file(), "--in-process", "--set", "clock.mode=realtime"], "--in-process runs lockstep graphs"),
    ):
        code, _, err = retracer(*arguments)
        assert code == 2, arguments
        assert words in err
        assert err.startswith("retracer: ")


def test_ctrl_c_outside_a_run_is_no_traceback(retracer: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("graph.check.check", interrupt)
    assert retracer("check", "graph.yaml") == (130, "", "retracer: interrupted\n")


def test_an_operator_that_raises_in_one_process_keeps_its_traceback(graph_file: Write, tmp_path: Path) -> None:
    graph = graph_file(CHAIN.replace(":Relay", ":Failing"))
    with pytest.raises(RuntimeError, match="failed at 5, as configured"):
        main(["launch", str(graph), "--in-process", "--record", str(tmp_path / "run.mcap")])
    assert list(tmp_path.glob("run.*")) == []


def test_a_pipe_that_closes_early_is_no_traceback(record: Record) -> None:
    path = record().path
    command = f"{sys.executable} -m graph.cli info {path} | head -1"
    done = subprocess.run(["bash", "-c", command], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.stdout.count("\n") == 1
    assert done.stderr == ""


@pytest.mark.skipif(sys.platform != "linux", reason="the system ends no orphans here")
def test_a_bound_verb_ends_with_the_process_that_runs_it(tmp_path: Path) -> None:
    script = (
        "import os, subprocess, sys, time\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; from graph.lifeline import end_if_bound;'\n"
        "    'end_if_bound(); print(1, flush=True); time.sleep(60)'], env={**os.environ, 'RETRACER_BOUND': '1'},\n"
        "    stdout=subprocess.PIPE)\n"
        "child.stdout.readline(); print(child.pid, flush=True); time.sleep(60)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    for _ in range(100):
        try:
            os.kill(child, 0)
        except ProcessLookupError:
            return
        if Path(f"/proc/{child}/stat").read_text().split()[2] == "Z":
            return
        time.sleep(0.1)
    raise AssertionError(f"process {child} outlived the one that ran it")
