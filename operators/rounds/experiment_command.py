"""The experiment itself: stage after stage, each found again by the next run when it is done."""

from __future__ import annotations

import platform
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from graph.errors import UserError
from operators.rounds.report import page, summarize
from operators.rounds.schedule import LIDAR, TRUTH, Labels, Schedule, Session
from operators.rounds.session_command import bytes_in, keep_picture, launch, read_json, record_of, verb, write_json
from operators.rounds.variants import listening_graph, robot, session_graph, written

MOST_DISK = 20.0  # GB
OTHER_LIDAR = {"lidar": "hdl32e", "rolling": True, "dropout": 0.2}  # twice the columns, one after the other, with gaps
VERSIONS = ("numpy", "numba", "scipy", "torch", "pybullet", "embreex", "eclipse-zenoh", "mcap")


class Settings(msgspec.Struct, frozen=True):
    """What fixes an experiment; a run that goes on with another's folder must have the same."""

    building: str
    rounds: int
    scenarios: tuple[str, ...]
    tours: tuple[str, ...]
    mapping_tour: str
    seed: int
    repeats: int
    budget: str | None  # of each training
    steps: int | None
    every: int  # n-th frames that are labelled
    lidar: str
    threads: int  # of the segmenter

    @property
    def schedule(self) -> Schedule:
        """Return the sessions."""
        return Schedule(self.rounds, self.scenarios, self.tours, self.mapping_tour, self.seed, self.repeats)


class Experiment:
    """One folder; `run` does what is not done yet. Raises UserError where a stage fails; what is done stays."""

    def __init__(
        self, folder: Path, settings: Settings, *, workers: int = 1, keep: bool = False, say: Callable[[str], None]
    ) -> None:
        """Take up a folder. workers: sessions at once; keep: the recordings. Raises UserError for another's."""
        self.folder, self.settings, self.workers, self.keep, self.say = folder.resolve(), settings, workers, keep, say
        self.schedule = settings.schedule
        self.folder.mkdir(parents=True, exist_ok=True)
        known = read_json(self.folder / "settings.json")
        own = msgspec.json.decode(msgspec.json.encode(settings))
        if known is not None and known != own:
            other = [
                f"{name} {known.get(name)!r} instead of {own[name]!r}" for name in own if known.get(name) != own[name]
            ]
            raise UserError(f"{folder} holds another experiment: {', '.join(other)}; give the same, or another folder")
        write_json(self.folder / "settings.json", own)
        self.stages: list[dict[str, Any]] = read_json(self.folder / "stages.json") or []
        self.lock = threading.Lock()
        self.begun = time.monotonic()

    def run(self) -> dict[str, Any]:
        """Do everything, and write the report. Returns what stands in report.json."""
        self.map()
        for number in range(1, self.settings.rounds + 1):
            self.drive(self.schedule.round(number))
            if number < self.settings.rounds or self.settings.rounds == 1:
                self.annotate(number)
                self.train(number)
            self.drop(self.schedule.round(number))
            self.report()
        self.drive(self.schedule.truth())
        self.drive(self.schedule.predict())
        self.drive(self.schedule.lidar())
        self.evaluate()
        self.compare()
        return self.report(final=True)

    # What is there so far.

    def place(self, session: Session, suffix: str) -> Path:
        """Return a file of a session."""
        return self.folder / session.folder / f"{session.name}{suffix}"

    def round_folder(self, number: int) -> Path:
        """Return the folder of a round."""
        return self.folder / f"round-{number}"

    def latest(self, name: str, before: int) -> Path | None:
        """Return a file of the latest round before one that has it."""
        for number in range(before - 1, 0, -1):
            if (found := self.round_folder(number) / name).exists():
                return found
        return None

    def map_before(self, number: int) -> Path:
        """Return the map on which a round localizes."""
        return self.latest("annotation/map.ply", number) or self.folder / "mapping" / "map.ply"

    def networks(self) -> list[tuple[str, Path]]:
        """Return the first and the last network."""
        found = [
            (f"network of round {number}", path)
            for number in range(1, self.settings.rounds + 1)
            if (path := self.round_folder(number) / "weights.safetensors").exists()
        ]
        return found if len(found) < 2 else [found[0], found[-1]]

    @contextmanager
    def stage(self, name: str, group: str) -> Iterator[None]:
        """Time what is done, and note how large the folder has become."""
        self.say(f"{group}: {name}")
        self.begun = time.monotonic()
        try:
            yield
        finally:
            self.lap(name, group)

    def lap(self, name: str, group: str) -> None:
        """Note the time since the last lap."""
        now = time.monotonic()
        size = bytes_in(self.folder) / 1e9
        self.stages.append({"stage": name, "group": group, "seconds": now - self.begun, "disk_gb": size})
        self.begun = now
        write_json(self.folder / "stages.json", self.stages)
        if size > MOST_DISK:
            raise UserError(f"{self.folder} has grown to {size:.1f} GB; {MOST_DISK:.0f} are the most")

    # The stages.

    def map(self) -> None:
        """Drive through the nearly empty building, and make the initial map."""
        session, made = self.schedule.mapping(), self.folder / "mapping" / "map.json"
        if made.exists():
            return
        self.drive([session])
        with self.stage("map", session.group):
            target = self.folder / "mapping" / "map.ply"
            told = verb(["map", self.place(session, ".mcap"), "-o", target, "--json"], made.with_suffix(".log"))
            write_json(made, msgspec.json.decode(told))
        self.drop([session])

    def drive(self, sessions: list[Session]) -> None:
        """Drive those of a group that have not been driven."""
        waiting = [session for session in sessions if not self.place(session, ".json").exists()]
        if not waiting:
            return
        group = waiting[0].group
        (self.folder / waiting[0].folder).mkdir(exist_ok=True)
        with self.stage("drive", group), ThreadPoolExecutor(self.workers) as crew:
            futures = {crew.submit(self.drive_one, session): session for session in waiting}
            try:
                for future in as_completed(futures):
                    record = future.result()
                    self.say(
                        f"  {record['name']}: {record['reached']} of {record['targets']} ({record['ending']}), "
                        f"{record['time_s']:.0f} s, {record['collisions_with_people']} collisions with people, "
                        f"error {np.median(record['errors_mm']):.1f} mm"
                    )
                    self.lap("drive", group)
            except BaseException:
                crew.shutdown(cancel_futures=True)
                raise

    def drive_one(self, session: Session) -> dict[str, Any]:
        """Launch a session and keep its record; the recording stays until it is no longer needed."""
        graph, recording = self.place(session, ".yaml"), self.place(session, ".mcap")
        text = written(self.graph_of(session), f"{session.group}: {session.scenario}, tour {session.tour}")
        graph.write_text(text)
        record = record_of(session, launch(graph, recording), recording)
        record["graph"] = str(graph.relative_to(self.folder))
        if session.group == TRUTH and session.scenario == self.settings.scenarios[-1]:
            keep_picture(recording, self.place(session, ".picture.npz"))
        write_json(self.place(session, ".json"), record)
        if session.group not in (TRUTH, "mapping") and not session.group.startswith("round"):
            self.drop([session])
        return record

    def graph_of(self, session: Session) -> dict[str, Any]:
        """Return the graph of a session with the latest map and network before it."""
        number = int(session.group.split()[1]) if session.group.startswith("round") else self.settings.rounds + 1
        weights = self.latest("weights.safetensors", number)
        if session.labels == "network" and weights is None:
            session = session._replace(labels="none")
        return session_graph(
            session,
            building=self.settings.building,
            map_file=None if session.group == "mapping" else self.relative(self.map_before(number)),
            weights=None if weights is None else self.relative(weights),
            threads=self.settings.threads,
            lidar=OTHER_LIDAR if session.group == LIDAR else {"lidar": self.settings.lidar},
        )

    def relative(self, path: Path) -> str:
        """Return a path as a graph file in one of the groups' folders names it."""
        return str(Path("..") / path.relative_to(self.folder))

    def annotate(self, number: int) -> None:
        """Label the accepted sessions of a round; then its recordings are no longer needed."""
        sessions, folder = self.schedule.round(number), self.round_folder(number)
        done, target = folder / "annotation.json", folder / "annotation"
        if not done.exists():
            with self.stage("annotate", f"round {number}"):
                recordings = [self.place(session, ".mcap") for session in sessions]
                options = ["--every", str(self.settings.every), "--workers", str(self.workers), "--json"]
                arguments: list[str | Path] = [
                    "annotate",
                    *recordings,
                    "--map",
                    self.map_before(number),
                    "-o",
                    target,
                    *options,
                ]
                try:
                    told = msgspec.json.decode(verb(arguments, folder / "annotation.log"))
                except UserError as error:
                    if "is accepted" not in str(error):
                        raise
                    told = {"frames": 0, "sessions_accepted": 0, "coverage": None, "refused": str(error)}
                write_json(done, told)
        for left in ("work", "buffers"):
            shutil.rmtree(target / left, ignore_errors=True)

    def train(self, number: int) -> None:
        """Train a network afresh on all that was labelled so far; none where nothing was."""
        folder = self.round_folder(number)
        weights, done = folder / "weights.safetensors", folder / "training.json"
        labelled = [
            path
            for earlier in range(1, number + 1)
            for path in sorted((self.round_folder(earlier) / "annotation").glob("*.labelled.mcap"))
        ]
        if done.exists() or not labelled:
            return
        with self.stage("train", f"round {number}"):
            settings = self.settings
            length = ["--steps", str(settings.steps)] if settings.steps else ["--budget", settings.budget or "15min"]
            partial = folder / "training.safetensors"
            threads = settings.threads * self.workers
            told = verb(
                ["train", *labelled, "-o", partial, *length, "--resume", "--threads", str(threads), "--json"],
                folder / "training.log",
                threads=threads,
            )
            partial.replace(weights)
            write_json(done, msgspec.json.decode(told))

    def evaluate(self) -> None:
        """Hold the first and the last network against the truth of recordings that nobody learned: the last round's."""
        recordings = [self.place(session, ".mcap") for session in self.schedule.truth()]
        for _, weights in self.networks():
            target = weights.with_name("evaluation.json")
            if not target.exists():
                with self.stage("evaluate", weights.parent.name):
                    threads = self.settings.threads * self.workers
                    options = ["--every", "10", "--threads", str(threads), "--json"]
                    told = verb(
                        ["evaluate", weights, *recordings, *options], target.with_suffix(".log"), threads=threads
                    )
                    write_json(target, msgspec.json.decode(told))

    def compare(self) -> None:
        """Localize on the recordings of the last round once more with other labels: same frames, other eyes."""
        ways: list[tuple[str, Labels, Path | None]] = [("no labels", "none", None)]
        ways += [(name, "network", weights) for name, weights in self.networks()]
        jobs = [(session, *way) for session in self.schedule.truth() for way in ways]
        waiting = [job for job in jobs if not self.compared(job[0], job[1]).exists()]
        if waiting:
            (self.folder / "comparison").mkdir(exist_ok=True)
            with self.stage("compare", "comparison"), ThreadPoolExecutor(self.workers) as crew:
                for future in as_completed([crew.submit(self.compare_one, *job) for job in waiting]):
                    self.say(f"  {future.result()}")
                    self.lap("compare", "comparison")
        self.drop(self.schedule.truth())

    def compared(self, session: Session, name: str) -> Path:
        """Return the record of a session with other labels."""
        return self.folder / "comparison" / f"{session.name}-{name.replace(' ', '-')}.json"

    def compare_one(self, session: Session, name: str, labels: Labels, weights: Path | None) -> str:
        """Localize on a recording with other labels, and keep the errors."""
        target = self.compared(session, name)
        graph, recording = target.with_suffix(".yaml"), target.with_suffix(".mcap")
        content = listening_graph(
            self.graph_of(session),
            self.relative(self.place(session, ".mcap")),
            labels,
            weights=None if weights is None else self.relative(weights),
            threads=self.settings.threads,
        )
        graph.write_text(written(content, f"{session.name} heard again with {name}"))
        record = record_of(session, launch(graph, recording), recording)
        write_json(target, {**record, "group": name})
        recording.unlink()
        return f"{target.stem}: error {np.median(record['errors_mm']):.1f} mm"

    def drop(self, sessions: list[Session]) -> None:
        """Delete recordings; their graphs and seeds stay, and make them anew."""
        if not self.keep:
            for session in sessions:
                self.place(session, ".mcap").unlink(missing_ok=True)

    # The report.

    def told(self) -> dict[str, Any]:
        """Gather everything that is known so far."""
        sessions = [session for group in self.schedule.groups() for session in group]
        records = [record for session in sessions if (record := read_json(self.place(session, ".json"))) is not None]
        truth = [{**record, "group": "truth"} for record in records if record["group"] == TRUTH]
        heard = [read_json(path) for path in sorted((self.folder / "comparison").glob("*.json"))]
        names = ["no labels", *(name for name, _ in self.networks())]
        comparison = [item for name in names for item in heard if item["group"] == name]
        labels = [
            {"group": f"round {number}", **told}
            for number in range(1, self.settings.rounds + 1)
            if (told := read_json(self.round_folder(number) / "annotation.json")) is not None
        ]
        networks = [
            {"name": name, "evaluation": evaluation}
            for name, weights in self.networks()
            if (evaluation := read_json(weights.with_name("evaluation.json"))) is not None
        ]
        about = {"cpu": platform.processor() or platform.machine(), "python": platform.python_version()}
        settings = msgspec.to_builtins(self.settings) | about | {"versions": _versions(), "workers": self.workers}
        return summarize(
            {
                "settings": settings,
                "graph": robot(),
                "mapping": read_json(self.folder / "mapping" / "map.json"),
                "sessions": records,
                "comparison": comparison + (truth if comparison else []),
                "labels": labels,
                "trainings": [
                    told
                    for number in range(1, self.settings.rounds + 1)
                    if (told := read_json(self.round_folder(number) / "training.json")) is not None
                ],
                "networks": networks,
                "stages": self.stages,
                "disk_gb": max((item["disk_gb"] for item in self.stages), default=0.0),
            }
        )

    def report(self, *, final: bool = False) -> dict[str, Any]:
        """Write report.html and report.json of what is there."""
        told = self.told()
        write_json(self.folder / "report.json", told)
        (self.folder / "report.html").write_text(page(told, self.picture() if final else None), encoding="utf-8")
        return told

    def picture(self) -> dict[str, Any] | None:
        """Return a frame of the last round as truth, the first and the last network see it."""
        found = sorted((self.folder / TRUTH).glob("*.picture.npz"))
        if not found:
            return None
        from operators.kpconv.classifier import load_classifier
        from operators.kpconv.metrics import LABEL_OF_TRUTH

        with np.load(found[-1]) as file:
            points, truth, rings, mount = (file[name] for name in ("points", "truth", "ring", "base_from_lidar"))
        labellings = [("truth", LABEL_OF_TRUTH[truth])]
        for name, weights in self.networks():
            classifier = load_classifier(weights, None)
            result = classifier.classify(points, mount, rings if len(rings) else None, full=True)
            labellings.append((name, result.full()[0]))
        return {"points": points, "labellings": labellings}


def _versions() -> dict[str, str]:
    """Return the versions of what fixes the bits."""
    found = {}
    for name in VERSIONS:
        try:
            found[name] = version(name)
        except ModuleNotFoundError:
            continue
    return found
