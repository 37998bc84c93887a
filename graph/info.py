"""What is in a recording: topics, types, counts, rates, sizes, latencies, gaps, verdict."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from graph.recording import EdgeAccount, Recording
from graph.shard import STEP, SUMMARY


class TopicInfo(msgspec.Struct):
    """One topic: how many messages, how often, how large, and the longest silence."""

    topic: str
    type: str
    messages: int
    recorded: int  # with their bytes; the others as digests only
    rate_hz: float
    bytes: int
    longest_gap_s: float


class OperatorInfo(msgspec.Struct):
    """One operator: its calls, and how long they took."""

    operator: str
    run: str
    steps: int
    p50_ms: float
    p95_ms: float
    skipped: int
    late: int
    incarnations: int


class Info(msgspec.Struct):
    """Everything that `retracer info` prints."""

    path: str
    bytes: int
    verdict: str
    reasons: list[str]
    sim_seconds: float
    wall_seconds: float
    started: str
    cpu: str
    versions: dict[str, str]
    files: dict[str, str]
    operators: list[OperatorInfo]
    topics: list[TopicInfo]
    edges: list[EdgeAccount]
    summaries: dict[str, dict[str, Any]]


def describe(recording: Recording) -> Info:
    """Read a whole recording once and sum it up."""
    durations: dict[str, list[int]] = {spec.name: [] for spec in recording.run.specs}
    skipped = dict.fromkeys(durations, 0)
    late = dict.fromkeys(durations, 0)
    incarnations = dict.fromkeys(durations, 1)
    stamps: dict[str, list[int]] = {}
    sizes: dict[str, int] = {}
    recorded: dict[str, int] = {}
    summaries = {}
    for entry in recording.entries():
        if entry.port == SUMMARY:
            summaries[entry.operator] = msgspec.msgpack.decode(entry.payload)
        elif entry.port == STEP:
            step = entry.step()
            durations[entry.operator].append(step.wall_duration)
            skipped[entry.operator] += len(step.skipped)
            late[entry.operator] += step.late
            incarnations[entry.operator] = max(incarnations[entry.operator], entry.incarnation + 1)
            for item in step.emitted:
                stamps.setdefault(f"{entry.operator}/{item.port}", []).append(step.stamp)
        else:
            sizes[entry.topic] = sizes.get(entry.topic, 0) + len(entry.payload)
            recorded[entry.topic] = recorded.get(entry.topic, 0) + 1
    topics = []
    for topic, (kind, _) in recording.types.items():
        if topic.endswith((f"/{STEP}", f"/{SUMMARY}")):
            continue
        times = np.array(stamps.get(topic, []), np.int64) / 1e9
        span = float(times[-1] - times[0]) if len(times) > 1 else 0.0
        rate = (len(times) - 1) / span if span > 0 else 0.0
        gap = float(np.diff(times).max()) if len(times) > 1 else 0.0
        topics.append(
            TopicInfo(
                topic, kind, len(times), recorded.get(topic, 0), round(rate, 3), sizes.get(topic, 0), round(gap, 6)
            )
        )
    operators = [
        OperatorInfo(
            spec.name,
            spec.run,
            len(durations[spec.name]),
            _percentile(durations[spec.name], 50),
            _percentile(durations[spec.name], 95),
            skipped[spec.name],
            late[spec.name],
            incarnations[spec.name],
        )
        for spec in recording.run.specs
    ]
    verdict, run = recording.verdict, recording.run
    return Info(
        str(recording.path),
        recording.path.stat().st_size,
        verdict.verdict,
        verdict.reasons,
        verdict.end / 1e9,
        round(verdict.wall_seconds, 3),
        run.started,
        run.cpu,
        run.versions,
        run.files,
        operators,
        topics,
        verdict.accounts,
        summaries,
    )


def _percentile(durations: list[int], share: float) -> float:
    return round(float(np.percentile(durations, share)) / 1e6, 3) if durations else 0.0


def text(info: Info) -> str:
    """Lay an Info out for a terminal."""
    megabytes = info.bytes / 1e6
    lines = [
        f"{info.path}: {info.verdict}, {info.sim_seconds:.1f} s in {info.wall_seconds:.1f} s, {megabytes:.1f} MB",
        *(f"  because {reason}" for reason in info.reasons),
        f"  started {info.started} on {info.cpu}",
        "",
        f"{'topic':28} {'type':34} {'messages':>8} {'Hz':>7} {'MB':>8} {'gap s':>7}",
    ]
    for topic in info.topics:
        note = "" if topic.recorded == topic.messages else f"  ({topic.messages - topic.recorded} as digests)"
        lines.append(
            f"{topic.topic:28} {topic.type:34} {topic.messages:8d} {topic.rate_hz:7.2f} {topic.bytes / 1e6:8.1f} "
            f"{topic.longest_gap_s:7.2f}{note}"
        )
    lines += ["", f"{'operator':16} {'run':44} {'steps':>7} {'p50 ms':>8} {'p95 ms':>8} {'skipped':>8} {'late':>5}"]
    lines += [
        f"{item.operator:16} {item.run:44} {item.steps:7d} {item.p50_ms:8.2f} {item.p95_ms:8.2f} "
        f"{item.skipped:8d} {item.late:5d}"
        for item in info.operators
    ]
    lines += ["", f"{'edge':44} {'emitted':>8} {'consumed':>8} {'skipped':>8} {'later':>6} {'lost':>5}"]
    lines += [
        f"{item.topic + ' -> ' + item.operator:44} {item.emitted:8d} {item.consumed:8d} {item.skipped:8d} "
        f"{item.later:6d} {item.lost:5d}"
        for item in info.edges
    ]
    return "\n".join(lines)
