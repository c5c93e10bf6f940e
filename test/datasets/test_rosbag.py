"""Bags of ROS 1 and ROS 2: every byte of every image, in order, and every refusal in words."""

from __future__ import annotations

import tracemalloc

import cv2
import numpy as np
import pytest

from thermal_stereo_vo.core.errors import CalibrationError, DatasetError
from thermal_stereo_vo.core.frames import FfcState, Telemetry
from thermal_stereo_vo.core.transforms import exp_so3, make_transform, quat_xyzw_from_rotation
from thermal_stereo_vo.datasets.registry import SourceOptions, open_dataset, require_calibration
from thermal_stereo_vo.outputs.ros_fields import telemetry_fields

from .bags import KINDS, bag_path, scribe

START = 1_700_000_000_123_456_789
MS = 1_000_000
K = (70.0, 0.0, 24.0, 0.0, 71.0, 16.0, 0.0, 0.0, 1.0)
K_RECT = (70.0, 0.0, 24.0, 0.0, 70.0, 16.0, 0.0, 0.0, 1.0)
D = (-0.3, 0.1, 0.001, -0.001, 0.0)
P_LEFT = (70.0, 0.0, 24.0, 0.0, 0.0, 70.0, 16.0, 0.0, 0.0, 0.0, 1.0, 0.0)
P_RIGHT = (70.0, 0.0, 24.0, -21.0, 0.0, 70.0, 16.0, 0.0, 0.0, 0.0, 1.0, 0.0)


def noise(rng, dtype=np.uint16, shape=(32, 48)):
    return rng.integers(0, np.iinfo(dtype).max, shape, dtype=dtype, endpoint=True)


def write_pairs(out, rng, count=4, left="/left/image_raw", right="/right/image_raw", **kwargs):
    """``count`` pairs, the right eye 1 ms later; returns the images in order of stamp."""
    images = []
    for i in range(count):
        for offset, topic in ((0, left), (MS, right)):
            image = noise(rng)
            out.image(topic, START + i * 33 * MS + offset, image, **kwargs)
            images.append(image)
    return images


def write_infos(out, *, k=K, d=D, p_right=P_RIGHT, base="/"):
    out.camera_info(f"{base}left/camera_info", START, k=k, d=d, p=P_LEFT)
    out.camera_info(f"{base}right/camera_info", START, k=k, d=d, p=p_right)


@pytest.fixture
def mcap(tmp_path):
    """``with mcap() as out`` writes a bag, ``mcap.path`` is where."""

    def start():
        return scribe("mcap", tmp_path / "flight")

    start.path = tmp_path / "flight"
    return start


@pytest.mark.parametrize("kind", KINDS)
def test_every_byte_comes_back_in_order(kind, tmp_path, rng):
    with scribe(kind, tmp_path / "flight") as out:
        images = write_pairs(out, rng)
        write_infos(out)
    dataset, reason = open_dataset(bag_path(kind, tmp_path / "flight"))
    got = list(dataset.frames())
    assert reason.startswith("ROS 1 bag" if kind == "ros1" else "ROS 2 bag")
    assert dataset.instants() == 4
    assert [f.camera for f in got] == ["left", "right"] * 4
    assert [f.stamp_ns for f in got[:3]] == [START, START + MS, START + 33 * MS]
    assert [f.sequence for f in got[::2]] == [0, 1, 2, 3]
    for frame, image in zip(got, images, strict=True):
        assert frame.image.dtype == np.uint16
        assert np.array_equal(frame.image, image)
    calibration = require_calibration(dataset)
    assert calibration.baseline_m == pytest.approx(0.3)
    assert not calibration.rectified
    assert calibration["left"].camera.distortion == D


@pytest.mark.parametrize(
    ("kind", "suffix"), [("sqlite3", ".db3"), ("mcap", ".mcap"), ("mcap_zstd", ".mcap")]
)
def test_the_file_inside_the_folder_will_do(kind, suffix, tmp_path, rng):
    with scribe(kind, tmp_path / "flight") as out:
        images = write_pairs(out, rng)
    file = next((tmp_path / "flight").glob(f"*{suffix}"))
    (tmp_path / "flight" / "metadata.yaml").unlink()
    for path in (file, tmp_path / "flight"):
        got = [frame.image for frame in open_dataset(path)[0].frames()]
        assert all(np.array_equal(a, b) for a, b in zip(got, images, strict=True))


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_a_folder_that_is_called_like_a_bag_of_ros_1(kind, tmp_path, rng):
    with scribe(kind, tmp_path / "flight") as out:
        images = write_pairs(out, rng)
    folder = (tmp_path / "flight").rename(tmp_path / "flight.bag")
    dataset, reason = open_dataset(folder)
    assert reason.startswith("ROS 2 bag")
    for frame, image in zip(dataset.frames(), images, strict=True):
        np.testing.assert_array_equal(frame.image, image)


def test_recorder_that_swaps_and_delays_messages(mcap, rng):
    """Order of recording is not order of exposure: the right eye arrives 100 ms late."""
    with mcap() as out:
        for i in range(6):
            stamp = START + i * 33 * MS
            out.image("/left/image_raw", stamp, noise(rng), log_ns=stamp + 5 * MS)
            out.image("/right/image_raw", stamp, noise(rng), log_ns=stamp + 100 * MS)
    got = list(open_dataset(mcap.path)[0].frames())
    assert [f.camera for f in got] == ["left", "right"] * 6
    assert [f.stamp_ns for f in got] == sorted(f.stamp_ns for f in got)


def test_step_and_byte_order_are_honoured(mcap, rng):
    with mcap() as out:
        images = write_pairs(out, rng, padding=6, big=True)
    got = [frame.image for frame in open_dataset(mcap.path)[0].frames()]
    assert all(np.array_equal(a, b) for a, b in zip(got, images, strict=True))


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "rgba8", "bgra8"])
def test_colour_becomes_grey(mcap, rng, encoding):
    shape = (32, 48, 4 if "a8" in encoding else 3)
    with mcap() as out:
        for topic in ("/left/image_raw", "/right/image_raw"):
            colour = noise(rng, np.uint8, shape)
            out.image(topic, START, colour, encoding=encoding)
    code = getattr(cv2, f"COLOR_{encoding[:-1].upper()}2GRAY")
    last = list(open_dataset(mcap.path)[0].frames())[-1].image
    assert np.array_equal(last, cv2.cvtColor(colour, code))


@pytest.mark.parametrize(("suffix", "dtype"), [(".png", np.uint16), (".jpg", np.uint8)])
def test_compressed_images(mcap, rng, suffix, dtype):
    image = noise(rng, dtype)
    data = cv2.imencode(suffix, image)[1].reshape(-1)
    with mcap() as out:
        for eye in ("left", "right"):
            out.compressed(f"/{eye}/image_raw/compressed", START, data, suffix[1:])
    first = next(open_dataset(mcap.path)[0].frames()).image
    assert first.dtype == dtype
    assert np.array_equal(first, cv2.imdecode(data, cv2.IMREAD_UNCHANGED))


def test_driver_without_stamps_falls_back_to_recording_time(mcap, rng):
    with mcap() as out:
        for i in range(2):
            for topic in ("/left/image_raw", "/right/image_raw"):
                out.image(topic, 0, noise(rng), log_ns=START + i * MS)
    assert [f.stamp_ns for f in open_dataset(mcap.path)[0].frames()] == [
        START,
        START,
        START + MS,
        START + MS,
    ]


def test_frames_can_be_asked_for_twice_and_at_once(mcap, rng):
    with mcap() as out:
        images = write_pairs(out, rng)
    dataset, _ = open_dataset(mcap.path)
    for a, b, image in zip(dataset.frames(), dataset.frames(), images, strict=True):
        assert np.array_equal(a.image, image)
        assert np.array_equal(b.image, image)


def test_other_topics_may_be_named(mcap, rng):
    with mcap() as out:
        write_pairs(out, rng)
        images = write_pairs(out, rng, left="/front/a", right="/front/b")
    options = SourceOptions(left_topic="/front/a", right_topic="/front/b")
    got = [frame.image for frame in open_dataset(mcap.path, options)[0].frames()]
    assert all(np.array_equal(a, b) for a, b in zip(got, images, strict=True))


# --- calibration ------------------------------------------------------------------------------


def test_rectified_topics_obey_P(mcap, rng):
    with mcap() as out:
        write_pairs(out, rng, left="/left/image_rect", right="/right/image_rect")
        write_infos(out)
    calibration = require_calibration(open_dataset(mcap.path)[0])
    assert calibration.rectified
    assert calibration["left"].camera.fy == 70.0
    assert not calibration["left"].camera.has_distortion


def test_plain_pinholes_count_as_rectified(mcap, rng):
    with mcap() as out:
        write_pairs(out, rng)
        write_infos(out, k=K_RECT, d=(0.0,) * 5)
    assert require_calibration(open_dataset(mcap.path)[0]).rectified


def test_uncalibrated_cameras_need_the_option(mcap, rng, tmp_path):
    with mcap() as out:
        write_pairs(out, rng)
        write_infos(out, k=(0.0,) * 9)
    with pytest.raises(DatasetError, match="brings no calibration: give one with --calibration"):
        require_calibration(open_dataset(mcap.path)[0])
    kitti = tmp_path / "calib.txt"
    kitti.write_text("\n".join(" ".join(map(str, P)) for P in (P_LEFT, P_RIGHT)))
    dataset, _ = open_dataset(mcap.path, SourceOptions(calibration=kitti))
    calibration = require_calibration(dataset)
    assert calibration["left"].camera.size == (48, 32)
    assert calibration.rectified


@pytest.mark.parametrize(
    ("p_right", "text"),
    [
        (P_LEFT, r"baseline of camera_info of .* is 0\.000 mm"),
        ((*P_LEFT[:3], 21.0, *P_LEFT[4:]), "eyes of camera_info of .*are swapped: the right cam"),
    ],
)
def test_impossible_eyes_are_told(mcap, rng, p_right, text):
    with mcap() as out:
        write_pairs(out, rng)
        write_infos(out, p_right=p_right)
    with pytest.raises(CalibrationError, match=text):
        open_dataset(mcap.path)


# --- truth and telemetry ------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["odometry", "pose"])
def test_truth_of_base_link_becomes_that_of_the_rig(mcap, rng, kind):
    """base_link flies 2 m ahead and turns left: the camera moves along its z and yaws about -y."""
    T = make_transform(exp_so3([0.0, 0.0, 0.3]), [2.0, 0.0, 0.5])
    quat = quat_xyzw_from_rotation(T[:3, :3])
    with mcap() as out:
        write_pairs(out, rng)
        if kind == "pose":
            out.pose_stamped("/ground_truth/pose", START, T[:3, 3], quat)
        else:
            out.odometry("/ground_truth", START, T[:3, 3], quat, "base_link")
    truth = open_dataset(mcap.path)[0].ground_truth()
    assert truth.stamps_ns.tolist() == [START]
    assert np.allclose(truth.positions_m[0], [0.0, -0.5, 2.0])
    assert np.allclose(truth.T_world_rig[0, :3, :3], exp_so3([0.0, -0.3, 0.0]))


@pytest.mark.parametrize("child", ["rig", "left_camera_optical"])
def test_truth_of_an_optical_frame_is_taken_as_it_is(mcap, rng, child):
    T = make_transform(exp_so3([0.1, 0.2, 0.3]), [1.0, 2.0, 3.0])
    with mcap() as out:
        write_pairs(out, rng)
        out.odometry("/gt", START, T[:3, 3], quat_xyzw_from_rotation(T[:3, :3]), child)
    options = SourceOptions(ground_truth_topic="/gt")
    assert open_dataset(mcap.path)[0].ground_truth() is None
    truth = open_dataset(mcap.path, options)[0].ground_truth()
    assert np.allclose(truth.T_world_rig[0], T, atol=1e-12)


@pytest.mark.parametrize(
    ("poses", "text"),
    [
        ([(START, (0, 0, 0), (0, 0, 0, 0))], "a pose of /ground_truth has no rotation"),
        ([(START, (np.nan, 0, 0), (0, 0, 0, 1))], "has no rotation or is not finite"),
        (
            [(START + 5, (0, 0, 0), (0, 0, 0, 1)), (START, (0, 0, 0), (0, 0, 0, 1))],
            "true poses of /ground_truth in .* stamps must increase strictly",
        ),
    ],
)
def test_useless_truth_is_refused(mcap, rng, poses, text):
    with mcap() as out:
        write_pairs(out, rng)
        for i, (stamp, position, quat) in enumerate(poses):
            zero = out.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
            out.write(
                "/ground_truth",
                START + i,
                "nav_msgs/msg/Odometry",
                header=out.header(stamp),
                child_frame_id="base_link",
                pose=out.make(
                    "geometry_msgs/msg/PoseWithCovariance",
                    pose=out.pose(map(float, position), map(float, quat)),
                    covariance=np.zeros(36),
                ),
                twist=out.make(
                    "geometry_msgs/msg/TwistWithCovariance",
                    twist=out.make("geometry_msgs/msg/Twist", linear=zero, angular=zero),
                    covariance=np.zeros(36),
                ),
            )
    with pytest.raises(DatasetError, match=text):
        open_dataset(mcap.path)[0].ground_truth()


def test_telemetry_joins_its_own_image(mcap, rng):
    full = Telemetry(301.5, 299.0, FfcState.COMPLETE, 17, 500_000_000)
    values = dict(telemetry_fields(0, "left", full).values)
    with mcap() as out:
        write_pairs(out, rng)
        # Beside the second left image; logged later than the image, as real drivers do.
        out.diagnostics("/left/status", START + 33 * MS, "left", values)
        out.diagnostics("/diagnostics", START + 1, "cpu", {"load": "0.3"})
    left = [f.telemetry for f in open_dataset(mcap.path)[0].frames() if f.camera == "left"]
    right = [f.telemetry for f in open_dataset(mcap.path)[0].frames() if f.camera == "right"]
    assert left[:2] == [None, full]
    # Later images know the temperatures, but not a counter that has gone on since.
    assert left[2] == Telemetry(301.5, 299.0)
    assert right == [None] * 4


# --- refusals -----------------------------------------------------------------------------------


def test_wrong_topic_lists_what_is_there(mcap, rng):
    with mcap() as out:
        write_pairs(out, rng)
        out.pose_stamped("/pose", START, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    with pytest.raises(
        DatasetError,
        match=r"no image topic '/x' \(image topics there: /left/image_raw, /right/image_raw\)",
    ):
        open_dataset(mcap.path, SourceOptions(left_topic="/x"))


def test_bag_without_images(mcap):
    with mcap() as out:
        out.pose_stamped("/pose", START, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    with pytest.raises(DatasetError, match=r"no pair of image topics .*there: none"):
        open_dataset(mcap.path)


def test_eyes_of_different_size(mcap, rng):
    with mcap() as out:
        out.image("/left/image_raw", START, noise(rng))
        out.image("/right/image_raw", START, noise(rng, shape=(32, 40)))
    with pytest.raises(
        DatasetError, match="/left/image_raw is 48x32 and /right/image_raw is 40x32 pixels"
    ):
        open_dataset(mcap.path)


def test_a_size_that_changes_on_the_way(mcap, rng):
    with mcap() as out:
        write_pairs(out, rng)
        out.image("/left/image_raw", START + 1000 * MS, noise(rng, shape=(64, 48)))
    dataset, _ = open_dataset(mcap.path)
    with pytest.raises(DatasetError, match="image 4 of /left/image_raw is 48x64 pixels, but"):
        list(dataset.frames())


@pytest.mark.parametrize("step_ns", [0, -5 * MS])
def test_stamps_that_do_not_increase(mcap, rng, step_ns):
    with mcap() as out:
        write_pairs(out, rng)
        last = START + 3 * 33 * MS
        out.image("/left/image_raw", last + step_ns, noise(rng), log_ns=last + 10 * MS)
    dataset, _ = open_dataset(mcap.path)
    with pytest.raises(DatasetError, match=f"do not increase: image 4 at {last + step_ns} ns"):
        list(dataset.frames())


@pytest.mark.parametrize("encoding", ["rgb16", "32FC1"])
def test_encodings_without_counts(mcap, rng, encoding):
    with mcap() as out:
        for topic in ("/left/image_raw", "/right/image_raw"):
            out.image(topic, START, noise(rng, shape=(32, 48, 3)), encoding=encoding)
    with pytest.raises(
        DatasetError, match=f"images of /left/image_raw have the encoding '{encoding}'"
    ):
        open_dataset(mcap.path)


def test_damaged_compressed_image(mcap):
    with mcap() as out:
        for eye in ("left", "right"):
            out.compressed(f"/{eye}/image/compressed", START, np.zeros(9, np.uint8), "png")
    with pytest.raises(DatasetError, match="an image of /left/image/compressed is no readable"):
        open_dataset(mcap.path)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("keep", [0.0, 0.02, 0.5, 0.98])
def test_a_truncated_bag_is_one_sentence(kind, keep, tmp_path, rng):
    with scribe(kind, tmp_path / "flight") as out:
        write_pairs(out, rng, count=60)
    path = bag_path(kind, tmp_path / "flight")
    storage = path if path.is_file() else next(p for p in path.iterdir() if p.suffix != ".yaml")
    data = storage.read_bytes()
    storage.write_bytes(data[: int(keep * len(data))])
    with pytest.raises(
        DatasetError, match=r"the bag .*flight.* cannot be read \(.+\): it is damaged or was cut"
    ) as caught:
        for _ in open_dataset(path)[0].frames():
            pass
    assert "\n" not in str(caught.value)


def test_folder_that_lost_its_storage(mcap, rng):
    with mcap() as out:
        write_pairs(out, rng)
    next(mcap.path.glob("*.mcap")).unlink()
    with pytest.raises(DatasetError, match=r"cannot be read .*missing"):
        open_dataset(mcap.path)


def test_memory_does_not_grow_with_the_bag(mcap, rng):
    """A recording of minutes must not be held at once."""
    image = noise(rng, shape=(256, 320))
    with mcap() as out:
        for i in range(100):
            for topic in ("/left/image_raw", "/right/image_raw"):
                out.image(topic, START + i * 33 * MS, image)
    assert sum(p.stat().st_size for p in mcap.path.iterdir()) > 32e6
    dataset, _ = open_dataset(mcap.path)
    tracemalloc.start()
    count = sum(1 for _ in dataset.frames())
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert count == 200
    # Two readers hold a few chunks of 1 MB each, as bytes and as messages.
    assert peak < 16e6
