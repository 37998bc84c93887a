"""Train a segmenter on labelled sessions.

retracer train recordings/a.labelled.mcap recordings/b.labelled.mcap -o weights.safetensors --budget 20min
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec
import torch
from torch import distributed

from graph.codec import CodecError, decode, type_name
from graph.durations import nanoseconds
from graph.errors import UserError
from graph.messages import PointCloud
from graph.recording import Recording
from graph.status import progress_bar
from operators.kpconv.figures import draw_curves
from operators.kpconv.frames import Frames
from operators.kpconv.plan import WARM_UP, Plan
from operators.kpconv.settings import PRESETS, Settings
from operators.kpconv.training import Group, Progress, Trainer
from operators.kpconv.weights import Header, WeightsError, halved, save

PREFERRED = "annotator/labelled"
NUMBERS = ("batch", "seed", "check", "patience", "rate", "momentum", "decay", "balance")  # of a Plan
MOST_FRAMES = 3000  # in memory: 250 kB each


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `retracer train`."""
    parser.add_argument("sessions", nargs="+", type=Path, metavar="LABELLED", help="recordings with labelled frames")
    parser.add_argument("-o", "--output", type=Path, required=True, help="the weights, .safetensors")
    parser.add_argument(
        "--held-out", action="append", default=[], type=Path, metavar="SESSION", help="stop early by it"
    )
    parser.add_argument("--preset", choices=sorted(PRESETS), default="realtime", help="architecture and voxel size")
    parser.add_argument("--network", choices=("kpconv", "rangenet"), help="instead of the preset's")
    parser.add_argument("--voxel", type=float, metavar="M", help="instead of the preset's")
    parser.add_argument("--width", type=int, metavar="CHANNELS", help="instead of the preset's")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--steps", type=int, help="default: 3000")
    length.add_argument("--budget", metavar="TIME", help="such as 20min: fixes the steps by timing the first ones")
    for name in NUMBERS[:4]:
        parser.add_argument(f"--{name}", type=int, default=Plan.__struct_defaults__[_place(name)])
    for name in NUMBERS[4:]:
        parser.add_argument(f"--{name}", type=float, default=Plan.__struct_defaults__[_place(name)])
    parser.add_argument("--optimizer", choices=("sgd", "adamw"), default="adamw")
    parser.add_argument("--schedule", choices=("cosine", "authors"), default="cosine")
    parser.add_argument("--device", default="auto", help="auto, cpu or cuda")
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1, help="of the CPU")
    parser.add_argument("--frames", type=int, default=MOST_FRAMES, help="kept in memory at most, evenly spread")
    parser.add_argument("--resume", action="store_true", help="go on from OUTPUT.checkpoint, if there is one")
    parser.add_argument("--half", action="store_true", help="store the matrices in 16 bits: a file half as large")
    parser.add_argument("--json", action="store_true", help="print the outcome as JSON")


def _place(name: str) -> int:
    return Plan.__struct_fields__.index(name) - 1  # the first field, steps, has no default


def labelled_topic(recording: Recording, *, field: str = "label") -> str:
    """Choose the topic of a recording whose point clouds carry a label (or truth). Raises UserError where none does."""
    clouds = [topic for topic, (name, _) in recording.types.items() if name == type_name(PointCloud)]
    clouds = [topic for topic in clouds if recording.counts.get(topic)]
    for topic in sorted(clouds, key=lambda topic: (topic != PREFERRED, topic)):
        first = next(iter(recording.messages(topic)), None)
        if first is not None and getattr(decode(first.payload, PointCloud), field) is not None:
            return topic
    seen = ", ".join(clouds) or "no point clouds at all"
    raise UserError(f"{recording.path} has no point clouds with {field}s; it has {seen}")


def load_session(path: Path, frames: Frames, *, every: int = 1) -> None:
    """Add every so many-th labelled frame of a recording. Raises UserError where there is none."""
    recording = Recording(path)
    topic = labelled_topic(recording)
    for number, entry in enumerate(recording.messages(topic)):
        if number % every:
            continue
        try:
            cloud = decode(entry.payload, PointCloud)
        except CodecError as error:
            raise UserError(f"{path}: {topic} is of another version of retracer: {error}") from error
        if cloud.label is not None:
            frames.add(cloud.points, cloud.label, cloud.base_from_lidar, cloud.ring)


def load_sessions(paths: list[Path], most: int, *, quiet: bool) -> Frames:
    """Load at most so many frames, evenly spread over the sessions."""
    recordings = [Recording(path) for path in paths]
    count = sum(recording.counts.get(labelled_topic(recording), 0) for recording in recordings)
    frames = Frames()
    with progress_bar("reading labelled frames", quiet=quiet) as progress:
        for number, path in enumerate(paths):
            load_session(path, frames, every=-(-count // most))
            progress((number + 1) / len(paths))
    return frames


def settings_of(args: argparse.Namespace) -> Settings:
    """Return the preset with what the command line changes."""
    preset = PRESETS["rangenet" if args.network == "rangenet" else args.preset]
    changes = {name: getattr(args, name) for name in ("network", "voxel", "width") if getattr(args, name) is not None}
    return msgspec.structs.replace(preset, **changes)


def group_of(device: torch.device) -> Group:
    """Join the other processes, if torchrun started several."""
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size > 1 and not distributed.is_initialized():
        distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    return Group(rank=int(os.environ.get("RANK", "0")), size=size)


def device_of(name: str) -> torch.device:
    """Return the device; auto: CUDA where there is one. Raises UserError for one that is not there."""
    if name == "auto":
        name = f"cuda:{os.environ.get('LOCAL_RANK', '0')}" if torch.cuda.is_available() else "cpu"
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise UserError(f"--device {name} was given; this machine has no CUDA device, only cpu")
    return torch.device(name)


def run(args: argparse.Namespace) -> int:
    """Train, and write weights, curves and history. Raises UserError for what cannot be trained on."""
    device = device_of(args.device)
    group = group_of(device)
    torch.set_num_threads(max(1, args.threads // group.size))
    quiet = group.rank > 0 or args.json
    try:
        budget = nanoseconds(args.budget) / 1e9 if args.budget else None
    except ValueError as error:
        raise UserError(f"--budget: {error}") from error
    plan = Plan(
        steps=10**9 if budget is not None else (args.steps or 3000),
        **{name: getattr(args, name) for name in NUMBERS},
        optimizer=args.optimizer,
        schedule=args.schedule,
        processes=group.size,
    )
    if plan.steps < WARM_UP or plan.batch < group.size:
        raise UserError(
            f"at least {WARM_UP} steps and {group.size} in a batch are wanted; given are {plan.steps}, {plan.batch}"
        )
    frames = load_sessions(args.sessions, args.frames, quiet=quiet)
    held_out = load_sessions(args.held_out, args.frames, quiet=quiet) if args.held_out else None
    settings = settings_of(args)
    checkpoint = args.output.with_name(args.output.name + ".checkpoint")
    try:
        trainer = Trainer(settings, plan, frames, held_out=held_out, device=device, group=group)
        if args.resume and checkpoint.exists():
            trainer.resume(checkpoint)
        state = trainer.run(budget=budget, tell=_teller(quiet), checkpoint=checkpoint)
    except (WeightsError, ValueError) as error:
        raise UserError(str(error)) from error
    if group.rank == 0:
        metrics = {"held_out_mean_recall": state.best, "best_step": state.best_step} if held_out is not None else {}
        metrics |= {"seconds": round(state.seconds, 1), "frames": len(frames)}
        training = msgspec.to_builtins(state.plan) | {"budget": args.budget, "threads": args.threads}
        header = Header(
            settings,
            sessions=[path.name for path in args.sessions],
            held_out=[path.name for path in args.held_out],
            training=training,
            metrics=metrics,
            versions={name: version(name) for name in ("torch", "numpy", "numba")},
        )
        weights = trainer.weights()
        save(args.output, halved(weights) if args.half else weights, header)
        args.output.with_suffix(".json").write_text(json.dumps(state.history, indent=1))
        draw_curves(state.history, args.output.with_suffix(".png"))
        checkpoint.unlink(missing_ok=True)
        _say(args, header, state.step)
    if distributed.is_initialized():
        distributed.destroy_process_group()
    return 0


def _say(args: argparse.Namespace, header: Header, step: int) -> None:
    outcome: dict[str, Any] = {"weights": str(args.output), "steps": step} | msgspec.to_builtins(header)
    if args.json:
        print(json.dumps(outcome, indent=2))
        return
    print(f"{args.output}: {step} steps in {header.metrics['seconds']:.0f} s", end="")
    best = header.metrics.get("held_out_mean_recall")
    print("" if best is None else f", mean recall on the held-out session {best:.3f}")
    print(f"curves: {args.output.with_suffix('.png')}; repeat with --steps {header.training['steps']}")


def _teller(quiet: bool) -> Any:
    live = sys.stderr.isatty()

    def tell(progress: Progress) -> None:
        if quiet or (not live and progress.step % 100):
            return
        recalls = " ".join(f"{name} {value:.3f}" for name, value in progress.recall.items())
        left = f"{progress.seconds_left / 60:.0f} min left" if progress.steps < 10**9 else "timing"
        line = (
            f"step {progress.step} loss {progress.loss:.3f} | {recalls} | {progress.frames_per_second:.1f} frames/s, "
        )
        line += f"waiting {100 * progress.waiting:.0f} % | {left}"
        print(f"\r\x1b[2K{line}" if live else line, end="" if live and progress.step < progress.steps else "\n",
              file=sys.stderr, flush=True)  # fmt: skip

    return tell
