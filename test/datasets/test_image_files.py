"""Image folders and single files: what is read exactly, what is refused and how."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from thermal_stereo_vo.core.calibration_files import save_calibration
from thermal_stereo_vo.core.cameras import Camera, RigCalibration, RigCamera
from thermal_stereo_vo.core.errors import DatasetError
from thermal_stereo_vo.core.transforms import make_transform
from thermal_stereo_vo.datasets.image_files import read_grey
from thermal_stereo_vo.datasets.registry import SourceOptions, open_dataset, require_calibration

NAMES = ["1700000000100000000.png", "1700000000200000000.png"]


@pytest.fixture
def pair(tmp_path, save_images):
    folder = tmp_path / "pair"
    for eye in ("left", "right"):
        save_images(folder / eye, NAMES, np.uint16)
    return folder


def test_fourteen_bits_stay_fourteen_bits(tmp_path):
    ramp = np.arange(300, dtype=np.uint16).reshape(1, -1) + 8000
    path = tmp_path / "ramp.png"
    cv2.imwrite(str(path), np.repeat(ramp, 4, axis=0))
    image = read_grey(path)
    assert image.dtype == np.uint16
    assert len(np.unique(image)) == 300


def test_pgm_and_tiff_are_read_as_stored(tmp_path, rng):
    image = rng.integers(0, 65535, (20, 30), dtype=np.uint16)
    for name in ("a.pgm", "a.tiff"):
        cv2.imwrite(str(tmp_path / name), image)
        assert np.array_equal(read_grey(tmp_path / name), image)


@pytest.mark.parametrize("channels", [3, 4])
def test_eight_bit_colour_becomes_grey(tmp_path, rng, channels):
    colour = rng.integers(0, 255, (20, 30, channels), dtype=np.uint8)
    colour[..., 3:] = 255
    cv2.imwrite(str(tmp_path / "c.png"), colour)
    weighted = colour[..., :3] @ np.array([0.114, 0.587, 0.299])  # ITU-R BT.601, stored as BGR
    assert np.abs(read_grey(tmp_path / "c.png") - weighted).max() <= 1.0


def test_sixteen_bit_colour_is_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "c.png"), np.zeros((4, 4, 3), np.uint16))
    with pytest.raises(DatasetError, match="has 3 channels of 16 bit: give single-channel"):
        read_grey(tmp_path / "c.png")


def test_float_images_are_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "f.tiff"), np.zeros((4, 4), np.float32))
    with pytest.raises(DatasetError, match="holds float32 pixels: convert it"):
        read_grey(tmp_path / "f.tiff")


@pytest.mark.parametrize("keep", [0, 30, 0.5, 0.99])
def test_a_damaged_image_is_named(tmp_path, rng, keep, capfd):
    path = tmp_path / "cut.png"
    cv2.imwrite(str(path), rng.integers(0, 255, (40, 60), dtype=np.uint8))
    data = path.read_bytes()
    path.write_bytes(data[: keep if isinstance(keep, int) else int(keep * len(data))])
    with pytest.raises(DatasetError, match=r"cut\.png is no readable image \(\d+ bytes\)"):
        read_grey(path)
    assert capfd.readouterr().err == ""


def test_stamps_from_names_in_nanoseconds(pair):
    dataset, reason = open_dataset(pair)
    assert [f.stamp_ns for f in dataset.frames()][::2] == [int(name[:-4]) for name in NAMES]
    assert reason == "pair of image folders: it has left and right"
    assert dataset.cameras == ("left", "right")


def test_stamps_from_names_in_seconds(pair):
    for eye in ("left", "right"):
        (pair / eye / NAMES[0]).rename(pair / eye / "1700000000.1.png")
        (pair / eye / NAMES[1]).rename(pair / eye / "1700000000.200000001.png")
    stamps = [f.stamp_ns for f in open_dataset(pair)[0].frames()][::2]
    assert stamps == [1700000000_100000000, 1700000000_200000001]


def test_numbered_images_need_a_rate(pair, save_images):
    for eye in ("left", "right"):
        for name in NAMES:
            (pair / eye / name).unlink()
        save_images(pair / eye, ["0001.png", "0002.png", "0010.png"])
    with pytest.raises(DatasetError, match=r"0001\.png is not named by a stamp .* with --rate"):
        open_dataset(pair)
    dataset, _ = open_dataset(pair, SourceOptions(rate_hz=20.0))
    assert [f.stamp_ns for f in dataset.frames()][::2] == [0, 50_000_000, 100_000_000]


@pytest.mark.parametrize(
    ("option", "value"), [("rate_hz", 0.0), ("rate_hz", -1.0), ("length_m", float("nan"))]
)
def test_wishes_must_be_positive(option, value):
    name = option.partition("_")[0]
    with pytest.raises(DatasetError, match=f"--{name} must be positive, got {value}"):
        SourceOptions(**{option: value})


def test_frames_can_be_asked_for_twice(pair):
    dataset, _ = open_dataset(pair)
    first, second = (
        [(f.stamp_ns, f.camera, f.image.tobytes()) for f in dataset.frames()] for _ in range(2)
    )
    assert first == second


def test_images_are_decoded_only_when_asked_for(pair):
    """A damaged last image must not hinder the first: nothing is read ahead of need."""
    dataset, _ = open_dataset(pair)
    (pair / "right" / NAMES[1]).write_bytes(b"")
    frames = dataset.frames()
    assert [next(frames).camera for _ in range(3)] == ["left", "right", "left"]
    with pytest.raises(DatasetError, match="no readable image"):
        next(frames)


def test_eyes_of_different_size_are_refused(pair, save_images):
    save_images(pair / "right", NAMES, np.uint16, size=(24, 32))
    with pytest.raises(DatasetError, match="left is 48x32 and right is 24x32 pixels"):
        open_dataset(pair)


def test_a_size_that_changes_on_the_way_is_refused(pair, save_images):
    save_images(pair / "left", NAMES[1:], np.uint16, size=(24, 32))
    with pytest.raises(DatasetError, match="is 24x32 pixels, but the recording began with 48x32"):
        list(open_dataset(pair)[0].frames())


def test_empty_eye_is_refused(pair):
    for path in (pair / "right").iterdir():
        path.unlink()
    with pytest.raises(
        DatasetError, match=r"right holds no images: looked for files ending in .png"
    ):
        open_dataset(pair)


def test_missing_calibration_names_the_option(pair):
    dataset, _ = open_dataset(pair)
    assert dataset.calibration() is None
    with pytest.raises(DatasetError, match="'pair' brings no calibration: give one with --calib"):
        require_calibration(dataset)


def test_calibration_beside_the_folders_is_found(pair):
    camera = Camera(48, 32, 70.0, 70.0, 24.0, 16.0)
    rig = RigCalibration(
        {
            "left": RigCamera(camera),
            "right": RigCamera(camera, make_transform(np.eye(3), [0.3, 0.0, 0.0])),
        },
        rectified=True,
    )
    save_calibration(rig, pair)
    dataset, _ = open_dataset(pair)
    assert require_calibration(dataset).baseline_m == pytest.approx(0.3)
