"""What is fixed before a run starts: where its recording goes, and what the recording says of its origin."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import NamedTuple, Self

import msgspec

from graph.errors import UserError
from graph.graphfile import Graph, to_dict
from graph.loading import build_config, config_files, load_class
from graph.provenance import cpu_class, file_digest, versions
from graph.recording import Run
from graph.wiring import NodeSpec

RECORDINGS = Path("recordings")


class Paths(NamedTuple):
    """The recording, and the folder of shards that it is merged from."""

    recording: Path
    shards: Path

    @classmethod
    def choose(cls, name: str, record: Path | None) -> Self:
        """Take the path that was asked for, else `recordings/<graph>-<time>.mcap`. Raises UserError if it is taken."""
        if record is None:
            stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
            record = RECORDINGS / f"{name}-{stamp}.mcap"
            number = 1
            while record.exists() or record.with_suffix(".shards").exists():
                number += 1
                record = RECORDINGS / f"{name}-{stamp}-{number}.mcap"
        shards = record.with_suffix(".shards")
        if record.suffix != ".mcap":
            raise UserError(f"a recording is an .mcap file; {record} is none")
        for path in (record, shards):
            if path.exists():
                hint = f"; `retracer recover {path} -o FILE` merges it" if path is shards else ""
                raise UserError(f"{path} exists already{hint}; name another recording")
        try:
            record.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"no recording can be written to {record.parent}: {error.strerror}") from error
        return cls(record, shards)


def describe(graph: Graph, specs: list[NodeSpec], command: str = "") -> Run:
    """Write down where a run comes from: graph, versions, processor, and the digest of every file a config names."""
    files = {}
    for spec in specs:
        config = build_config(load_class(spec.run, spec.root), spec.config, Path(spec.root))
        for path in config_files(config):
            files[_near(path)] = file_digest(path)
    root = _near(Path(graph.root))
    return Run(
        graph=to_dict(msgspec.structs.replace(graph, root=root)),
        specs=tuple(msgspec.structs.replace(spec, root=root) for spec in specs),
        versions=versions(),
        cpu=cpu_class(),
        files=files,
        started=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        command=command,
    )


def _near(path: Path) -> str:
    """Name a path from the working directory if it lies there, so that a replay works in another checkout."""
    here = Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else str(path)


def run_of(shards: Path) -> Run:
    """Read what a launcher wrote down before it was killed. Raises UserError by name."""
    path = shards / "run.json"
    try:
        return msgspec.json.decode(path.read_bytes(), type=Run)
    except FileNotFoundError:
        raise UserError(f"{shards} is no folder of shards: it has no run.json") from None
    except msgspec.MsgspecError as error:
        raise UserError(f"{path} is damaged: {error}") from error
