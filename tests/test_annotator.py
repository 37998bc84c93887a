"""The annotator as an operator: it collects, traces, publishes, and labels at the end."""

from __future__ import annotations

import numpy as np
import pytest

from graph.codec import decode, encode
from graph.contract import Summary, ports_of
from graph.messages import MapCloud, Odometry, PointCloud, Pose
from operators.annotator import Annotator
from operators.pointmap import PointMap, save_map
from tests.room_tour import PERIOD, WALKER, RoomTour, inside, place
from tests.test_pointmap_room import BASE_FROM_LIDAR, BOXES, scan

SHORT, PERMANENT, GROUND = 4, 2, 1


def drive(annotator: Annotator, steps: int = 40, **config):
    """Feed a tour; returns the maps that were published, and what the end brings."""
    tour = RoomTour(RoomTour.Config(steps=steps, walks=True, **config))
    maps = []
    for step in range(steps):
        said = tour.outputs(step)
        annotator.on_odometry(said.odometry)
        annotator.on_frame(said.frame)
        if said.pose is not None and (outputs := annotator.on_pose(said.pose)) is not None:
            maps.append(outputs.map)
    *labelled, summary = annotator.on_end()
    return maps, [outputs.labelled for outputs in labelled], summary


@pytest.fixture(scope="module")
def empty_map(tmp_path_factory):
    """The map of the room with nobody in it."""
    pointmap = PointMap()
    for step in range(0, 40, 4):
        pose = place(step) @ BASE_FROM_LIDAR
        pointmap.enter(pointmap.prepare(scan(pose, boxes=BOXES, noise=0.005, seed=step)), pose)
    path = tmp_path_factory.mktemp("room") / "map.ply"
    save_map(path, pointmap.map.cloud())
    return path


def test_the_ports_are_those_that_graphs_use():
    ports = ports_of(Annotator)
    assert list(ports.inputs.items()) == [("odometry", Odometry), ("frame", PointCloud), ("pose", Pose)]
    assert ports.outputs == {"map": MapCloud, "labelled": PointCloud}


def test_a_session_is_labelled_at_its_end(empty_map):
    annotator = Annotator(Annotator.Config(map=empty_map, every=4, frustum_width=0.0122))
    maps, labelled, summary = drive(annotator)
    assert isinstance(summary, Summary)
    assert summary["frames"] == 40
    assert summary["frames_labelled"] == len(labelled) == 10
    assert [frame.measured_at for frame in labelled] == [n * 4 * PERIOD for n in range(10)]
    label = np.concatenate([frame.label for frame in labelled])
    truth = np.concatenate([frame.truth for frame in labelled])
    assert (label[truth == WALKER] == SHORT).mean() > 0.7  # the last places are looked at fewer than ten times
    assert (label[truth == 2] == PERMANENT).mean() > 0.95
    assert (label[truth == 1] == GROUND).mean() > 0.97
    assert summary["coverage"] == pytest.approx(np.mean(label > 0))
    for frame in labelled:
        assert decode(encode(frame), PointCloud).label is not None
    assert maps


def test_maps_are_published_while_the_robot_drives(empty_map):
    maps, _, _ = drive(Annotator(Annotator.Config(map=empty_map, period=1.0, frustum_width=0.0122)))
    assert [cloud.measured_at for cloud in maps] == [n * 10 * PERIOD for n in range(4)]
    first, last = maps[0], maps[-1]
    assert not last.incremental
    walked = (np.array([-2.4, 3.0, 0.1]), np.array([-1.0, 3.35, 1.7]))
    moved = inside(last.points, walked)
    assert (last.label[moved] == SHORT).mean() > 0.5
    assert (last.movable[moved] > first.movable.min()).any()
    assert len(last.points) <= 2 * len(np.unique(np.floor(last.points / 0.12), axis=0))
    decode(encode(last), MapCloud)


def test_without_a_map_everything_is_new_and_still_labelled():
    _, labelled, summary = drive(Annotator(Annotator.Config(every=10, frustum_width=0.0122)), steps=24)
    assert len(labelled) == 3
    assert summary["points"]["permanent"] == 0
    assert summary["points"]["ground"] > 0.1 * sum(summary["points"].values())
    assert summary["points"]["longT"] > 0.2 * sum(summary["points"].values())


def test_frames_whose_pose_is_doubted_are_left_out(empty_map):
    _, labelled, summary = drive(Annotator(Annotator.Config(map=empty_map, every=1)), steps=12, invalid=5, skipped=2)
    assert summary["frames"] == len(labelled) == 7
    assert summary["frames_without_a_valid_pose"] == 3
    assert [frame.measured_at for frame in labelled] == [n * PERIOD for n in range(5, 12)]


def test_the_same_session_gives_the_same_bytes(empty_map):
    def run():
        _, labelled, _ = drive(Annotator(Annotator.Config(map=empty_map, every=8)), steps=16)
        return [encode(frame) for frame in labelled]

    assert run() == run()


def test_empty_frames_and_a_session_without_any(empty_map):
    assert next(Annotator(Annotator.Config(map=empty_map)).on_end())["frames"] == 0
    annotator = Annotator(Annotator.Config(map=empty_map, every=1))
    annotator.on_frame(PointCloud(measured_at=0, points=np.zeros((0, 3), np.float32), base_from_lidar=BASE_FROM_LIDAR))
    annotator.on_pose(Pose(measured_at=0, world_from_base=np.eye(4)))
    points = np.full((12, 3), np.nan, np.float32)
    annotator.on_frame(PointCloud(measured_at=1, points=points, base_from_lidar=BASE_FROM_LIDAR))
    annotator.on_pose(Pose(measured_at=1, world_from_base=np.eye(4)))
    *labelled, summary = annotator.on_end()
    assert [len(outputs.labelled.label) for outputs in labelled] == [0, 12]
    assert summary["coverage"] == 0.0


def test_settings_that_cannot_be_are_named():
    with pytest.raises(ValueError, match=r"annotator.every wants at least 1; it was given 0"):
        Annotator(Annotator.Config(every=0))


@pytest.mark.slow
def test_known_points_that_a_session_saw_through_lose_their_place(tmp_path):
    cupboard = (np.array([0.2, 2.0, 0.0]), np.array([0.9, 2.6, 1.6]))
    pointmap = PointMap()
    for step in range(0, 40, 4):
        pose = place(step) @ BASE_FROM_LIDAR
        pointmap.enter(pointmap.prepare(scan(pose, boxes=(*BOXES, cupboard), noise=0.005, seed=step)), pose)
    save_map(tmp_path / "map.ply", pointmap.map.cloud())
    annotator = Annotator(Annotator.Config(map=tmp_path / "map.ply", trace_known=1, frustum_width=0.0122))
    drive(annotator)
    buffer = annotator.buffer.classified()
    top = (cupboard[0] + (0.0, 0.0, 0.3), cupboard[1])
    before = inside(pointmap.map.points, top).sum()
    assert before > 100
    assert inside(buffer.known.voxels.points, top).sum() < 0.2 * before
    gone = inside(buffer.new.points, top)
    assert (buffer.new.label[gone] == SHORT).mean() > 0.8
