"""A tree of frames that move against each other, as ROS keeps one in /tf and /tf_static."""

from __future__ import annotations

from collections import deque

import numpy as np

from graph.geometry import Matrix, inverse
from operators.scans.trajectory import Trajectory


class Joint:
    """What is known of one frame in another: poses over time, or one for ever."""

    def __init__(self) -> None:
        self.fixed: Matrix | None = None
        self.poses: dict[int, Matrix] = {}  # by stamp, ns
        self.sorted: Trajectory | None = None

    def at(self, stamp: int | None) -> Matrix | None:
        """Return parent_from_child at a stamp; a stamp of None asks for what holds for ever, or else the first."""
        if self.fixed is not None:
            return self.fixed
        if self.sorted is None:
            stamps = sorted(self.poses)
            self.sorted = Trajectory(np.array([self.poses[known] for known in stamps]), np.array(stamps, np.int64))
        if stamp is None:
            return np.array(self.sorted.poses[0])
        motion = self.sorted.at(stamp)
        return None if motion is None else motion.pose


class Tree:
    """Frames by name; a leading slash of ROS 1 names does not count."""

    def __init__(self) -> None:
        self.joints: dict[tuple[str, str], Joint] = {}  # (parent, child)

    @property
    def frames(self) -> list[str]:
        """Name all frames, each once, in the order in which they were met."""
        return list(dict.fromkeys(frame for pair in self.joints for frame in pair))

    def add(self, parent: str, child: str, parent_from_child: Matrix, stamp: int | None) -> None:
        """Add one transform; stamp: ns, or None for one that holds for ever."""
        joint = self.joints.setdefault((parent.lstrip("/"), child.lstrip("/")), Joint())
        if stamp is None:
            joint.fixed = parent_from_child
        else:
            joint.poses[stamp] = parent_from_child
            joint.sorted = None

    def path(self, target: str, source: str) -> list[tuple[Joint, bool]] | None:
        """Return the joints from target to source, each with whether it goes from parent to child; None if cut."""
        target, source = target.lstrip("/"), source.lstrip("/")
        came: dict[str, list[tuple[Joint, bool]]] = {target: []}
        waiting = deque([target])
        while waiting and source not in came:
            here = waiting.popleft()
            for (parent, child), joint in self.joints.items():
                for start, end, down in ((parent, child, True), (child, parent, False)):
                    if start == here and end not in came:
                        came[end] = [*came[here], (joint, down)]
                        waiting.append(end)
        return came.get(source)

    def at(self, target: str, source: str, stamp: int | None) -> Matrix | None:
        """Return target_from_source (4, 4) at a stamp in ns; None if the frames are not joined then."""
        if (path := self.path(target, source)) is None:
            return None
        result = np.eye(4)
        for joint, down in path:
            if (pose := joint.at(stamp)) is None:
                return None
            result = result @ (pose if down else inverse(pose))
        return result

    def stamps(self, target: str, source: str) -> list[int]:
        """List the stamps in ns at which something between two frames was told, in order."""
        path = self.path(target, source) or []
        return sorted({stamp for joint, _ in path if joint.fixed is None for stamp in joint.poses})

    def trajectory(self, target: str, source: str) -> Trajectory | None:
        """Return target_from_source at each stamp where the tree knows it; None if it never does."""
        told = ((stamp, self.at(target, source, stamp)) for stamp in self.stamps(target, source))
        known = [(stamp, pose) for stamp, pose in told if pose is not None]
        if not known:
            return None
        return Trajectory(np.array([pose for _, pose in known]), np.array([stamp for stamp, _ in known], np.int64))
