"""Segmenters: which points are ground, permanent, long-term movable, short-term movable.

segmenter:
  run: operators.segmenter:Segmenter
  inputs: {frame: simulator/frame}
  config: {weights: recordings/weights/realtime.safetensors}
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import msgspec
import numpy as np

from graph.contract import Operator, Summary
from graph.geometry import planar
from graph.messages import PointCloud
from operators.kpconv.metrics import LABEL_OF_TRUTH
from operators.pointmap.rehearsal import room_scan
from operators.pointmap.voxels import central_points

if TYPE_CHECKING:
    from operators.kpconv.classifier import Classifier

CLASSES = ("uncertain", "ground", "permanent", "longT", "shortT")  # labels 0 to 4


class Counted(Operator):
    """Counts the labels that go out."""

    class Outputs(msgspec.Struct):
        """A subsampled, classified cloud; the whole frame with labels where it is asked for."""

        classified: PointCloud | None = None
        full: PointCloud | None = None

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        self.frames = 0
        self.counts = np.zeros(len(CLASSES), np.int64)

    def on_end(self) -> Summary:
        """Tell the share of each label."""
        total = max(1, int(self.counts.sum()))
        shares = {name: int(count) / total for name, count in zip(CLASSES, self.counts, strict=True)}
        return Summary(frames=self.frames, classified_points=int(self.counts.sum()), shares=shares)

    def count(self, cloud: PointCloud) -> None:
        """Count a cloud."""
        assert cloud.label is not None
        self.frames += 1
        self.counts += np.bincount(cloud.label, minlength=len(CLASSES))


class Segmenter(Counted):
    """Classify each frame by a trained network."""

    class Config(msgspec.Struct, forbid_unknown_fields=True):
        """The network."""

        weights: Path  # .safetensors of `retracer train`; the architecture is in its header
        precision: Literal["auto", "float32", "bfloat16"] = "auto"  # auto: bfloat16 where native
        full: bool = False  # whether the whole frame goes out too, each point labelled as the nearest classified one

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        import torch  # here, so that a graph is checked, and TrueSegmenter runs, without it

        from operators.kpconv.classifier import load_classifier

        precisions = {"auto": None, "float32": torch.float32, "bfloat16": torch.bfloat16}
        self.classifier: Classifier = load_classifier(config.weights, precisions[config.precision])

    @classmethod
    def warm_up(cls) -> None:
        """Classify a scan of a made-up room by an untrained network."""
        from operators.kpconv.classifier import classifier_of
        from operators.kpconv.settings import PRESETS
        from operators.kpconv.weights import recipe_of

        settings = PRESETS["realtime"]
        classifier = classifier_of(recipe_of(settings).network().eval(), settings)
        classifier.classify(room_scan(), planar(0.0, 0.0, 0.0, 0.64), full=True)

    def on_frame(self, frame: PointCloud) -> Counted.Outputs:
        """Subsample and classify a frame."""
        full = self.config.full
        result = self.classifier.classify(frame.points, frame.base_from_lidar, frame.ring, full=full)
        classified = PointCloud(
            measured_at=frame.measured_at,
            points=result.points,
            base_from_lidar=frame.base_from_lidar,
            ring=None if frame.ring is None else frame.ring[result.source],
            time_offset=None if frame.time_offset is None else frame.time_offset[result.source],
            label=result.labels,
            scores=result.scores,
        )
        self.count(classified)
        if not full:
            return self.Outputs(classified)
        labels, scores = result.full()
        return self.Outputs(classified, msgspec.structs.replace(frame, label=labels, scores=scores))


class TrueSegmenter(Counted):
    """Pass on what the simulator knows, mapped to the four classes: the paper's last round."""

    class Config(msgspec.Struct, forbid_unknown_fields=True):
        """The subsampling; keys of Segmenter are taken though they change nothing, so that one line swaps."""

        weights: Path | None = None
        precision: str = "auto"
        full: bool = False
        voxel: float = 0.08  # metres

    def on_frame(self, frame: PointCloud) -> Counted.Outputs:
        """Subsample a frame and name its classes. Raises ValueError for a frame without truth."""
        if frame.truth is None:
            raise ValueError("TrueSegmenter wants frames with truth, which only a simulator gives")
        x, y, z = np.ascontiguousarray(frame.points.T)
        chosen = np.sort(central_points(x, y, z, self.config.voxel))
        labels = LABEL_OF_TRUTH[frame.truth]
        scores = certain(labels)
        whole = msgspec.structs.replace(frame, label=labels, scores=scores)
        arrays = ("points", "ring", "time_offset", "label", "scores", "truth", "moving", "instance")
        parts = {name: values[chosen] for name in arrays if (values := getattr(whole, name)) is not None}
        classified = msgspec.structs.replace(whole, **parts)
        self.count(classified)
        return self.Outputs(classified, whole if self.config.full else None)


def certain(labels: np.ndarray[Any, np.dtype[np.uint8]]) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Return scores (n, 4) that leave no doubt of labels (n,), or all doubt where they are 0."""
    scores = np.zeros((len(labels), len(CLASSES) - 1), np.float32)
    known = labels > 0
    scores[known, labels[known].astype(np.int64) - 1] = 1.0
    scores[~known] = 1.0 / scores.shape[1]
    return scores
