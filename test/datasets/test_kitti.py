"""KITTI folders: stamps, poses and calibration belong to the right images."""

from __future__ import annotations

from datetime import UTC, datetime

import cv2
import numpy as np
import pytest

from thermal_stereo_vo.core.errors import CalibrationError, DatasetError
from thermal_stereo_vo.datasets.kitti import odometry_pair, raw_pair
from thermal_stereo_vo.datasets.registry import SourceOptions, open_dataset

from .conftest import P_LEFT, P_RIGHT


def frames(folder, **options):
    return list(open_dataset(folder, SourceOptions(**options))[0].frames())


def test_frames_come_pair_by_pair_with_exact_stamps(kitti_odometry):
    folder, images = kitti_odometry
    got = frames(folder)
    assert [frame.camera for frame in got] == ["left", "right"] * 4
    # 1.036224e-01 s and 0.2071 s are exact in nanoseconds.
    assert [f.stamp_ns for f in got[::2]] == [0, 103_622_400, 207_100_000, 310_804_000]
    assert [f.sequence for f in got[1::2]] == [0, 1, 2, 3]
    for frame in got:
        assert np.array_equal(frame.image, images[frame.camera][f"{frame.sequence:06d}.png"])
        assert not frame.image.flags.writeable


def test_sixteen_bit_counts_arrive_whole(kitti_odometry, save_images):
    folder, _ = kitti_odometry
    names = [f"{i:06d}.png" for i in range(4)]
    images = save_images(folder / "image_0", names, np.uint16)
    save_images(folder / "image_1", names, np.uint16)
    first = frames(folder)[0]
    assert first.image.dtype == np.uint16
    assert np.array_equal(first.image, images["000000.png"])


def test_ten_hertz_without_times_and_any_rate_on_demand(kitti_odometry):
    folder, _ = kitti_odometry
    (folder / "times.txt").unlink()
    assert [f.stamp_ns for f in frames(folder)[::2]] == [0, 10**8, 2 * 10**8, 3 * 10**8]
    assert frames(folder, rate_hz=30.0)[2].stamp_ns == 33_333_333


def test_a_dropped_image_keeps_the_stamps_of_the_others(kitti_odometry):
    folder, _ = kitti_odometry
    (folder / "image_1" / "000001.png").unlink()
    got = frames(folder)
    assert [(f.camera, f.sequence) for f in got[2:5]] == [("left", 1), ("left", 2), ("right", 2)]
    assert got[4].stamp_ns == 207_100_000


def test_truth_has_a_pose_for_each_left_image(kitti_odometry):
    folder, _ = kitti_odometry
    truth = open_dataset(folder)[0].ground_truth()
    assert truth.stamps_ns.tolist() == [0, 103_622_400, 207_100_000, 310_804_000]
    assert truth.positions_m[3].tolist() == pytest.approx([0.3, 0.0, 3.0])


def test_truth_of_a_part_keeps_its_rows(kitti_odometry):
    """Images 2 and 3 of a longer sequence: poses are found by frame number."""
    folder, _ = kitti_odometry
    for eye in ("image_0", "image_1"):
        for number in (0, 1):
            (folder / eye / f"{number:06d}.png").unlink()
    truth = open_dataset(folder)[0].ground_truth()
    assert truth.positions_m[:, 2].tolist() == [2.0, 3.0]


def test_calibration_takes_the_size_of_the_images(kitti_odometry):
    dataset, reason = open_dataset(kitti_odometry[0])
    calibration = dataset.calibration()
    assert calibration["left"].camera.size == (48, 32)
    assert calibration.baseline_m == pytest.approx(0.5)
    assert reason == "KITTI odometry sequence: it has image_0 and image_1"
    assert dataset.instants() == 4


def test_colour_sequence_uses_its_own_projections(kitti_odometry, rng):
    folder, _ = kitti_odometry
    colour = rng.integers(0, 255, (32, 48, 3), dtype=np.uint8)
    for old, new in (("image_0", "image_2"), ("image_1", "image_3")):
        (folder / old).rename(folder / new)
        for path in (folder / new).iterdir():
            cv2.imwrite(str(path), colour)
    with pytest.raises(CalibrationError, match="no projection matrix 'P2'"):
        open_dataset(folder)
    shifted = P_RIGHT.replace("-35.0", "-28.0")
    (folder / "calib.txt").write_text(f"P0: {P_LEFT}\nP1: {P_RIGHT}\nP2: {P_LEFT}\nP3: {shifted}\n")
    dataset, _ = open_dataset(folder)
    assert dataset.calibration().baseline_m == pytest.approx(0.4)
    grey = next(dataset.frames()).image
    assert np.array_equal(grey, cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY))


def test_given_calibration_wins(kitti_odometry, tmp_path):
    path = tmp_path / "other.txt"
    path.write_text(f"{P_LEFT}\n{P_RIGHT.replace('-35.0', '-7.0')}")
    dataset, _ = open_dataset(kitti_odometry[0], SourceOptions(calibration=path))
    assert dataset.calibration().baseline_m == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("name", "text", "complaint"),
    [
        ("times.txt", "0.0\n0.1\n", "has 2 lines, but there are 4 images up to number 3"),
        ("times.txt", "0.0\nsoon\n0.2\n0.3\n", r"times\.txt:2: 'soon' is no time in seconds"),
        ("times.txt", "0.0\n0.2\n0.1\n0.3\n", "'left' do not increase: 000002.png at 100000000 ns"),
        ("poses.txt", "1 2 3\n4 5 6\n", "has 3 numbers a row: poses need 12"),
        ("poses.txt", "a b\n", "is no pose file"),
    ],
)
def test_broken_lists_say_where(kitti_odometry, name, text, complaint):
    folder, _ = kitti_odometry
    (folder / name).write_text(text)
    with pytest.raises(DatasetError, match=complaint):
        open_dataset(folder)


def test_a_list_that_is_no_text(kitti_odometry):
    folder, _ = kitti_odometry
    (folder / "times.txt").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(DatasetError, match=r"cannot read .*times\.txt: 'utf-8' codec"):
        open_dataset(folder)


def test_swapped_eyes_are_told(kitti_odometry):
    folder, _ = kitti_odometry
    (folder / "calib.txt").write_text(f"P0: {P_RIGHT}\nP1: {P_LEFT}\n")
    with pytest.raises(CalibrationError, match=r"eyes of .* are swapped"):
        open_dataset(folder)


def test_zero_baseline_is_told(kitti_odometry):
    folder, _ = kitti_odometry
    (folder / "calib.txt").write_text(f"P0: {P_LEFT}\nP1: {P_LEFT}\n")
    with pytest.raises(CalibrationError, match=r"baseline of .* is 0.000 mm"):
        open_dataset(folder)


@pytest.fixture
def kitti_raw(tmp_path, save_images):
    """A drive below the folder of its date, with ``data`` folders and skewed stamps."""
    drive = tmp_path / "2011_09_26" / "2011_09_26_drive_0001_sync"
    names = [f"{i:010d}.png" for i in range(3)]
    for eye, fraction in (("image_00", "967790592"), ("image_01", "967791872")):
        save_images(drive / eye / "data", names)
        stamps = [f"2011-09-26 13:02:{25 + i}.{fraction}" for i in range(3)]
        (drive / eye / "timestamps.txt").write_text("\n".join(stamps) + "\n")
    (drive.parent / "calib_cam_to_cam.txt").write_text(
        f"S_rect_00: 48 32\nP_rect_00: {P_LEFT}\nS_rect_01: 48 32\nP_rect_01: {P_RIGHT}\n"
    )
    return drive


def test_raw_drive_with_calibration_of_the_day(kitti_raw):
    dataset, reason = open_dataset(kitti_raw)
    got = list(dataset.frames())
    second = int(datetime(2011, 9, 26, 13, 2, 25, tzinfo=UTC).timestamp())
    assert got[0].stamp_ns == second * 10**9 + 967_790_592
    assert got[1].stamp_ns - got[0].stamp_ns == 1280
    assert [f.camera for f in got] == ["left", "right"] * 3
    assert dataset.calibration().baseline_m == pytest.approx(0.5)
    assert dataset.ground_truth() is None
    assert "KITTI raw" in reason


def test_raw_stamps_that_are_no_dates(kitti_raw):
    (kitti_raw / "image_00" / "timestamps.txt").write_text("2011-09-26\n\n")
    with pytest.raises(DatasetError, match=r"timestamps\.txt:1: '2011-09-26' is no date and time"):
        open_dataset(kitti_raw)


def test_half_a_pair_is_no_kitti(tmp_path, save_images):
    save_images(tmp_path / "image_0", ["000000.png"])
    assert odometry_pair(tmp_path) is None
    assert raw_pair(tmp_path) is None


def test_real_sequences(recording):
    dataset, _ = open_dataset(recording("kitti_residential"))
    truth = dataset.ground_truth()
    assert dataset.instants() == len(truth) == 51
    assert 55.0 < truth.path_lengths_m[-1] < 65.0
    assert next(dataset.frames()).image.shape == (370, 1226)
    raw, _ = open_dataset(recording("kitti_raw_0001"))
    stamps = [frame.stamp_ns for frame in raw.frames()]
    assert len(stamps) == 80
    assert stamps == sorted(stamps)
