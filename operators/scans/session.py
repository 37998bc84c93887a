"""A session of scans: each with its stamp and, where it is known, where odometry says the robot was."""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from graph.geometry import Matrix, exponential, inverse
from operators.scans.bag import BagScans, bag_files
from operators.scans.carmen import CarmenScans, is_log
from operators.scans.folder import FolderScans, Scans
from operators.scans.packets import PacketScans
from operators.scans.poses import read_calibration, read_poses
from operators.scans.scan import Scan, ScanError, clean, rings_fall, turned
from operators.scans.settings import Settings
from operators.scans.stamps import SECOND
from operators.scans.trajectory import Motion, Trajectory, derived, pose_of, rotation_of

RATE = 10.0  # Hz, where nobody says
FAR = 10_000.0  # metres; maps are float32, which holds a millimetre up to here
BEAMS = (16, 32, 40, 64, 128, 256)  # of lidars that count their rings from the highest

log = logging.getLogger("retracer.import")


class Frame(NamedTuple):
    """One scan of a session."""

    stamp: int  # ns from the first scan on
    scan: Scan  # finite points within range
    odometry: Motion | None  # odom_from_base


class Session:
    """Scans and odometry as the settings describe them; iterating reads the scans one by one.

    What can be known without reading the points is checked here. Raises ScanError in one sentence, and OSError for
    files that cannot be opened.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        if settings.rate is not None and not settings.rate > 0.0:
            raise ScanError(f"the rate of scans is above 0 Hz; {settings.rate:g} was given")
        if settings.max_range is not None and not settings.max_range > settings.min_range:
            raise ScanError(f"no point is nearer than {settings.max_range:g} m and beyond {settings.min_range:g} m")
        self.scans = open_scans(settings)
        self.remarks = list(self.scans.remarks)
        self.base_from_lidar = self._placement()
        trajectory = self._trajectory()
        self.kept, stamps, self.duplicates = self._stamps(trajectory)
        self.stamps = [stamp - stamps[0] for stamp in stamps]
        self.odometry = self._odometry(trajectory, stamps)
        self.counts: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self.kept)

    def _placement(self) -> Matrix:
        """Return base_from_lidar: as it was said, else as the bag has it, else at the base."""
        said, height = self.settings.base_from_lidar, self.settings.lidar_height
        if said is not None and height is not None:
            raise ScanError("the lidar's place is said by its height or by base_from_lidar, not by both")
        if said is not None:
            return placement(said)
        if height is None and self.scans.base_from_lidar is not None:
            return self.scans.base_from_lidar
        if height is None:
            self.remarks.append("the lidar is taken to stand on the floor at the robot's centre; say --lidar-height")
        return placement([0.0, 0.0, height or 0.0])

    def _trajectory(self) -> Trajectory | None:
        """Return odom_from_base: of the pose file, else of the bag; None if there is neither."""
        settings = self.settings
        if settings.poses is None:
            if settings.poses_of != "base":
                raise ScanError(f"poses of the {settings.poses_of} want a file of poses")
            if self.scans.odometry is None and not self.remarks:
                self.remarks.append("there are no poses, so the session has no odometry; --poses FILE gives them")
            return self.scans.odometry
        known = read_poses(settings.poses, settings.poses_format, drop_duplicates=settings.drop_duplicates)
        poses = known.poses
        if settings.poses_of == "camera":
            if settings.calibration is None:
                raise ScanError("poses of the camera want the lidar's place: --calibration calib.txt")
            camera_from_lidar = read_calibration(settings.calibration)
            poses = inverse(camera_from_lidar) @ poses @ camera_from_lidar  # the world is the first lidar's, z up
        if settings.poses_of != "base":
            poses = poses @ inverse(self.base_from_lidar)
        return known._replace(poses=poses)

    def _stamps(self, trajectory: Trajectory | None) -> tuple[list[int], list[int], int]:
        """Return which scans are kept, their stamps in ns, and how many are not, as their stamp was there already."""
        sweeps, rate = self.scans.sweeps, self.settings.rate
        if sweeps[0].stamp is not None:
            stamps = [sweep.stamp or 0 for sweep in sweeps]
        elif rate is None and trajectory is not None and trajectory.stamps is not None:
            if len(trajectory.stamps) != len(sweeps):
                raise ScanError(
                    f"the {len(sweeps)} scans of {self.scans.name} have no stamps, and {self.settings.poses} has "
                    f"{len(trajectory.stamps)} poses, so which belongs to which cannot be told; --stamps FILE says when"
                )
            stamps = trajectory.stamps.tolist()
        else:
            stamps = [round(place * SECOND / (rate or RATE)) for place in range(len(sweeps))]
        kept: list[int] = []
        for place, stamp in enumerate(stamps):
            if not kept or stamp > stamps[kept[-1]]:
                kept.append(place)
                continue
            last = sweeps[kept[-1]].name
            if stamp < stamps[kept[-1]]:
                raise ScanError(f"{self.scans.name}: {sweeps[place].name} is stamped before {last}, which precedes it")
            if not self.settings.drop_duplicates:
                raise ScanError(
                    f"{self.scans.name}: {sweeps[place].name} has the stamp of {last}, {stamp / SECOND:.9f} s; "
                    "--drop-duplicates keeps the first"
                )
        return kept, [stamps[place] for place in kept], len(sweeps) - len(kept)

    def _odometry(self, trajectory: Trajectory | None, stamps: Sequence[int]) -> list[Motion | None]:
        """Return odom_from_base with its velocity for each kept scan; None where no pose is near."""
        if trajectory is None:
            return [None] * len(stamps)
        if trajectory.stamps is not None and (self.scans.sweeps[0].stamp is not None):
            motions = [trajectory.at(stamp) for stamp in stamps]
        else:
            motions = self._in_order(trajectory)
        missing = [place for place, motion in enumerate(motions) if motion is None]
        if missing and (not self.settings.allow_missing or len(missing) == len(motions)):
            raise ScanError(self._missing(missing, trajectory, stamps))
        poses = [None if motion is None else motion.pose for motion in motions]
        first = next(pose for pose in poses if pose is not None)
        if self.settings.start_at_origin:
            poses = [None if pose is None else inverse(first) @ pose for pose in poses]
        elif np.abs(first[:3, 3]).max() > FAR:
            self.remarks.append(
                f"the first pose is {np.abs(first[:3, 3]).max() / 1000.0:.0f} km from the origin, where maps lose "
                "their millimetres; --start-at-origin moves it there"
            )
        moving = derived(stamps, poses)
        if trajectory.velocities is not None:
            moving = [
                None if motion is None or pose is None else motion._replace(pose=pose)
                for motion, pose in zip(motions, poses, strict=True)
            ]
        return moving

    def _in_order(self, trajectory: Trajectory) -> list[Motion | None]:
        """Give the n-th pose to the n-th scan; to fewer scans, named by six digits or more, the pose of that number."""
        sweeps, count = self.scans.sweeps, len(trajectory.poses)
        places = list(range(len(sweeps)))
        if count > len(sweeps):
            stems = [Path(sweep.name).name.partition(".")[0] for sweep in sweeps]
            if not all(re.fullmatch(r"\d{6,}", stem) and int(stem) < count for stem in stems):
                raise ScanError(
                    f"{self.settings.poses} has {count} poses for the {len(sweeps)} scans of {self.scans.name}, so "
                    "which belongs to which cannot be told"
                )
            places = [int(stem) for stem in stems]
            self.remarks.append(f"scan {stems[0]} takes the pose number {places[0]} of {self.settings.poses}, from 0")
        return [Motion(trajectory.poses[places[place]]) if places[place] < count else None for place in self.kept]

    def _missing(self, missing: list[int], trajectory: Trajectory, stamps: Sequence[int]) -> str:
        first = missing[0]
        name = self.scans.sweeps[self.kept[first]].name
        text = f"{len(missing)} of {len(stamps)} scans have no pose, the first is {name}"
        if trajectory.stamps is None or self.scans.sweeps[0].stamp is None:
            text += f": there are {len(trajectory.poses)} poses"
        else:
            begin, end = (int(trajectory.stamps[place]) / SECOND for place in (0, -1))
            text += f" at {stamps[first] / SECOND:.3f} s: the poses are from {begin:.3f} to {end:.3f} s"
        if len(missing) == len(stamps):
            return f"{text}, of another clock or another drive"
        return f"{text}; --allow-missing imports them without odometry"

    def __iter__(self) -> Iterator[Frame]:
        """Read the scans in order; counts points and what was left out in `counts`. Raises ScanError, OSError."""
        for remark in self.remarks:
            log.warning(remark)
        self.counts.clear()
        told: set[str] = set()
        falls: bool | None = None
        beams = 0
        for stamp, whole, odometry in zip(self.stamps, self.scans.read(self.kept), self.odometry, strict=True):
            if whole.remark and whole.remark not in told:
                told.add(whole.remark)
                log.warning(whole.remark)
            scan, dropped = clean(whole, min_range=self.settings.min_range, max_range=self.settings.max_range)
            if falls is None and scan.ring is not None and (falls := rings_fall(scan)):
                beams = next(beams for beams in BEAMS if beams > scan.ring.max())
            self.counts.update(
                frames=1,
                points=len(scan.points),
                points_not_finite=dropped.not_finite,
                points_out_of_range=dropped.out_of_range,
                empty_frames=int(not len(scan.points)),
                frames_without_odometry=int(odometry is None),
            )
            yield Frame(stamp, turned(scan, beams) if falls else scan, odometry)


def open_scans(settings: Settings) -> Scans:
    """Open what the settings point at: a folder of scan files, a .pcap, a CARMEN log, or a bag. Raises ScanError."""
    place = settings.folder
    if not place.exists():
        raise ScanError(f"{place}: no such file or folder")
    files = bag_files(place)
    for flag, given, fits in (
        ("--pattern", settings.pattern != "*", not files),
        ("--stamps", settings.stamps is not None, not files),
        ("--points-topic", settings.points_topic is not None, files),
        ("--odometry-topic", settings.odometry_topic is not None, files),
    ):
        if given and not fits:
            raise ScanError(f"{flag} is for {'folders of scans' if files else 'bags'}; {place} is no such thing")
    captures = [place] if place.suffix.lower() in (".pcap", ".pcapng") else sorted(place.glob("*.pcap"))
    if files:
        return BagScans(
            files,
            points_topic=settings.points_topic,
            odometry_topic=settings.odometry_topic,
            odom_frame=settings.odom_frame,
            base_frame=settings.base_frame,
        )
    if place.is_file() and is_log(place):
        return CarmenScans(place)
    if len(captures) == 1:
        return PacketScans(captures[0])
    if place.is_file():
        raise ScanError(
            f"{place} is no folder of scans, no .pcap and no bag (.bag, .mcap, .db3), and no CARMEN log (.clf, .log)"
        )
    return FolderScans(place, settings.pattern, stamps=settings.stamps, named=settings.rate is None)


def placement(numbers: Sequence[float]) -> Matrix:
    """Build a pose (4, 4) of x y z, x y z roll pitch yaw, x y z qx qy qz qw, or 16 numbers; metres and radians.

    Raises ScanError for another count, or numbers that are no rigid transform.
    """
    values = np.asarray(numbers, np.float64)
    try:
        match len(values):
            case 3:
                return pose_of(np.eye(3), values)
            case 6:
                about = [exponential(values[3 + axis] * np.eye(3)[axis]) for axis in range(3)]
                return pose_of(about[2] @ about[1] @ about[0], values[:3])
            case 7:
                return pose_of(rotation_of(values[3:]), values[:3])
            case 16:
                return pose_of(values.reshape(4, 4)[:3, :3], values.reshape(4, 4)[:3, 3])
    except ValueError as error:
        raise ScanError(f"base_from_lidar: {error}") from None
    wanted = "3 (x y z), 6 (and roll pitch yaw), 7 (and qx qy qz qw) or 16 numbers"
    raise ScanError(f"base_from_lidar wants {wanted}; it has {len(values)}")
