"""The points of a visible and a thermal camera as a map and in pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermal_stereo_vo.core.cameras import Camera
from thermal_stereo_vo.core.frames import CameraView, RigFrame
from thermal_stereo_vo.core.results import OdometryResult, PointCloud, TrackingStatus, TrackStats
from thermal_stereo_vo.core.transforms import exp_se3, make_transform
from thermal_stereo_vo.outputs.map_file import MapFile, thinned, two_band_colours
from thermal_stereo_vo.outputs.point_cloud_file import read_ply
from thermal_stereo_vo.outputs.snapshot import Snapshot, draw_depths, draw_points

CAMERA = Camera(96, 64, 80.0, 80.0, 47.5, 31.5)
T_RIG_THERMAL = make_transform(np.eye(3), [0.5, 0.0, 0.0])
KEYFRAME = TrackStats(keyframe=True)


def frame(stamp_ns: int = 1) -> RigFrame:
    visible = CameraView(np.full((64, 96), 90, np.uint8), CAMERA)
    counts = np.random.default_rng(2).integers(7000, 7400, (64, 96)).astype(np.uint16)
    thermal = CameraView(counts, CAMERA, T_RIG_THERMAL.copy())
    return RigFrame(stamp_ns, {"visible": visible, "thermal": thermal})


def result(stamp_ns=1, *, keyframe=True, metric=True, pose=None) -> OdometryResult:
    stats = KEYFRAME if keyframe else TrackStats()
    pose = np.eye(4) if pose is None else pose
    return OdometryResult(
        stamp_ns, TrackingStatus.TRACKING, pose, np.eye(6), stats=stats, scale_converged=metric
    )


def cloud_of(*points) -> PointCloud:
    n = len(points)
    return PointCloud(
        np.array(points, np.float32).reshape(n, 3),
        np.arange(n, dtype=np.float32),
        thermal_counts=7000 + np.arange(n, dtype=np.float32),
    )


def written(tmp_path, *heard) -> PointCloud:
    file = MapFile(tmp_path / "map.ply")
    for spoken, cloud in heard:
        file.on_result(spoken)
        file.on_points(spoken.stamp_ns, cloud)
    file.close()
    return read_ply(tmp_path / "map.ply")


def test_the_map_holds_the_points_of_all_keyframes(tmp_path):
    found = written(
        tmp_path,
        (result(), cloud_of([1, 2, 3], [4, 5, 6])),
        (result(2, keyframe=False), cloud_of([7, 7, 7])),
        (result(3), cloud_of([8, 9, 10])),
    )
    assert found.xyz.tolist() == [[1, 2, 3], [4, 5, 6], [8, 9, 10]]
    assert found.intensity.tolist() == [0, 1, 0]
    assert found.thermal_counts.tolist() == [7000, 7001, 7000]


def test_of_points_at_one_place_the_last_stays(tmp_path):
    far = [100, 0, 0]
    later = replace(cloud_of([1.001, 2, 3]), intensity=np.array([55], np.float32))
    found = written(tmp_path, (result(), cloud_of([1, 2, 3], far)), (result(2), later))
    assert len(found.xyz) == 2
    assert sorted(found.intensity.tolist()) == [1, 55]


def test_the_map_begins_anew_with_metres(tmp_path):
    found = written(
        tmp_path,
        (result(metric=False), cloud_of([1, 2, 3])),
        (result(2), cloud_of([4, 5, 6])),
    )
    assert found.xyz.tolist() == [[4, 5, 6]]


def test_metres_stay_while_the_scale_is_lost_and_found_again(tmp_path):
    found = written(
        tmp_path,
        (result(metric=False), cloud_of([9, 9, 9])),
        (result(2), cloud_of([1, 2, 3])),
        (result(3, metric=False), cloud_of([50, 60, 70])),
        (result(4), cloud_of([4, 5, 6])),
    )
    assert found.xyz.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_what_has_no_unit_at_the_end_does_not_stand_beside_metres(tmp_path):
    found = written(
        tmp_path,
        (result(), cloud_of([1, 2, 3])),
        (result(2, metric=False), cloud_of([50, 60, 70])),
    )
    assert found.xyz.tolist() == [[1, 2, 3]]


def test_a_map_that_never_had_metres_is_written_whole(tmp_path):
    found = written(
        tmp_path,
        (result(metric=False), cloud_of([1, 2, 3])),
        (result(2, metric=False), cloud_of([4, 5, 6])),
    )
    assert found.xyz.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_a_method_of_one_band_writes_no_map(tmp_path):
    file = MapFile(tmp_path / "map.ply")
    file.on_result(result())
    file.on_points(1, replace(cloud_of([1, 2, 3]), thermal_counts=None))
    file.close()
    assert list(tmp_path.iterdir()) == []


def test_thinning_keeps_the_extent():
    rng = np.random.default_rng(1)
    dense = PointCloud(
        np.concatenate([rng.normal(0, 1e-5, (500, 3)), rng.uniform(0, 10, (300, 3))]).astype("f4"),
        np.zeros(800, np.float32),
        thermal_counts=np.zeros(800, np.float32),
    )
    kept = thinned(dense)
    assert 295 < len(kept.xyz) < 320
    assert np.ptp(kept.xyz[:, 0]) == pytest.approx(np.ptp(dense.xyz[:, 0]), abs=0.02)


def test_colours_tell_the_bands_apart():
    cloud = PointCloud(
        np.zeros((4, 3), np.float32),
        np.array([0, 255, np.nan, 100], np.float32),
        thermal_counts=np.array([9000, 7000, 8000, np.nan], np.float32),
    )
    rgb = two_band_colours(cloud)
    assert rgb[0].tolist() == [255, 0, 0]
    assert rgb[1].tolist() == [0, 255, 255]
    assert rgb[2, 1] == rgb[3, 0] == 0


def test_depths_are_drawn_where_the_camera_sees_the_points():
    """In either camera, near points warm and far ones cold."""
    T_world_rig = exp_se3([1.0, 2.0, 3.0, 0.1, -0.2, 0.3])
    in_rig = np.array([[0.0, 0.0, 2.0], [1.0, 0.0, 8.0], [0.0, 0.0, -2.0]])
    in_world = in_rig @ T_world_rig[:3, :3].T + T_world_rig[:3, 3]
    cloud = cloud_of(*in_world)
    seen = replace(frame())
    for role, shift_m in (("visible", 0.0), ("thermal", 0.5)):
        view = replace(seen.views[role], display=np.full((64, 96), 60, np.uint8))
        picture = draw_depths(RigFrame(1, {role: view}), role, T_world_rig, cloud).astype(int)
        near = CAMERA.project(in_rig[:1] - [shift_m, 0, 0])[0]
        far = CAMERA.project(in_rig[1:2] - [shift_m, 0, 0])[0]
        blue, _, red = picture[round(near[1]), round(near[0])]
        assert red > blue + 50
        blue, _, red = picture[round(far[1]), round(far[0])]
        assert blue > red
        assert np.ptp(picture[2, 2]) == 0


def test_snapshot_keeps_the_depth_maps_of_both_cameras():
    snapshot = Snapshot(1)
    snapshot.on_rig_frame(frame())
    snapshot.on_result(result())
    snapshot.on_points(1, cloud_of([0, 0, 2], [0.2, 0.1, 3]))
    assert set(snapshot.depth_maps) == {"visible", "thermal"}
    assert all(picture.shape == (64, 96, 3) for picture in snapshot.depth_maps.values())
    assert all(np.ptp(picture, axis=2).max() > 60 for picture in snapshot.depth_maps.values())


def test_no_picture_of_points_without_its_camera():
    alone = replace(frame(), views={"thermal": frame().views["thermal"]})
    assert draw_points(alone, ("visible", "thermal"), np.eye(4), cloud_of([0, 0, 2])) is None
    assert draw_points(alone, ("left", "right"), np.eye(4), cloud_of([0, 0, 2])) is None
