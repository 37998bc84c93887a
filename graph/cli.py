"""The command `retracer`: the runtime's verbs, and by name those of the robot, loaded when they are called."""

from __future__ import annotations

import argparse
import functools
import json
import shlex
import sys
from pathlib import Path
from typing import Any

import msgspec

from graph.errors import UserError
from graph.lifeline import end_if_bound

# verb: (module with add_arguments and run, one line of help); a string, so that the runtime imports nobody
DOMAIN = {
    "view": ("operators.views.view_command", "show a recording in Rerun"),
    "import": ("operators.scans.import_command", "make a session of anyone's scans, captures and bags"),
    "export": ("operators.scans.export_command", "turn a recording into a ROS 2 bag, which Foxglove opens too"),
    "map": ("operators.annotation.map_command", "make the initial map of a building from a mapping session"),
    "annotate": ("operators.annotation.annotate_command", "label recorded sessions without a human"),
    "train": ("operators.kpconv.train_command", "train a segmenter on labelled sessions"),
    "evaluate": ("operators.kpconv.evaluate_command", "hold a segmenter against the truth of recorded sessions"),
    "rounds": ("operators.rounds.rounds_command", "drive, label, learn, and drive better, round after round"),
    "evaluate-trajectory": ("operators.scans.trajectory_command", "hold a trajectory against a reference"),
    "occupancy": ("operators.montecarlo.occupancy_command", "save the occupancy map of a recording as a ROS map"),
    "localizers": ("operators.montecarlo.localizers_command", "drive with each localizer, with labels and without"),
    "building": ("sim.building_command", "draw and check a building"),
}

DASHBOARD = "operators.dashboard"  # has attach(graph) -> graph, for `launch --view`


def _print_json(record: Any) -> None:
    print(msgspec.json.format(msgspec.json.encode(record, enc_hook=str), indent=2).decode())  # NaN becomes null


def _changes(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--set", action="append", default=[], metavar="OPERATOR.KEY=VALUE", help="override a setting")
    parser.add_argument("--swap", action="append", default=[], metavar="OPERATOR=MODULE:CLASS", help="swap an operator")


def _check_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("graph", nargs="?", type=Path, default=Path("graph.yaml"))
    _changes(parser)
    parser.add_argument("--draw", action="store_true", help="print the graph as Mermaid")
    parser.add_argument("--schema", action="store_true", help="print the JSON Schema of graph files, for editors")
    parser.add_argument("--json", action="store_true", help="print the mistakes as JSON")


def _check(args: argparse.Namespace) -> int:
    from graph.check import check
    from graph.drawing import mermaid
    from graph.graphfile import json_schema

    if args.schema:
        print(json.dumps(json_schema(), indent=2))
        return 0
    report = check(args.graph, args.set, args.swap)
    if args.json:
        _print_json({"mistakes": report.mistakes, "warnings": report.warnings})
    else:
        for warning in report.warnings:
            print(f"warning: {warning}", file=sys.stderr)
        for mistake in report.mistakes:
            print(mistake, file=sys.stderr)
    if report.mistakes or report.graph is None:
        return 2
    if args.draw:
        print(mermaid(report.graph))
    elif not args.json:
        print(f"{args.graph}: {len(report.graph.operators)} operators, no mistakes")
    return 0


def _launch_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("graph", nargs="?", type=Path, default=Path("graph.yaml"))
    _changes(parser)
    parser.add_argument(
        "--record", type=Path, metavar="PATH", help="the recording; default: recordings/<graph>-<time>.mcap"
    )
    parser.add_argument(
        "--from", dest="source", type=Path, metavar="RECORDING", help="take some operators' messages from it"
    )
    parser.add_argument("--sources", metavar="A,B", help="the operators that --from stands in for")
    parser.add_argument("--in-process", action="store_true", help="one process, no Zenoh: for debuggers")
    parser.add_argument("--view", action="store_true", help="show the run live in Rerun")
    parser.add_argument("--host", default="127.0.0.1", help="address that the router listens on")
    parser.add_argument("--log-level", default="warning", choices=("debug", "info", "warning", "error"))
    parser.add_argument("--quiet", action="store_true", help="no live status")
    parser.add_argument("--json", action="store_true", help="print the outcome as JSON")


def _launch(args: argparse.Namespace) -> int:
    from graph.check import check, require
    from graph.info import describe
    from graph.inprocess import launch_in_process
    from graph.launcher import launch
    from graph.outcome import report, text
    from graph.playback import stand_in
    from graph.recording import Recording

    graph = require(args.graph, args.set, args.swap)
    for warning in check(graph).warnings:
        print(f"warning: {warning}", file=sys.stderr)
    if (args.source is None) != (args.sources is None):
        raise UserError("--from RECORDING and --sources OPERATORS go together")
    if args.source is not None:
        graph = require(stand_in(graph, args.source, [name.strip() for name in args.sources.split(",")]))
    if args.view:
        graph = require(_load(DASHBOARD).attach(graph))
    command = shlex.join(["retracer", *sys.argv[1:]])
    if args.in_process:
        verdict, path = launch_in_process(graph, record=args.record, command=command)
        states: dict[str, Any] = {
            item.operator: {"steps": item.steps, "p50_ms": item.p50_ms, "p95_ms": item.p95_ms, "skipped": item.skipped}
            for item in describe(Recording(path)).operators
        }
        wall = verdict.wall_seconds
    else:
        outcome = launch(
            graph, record=args.record, host=args.host, log_level=args.log_level, command=command, quiet=args.quiet
        )
        verdict, path, states, wall = outcome.verdict, outcome.recording, outcome.states, outcome.wall_seconds
    told = report(path, verdict, states, wall)
    if args.json:
        _print_json(told)
    else:
        print(text(told, verdict))
    return 0 if verdict.verdict == "COMPLETE" else 1


def _replay_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=Path)
    parser.add_argument(
        "--operators", default="", metavar="A,B", help="which; default: all but sources, or those changed"
    )
    _changes(parser)
    parser.add_argument("--record", type=Path, metavar="OUT", help="write a recording with what they say now")
    parser.add_argument("--json", action="store_true")


def _replay(args: argparse.Namespace) -> int:
    from graph.graphfile import to_dict
    from graph.override import override
    from graph.recording import Recording
    from graph.replay import replay
    from graph.replay_report import lines
    from graph.rerecord import Rerecorder, run_for
    from graph.status import progress_bar
    from graph.threads import allow_threads
    from graph.wiring import wire

    recording = Recording(args.recording)
    names = [name.strip() for name in args.operators.split(",") if name.strip()]
    graph = None
    swapped = [swap.partition("=")[0] for swap in args.swap]
    changed = [item.partition(".")[0] for item in args.set if item.partition(".")[0] not in swapped]
    if args.swap or args.set:
        graph = override(recording.graph, args.set, args.swap)
    allow_threads(max((spec.threads for spec in recording.run.specs), default=1))
    again = functools.partial(replay, recording, operators=names, graph=graph, changed=changed, swapped=swapped)
    with progress_bar("replaying", quiet=args.json) as progress:
        if args.record is None:
            result = again(progress=progress)
        else:
            specs = recording.run.specs if graph is None else wire(graph)
            replayed = names or [*changed, *swapped] or [spec.name for spec in specs if spec.kind == "operator"]
            run = run_for(recording, recording.run.graph if graph is None else to_dict(graph), specs)
            with Rerecorder(recording, args.record, run, replayed) as rerecorder:
                result = again(progress=progress, keep=rerecorder.keep)
                rerecorder.finish()
    if args.json:
        _print_json(result)
    else:
        print("\n".join(lines(result)))
    return 0 if result.equal else 1


def _diff_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("one", type=Path)
    parser.add_argument("two", type=Path)
    parser.add_argument("--json", action="store_true")


def _diff(args: argparse.Namespace) -> int:
    from graph.diff import compare
    from graph.recording import Recording

    result = compare(Recording(args.one), Recording(args.two))
    if args.json:
        _print_json(result)
    else:
        for item in result.operators:
            state = f"{item.different} differ, first: {item.first}" if item.different else "equal"
            print(f"{item.operator}: {item.messages} messages, {item.steps} steps, {state}")
        print("equal" if result.equal else "different")
    return 0 if result.equal else 1


def _info_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=Path)
    parser.add_argument("--log", metavar="OPERATOR", help="print what an operator wrote to its log")
    parser.add_argument("--json", action="store_true")


def _info(args: argparse.Namespace) -> int:
    from graph.info import describe, text
    from graph.recording import Recording

    recording = Recording(args.recording)
    if args.log:
        logs = {Path(item.name).stem: item.data for item in recording.attachments()}
        if args.log not in logs:
            raise UserError(
                f"{args.recording} holds no log of '{args.log}'; there is {', '.join(logs) or 'none at all'}"
            )
        sys.stdout.write(logs[args.log].decode(errors="replace"))
        return 0
    info = describe(recording)
    if args.json:
        _print_json(info)
    else:
        print(text(info))
    return 0


def _recover_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("source", type=Path, help="a folder of shards, or a damaged recording")
    parser.add_argument("-o", "--output", type=Path, required=True, help="the recording to write")


def _recover(args: argparse.Namespace) -> int:
    from graph.recover import recover

    result = recover(args.source, args.output)
    print(f"{args.output}: {result.messages} messages are back, {result.verdict.verdict}")
    for lost in result.lost:
        print(f"  lost: {lost}")
    return 0


RUNTIME = {
    "check": (_check_arguments, _check, "find every mistake of a graph file", "retracer check graph.yaml --draw"),
    "launch": (
        _launch_arguments,
        _launch,
        "run a graph, every operator its own process, and record it",
        "retracer launch graph.yaml --set simulator.seed=7 --swap localizer=operators.localizer:TrueLocalizer",
    ),
    "replay": (
        _replay_arguments,
        _replay,
        "run recorded operators again and compare to the bit",
        "retracer replay recordings/run.mcap --operators localizer",
    ),
    "diff": (
        _diff_arguments,
        _diff,
        "compare two recordings in all but the wall clock",
        "retracer diff one.mcap two.mcap",
    ),
    "info": (_info_arguments, _info, "say what is in a recording", "retracer info recordings/run.mcap --json"),
    "recover": (
        _recover_arguments,
        _recover,
        "rebuild a recording from what a crash left",
        "retracer recover recordings/run.shards -o recordings/run.mcap",
    ),
}


def _parser(verb: str | None) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("retracer", description="A dataflow of operator processes, retraced to the bit.")
    verbs = parser.add_subparsers(dest="verb", metavar="VERB", required=True)
    for name, (add_arguments, run, about, example) in RUNTIME.items():
        sub = verbs.add_parser(name, help=about, description=about, epilog=f"example: {example}")
        add_arguments(sub)
        sub.set_defaults(run=run)
    for name, (module, about) in DOMAIN.items():
        sub = verbs.add_parser(name, help=about, description=about, add_help=name == verb)
        if name == verb:
            loaded = _load(module)
            lines = [line.strip() for line in (loaded.__doc__ or "").splitlines()]
            sub.epilog = next((line for line in lines if line.startswith(("retracer", "example"))), None)
            loaded.add_arguments(sub)
            sub.set_defaults(run=loaded.run)
    return parser


def _load(module: str) -> Any:
    from graph.loading import load_module

    return load_module(module)


def main(arguments: list[str] | None = None) -> int:
    """Run one verb. Returns 0 on success only; bad input is one sentence on stderr and 2."""
    end_if_bound()
    given = sys.argv[1:] if arguments is None else arguments
    verb = next((word for word in given if not word.startswith("-")), None)
    try:
        args = _parser(verb).parse_args(given)
        return int(args.run(args))
    except UserError as error:
        print(f"retracer: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        return 1
    except KeyboardInterrupt:
        print("retracer: interrupted", file=sys.stderr)
        return 130
    except OSError as error:
        print(f"retracer: {error.strerror or error}: {error.filename or ''}".rstrip(": "), file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
