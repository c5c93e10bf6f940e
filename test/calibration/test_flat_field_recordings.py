from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from thermal_stereo_vo.calibration.flat_field_recordings import (
    FlatRecording,
    join,
    read_flat_fields,
)
from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.core.frames import RawFrame, Telemetry
from thermal_stereo_vo.radiometry.flat_field_recorder import FlatFieldRecorder


@pytest.fixture
def image(rng: np.random.Generator) -> np.ndarray:
    return rng.integers(7000, 9000, (20, 30)).astype(np.uint16)


def write_raw(folder: Path, name: str, image: np.ndarray, celsius: str) -> None:
    header = np.array([0, image.shape[1], image.shape[0], 3, image.nbytes, 0], "<u4").tobytes()
    (folder / f"{name}.raw").write_bytes(header + image.astype("<u2").tobytes())
    (folder / f"{name}.txt").write_text(f"fpaSerial\t = 77\nfpaTemperatureC\t\t = {celsius}\n")


def test_raw_files_with_notes(tmp_path, image):
    write_raw(tmp_path, "a", image, "21.5")
    write_raw(tmp_path, "b", image + np.uint16(1), "-3")
    found = read_flat_fields(tmp_path)
    assert found.serial == "77"
    assert [frame.fpa_kelvin for frame in found.frames] == pytest.approx([294.65, 270.15])
    np.testing.assert_array_equal(found.frames[1].image, image + 1)


def test_images_with_notes(tmp_path, image):
    cv2.imwrite(str(tmp_path / "a.png"), image)
    (tmp_path / "a.txt").write_text("fpaTemperatureC = 20\nsourceTemperatureC = 35\n")
    (frame,) = read_flat_fields(tmp_path).frames
    np.testing.assert_array_equal(frame.image, image)
    assert frame.source_kelvin == pytest.approx(308.15)


def test_npz_files(tmp_path, image):
    stack = np.stack([image, image + np.uint16(5)])
    np.savez(
        tmp_path / "a.npz",
        frames=stack,
        fpa_kelvin=np.array([290.0, 291.0]),
        source_kelvin=300.0,
        serial="9",
        camera="right",
    )
    found = read_flat_fields(tmp_path / "a.npz")
    assert (found.serial, found.camera) == ("9", "right")
    assert [frame.fpa_kelvin for frame in found.frames] == [290.0, 291.0]
    assert [frame.source_kelvin for frame in found.frames] == [300.0, 300.0]


def test_what_the_recorder_writes_is_read(tmp_path, rng):
    recorder = FlatFieldRecorder(tmp_path / "new", "left", "55", frames=8)
    images = rng.integers(7990, 8010, (8, 20, 30)).astype(np.uint16)
    path = None
    for k, image in enumerate(images):
        assert recorder.missing == 8 - k
        telemetry = Telemetry(fpa_temperature_kelvin=300.0 + 0.01 * k)
        path = recorder.add(RawFrame(image, k + 1, "left", k, telemetry))
    assert path is not None
    assert [p.name for p in (tmp_path / "new").iterdir()] == [path.name]
    found = read_flat_fields(tmp_path / "new")
    assert (found.serial, found.camera) == ("55", "left")
    np.testing.assert_allclose(found.frames[0].image, images.mean(axis=0), rtol=1e-6)
    assert found.frames[0].fpa_kelvin == pytest.approx(300.035)
    assert found.frames[0].source_kelvin is None
    assert recorder.missing == 8, "ready for the next view"


def test_the_recorder_needs_the_temperature(tmp_path, image):
    recorder = FlatFieldRecorder(tmp_path, "left")
    with pytest.raises(CalibrationError, match="'left' tells no FPA temperature"):
        recorder.add(RawFrame(image, 1, "left"))


def test_the_recorder_refuses_another_size_and_a_folder_that_is_a_file(tmp_path, image):
    telemetry = Telemetry(fpa_temperature_kelvin=300.0)
    recorder = FlatFieldRecorder(tmp_path, "left")
    recorder.add(RawFrame(image, 1, "left", 0, telemetry))
    with pytest.raises(CalibrationError, match="changed its image size"):
        recorder.add(RawFrame(image[:5].copy(), 2, "left", 1, telemetry))
    (tmp_path / "file").write_text("")
    blocked = FlatFieldRecorder(tmp_path / "file", "left", frames=1)
    with pytest.raises(CalibrationError, match="cannot write the flat field"):
        blocked.add(RawFrame(image, 1, "left", 0, telemetry))


def test_a_source_temperature_fills_only_what_is_unknown(tmp_path, image):
    np.savez(tmp_path / "a.npz", frames=image, fpa_kelvin=290.0)
    np.savez(tmp_path / "b.npz", frames=image, fpa_kelvin=290.0, source_kelvin=320.0)
    found = read_flat_fields(tmp_path, source_kelvin=300.0)
    assert [frame.source_kelvin for frame in found.frames] == [300.0, 320.0]


@pytest.mark.parametrize(
    ("write", "match"),
    [
        (lambda p: None, "holds no flat field: it needs .npz files"),
        (lambda p: (p / "a.npz").write_bytes(b"PK\3\4 rubbish"), "a.npz is damaged"),
        (lambda p: np.savez(p / "a.npz", fpa_kelvin=3.0), "no array 'frames'"),
        (lambda p: np.savez(p / "a.npz", frames=np.ones((2, 2))), "no array 'fpa_kelvin'"),
        (
            lambda p: np.savez(p / "a.npz", frames=np.ones(3), fpa_kelvin=3.0),
            r"'frames' is \(3,\), not",
        ),
        (
            lambda p: np.savez(p / "a.npz", frames=np.ones((3, 2, 2)), fpa_kelvin=np.ones(2)),
            r"'fpa_kelvin' holds \(2,\) numbers for 3 frames",
        ),
        (
            lambda p: ((p / "a.raw").write_bytes(b"short"), (p / "a.txt").write_text("")),
            "a.raw is cut short or of an unknown kind",
        ),
        (
            lambda p: (
                cv2.imwrite(str(p / "a.png"), np.ones((4, 4), np.uint16)),
                (p / "a.txt").write_text("serial = 3"),
            ),
            "a.txt has no line 'fpaTemperatureC",
        ),
        (
            lambda p: (
                cv2.imwrite(str(p / "a.png"), np.ones((4, 4), np.uint16)),
                (p / "a.txt").write_text("fpaTemperatureC = warm"),
            ),
            "fpaTemperatureC = 'warm' is no number",
        ),
        (
            lambda p: (
                cv2.imwrite(str(p / "a.png"), np.ones((4, 4, 3), np.uint8)),
                (p / "a.txt").write_text("fpaTemperatureC = 3"),
            ),
            "a.png is no single-channel image",
        ),
    ],
)
def test_unusable_folders_say_why(tmp_path, write, match):
    write(tmp_path)
    with pytest.raises(CalibrationError, match=match):
        read_flat_fields(tmp_path)


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(CalibrationError, match="there is no recording"):
        read_flat_fields(tmp_path / "nowhere")


def test_frames_of_two_cameras_are_not_mixed(image):
    parts = [FlatRecording((), serial="1"), FlatRecording((), serial="2")]
    with pytest.raises(CalibrationError, match=r"several cameras \(serial 1, 2\)"):
        join(parts)
