"""A recording in place of the cameras, from the settings to the topics."""

from __future__ import annotations

from itertools import islice, pairwise

import cv2
import numpy as np
import pytest

from thermal_stereo_vo.capture.fake import FakeConfig
from thermal_stereo_vo.core.camera_info import CameraInfoFields
from thermal_stereo_vo.core.errors import DatasetError
from thermal_stereo_vo.outputs.bag_writer import BagWriter
from thermal_stereo_vo.outputs.ros_fields import ERROR
from thermal_stereo_vo.stereo_capture import StereoCaptureConfig, open_stereo_capture

EYES = ("left", "right")
SIZE = (48, 64)


@pytest.fixture
def images(rng):
    return {eye: rng.integers(0, 2**14, (6, *SIZE), dtype=np.uint16) for eye in EYES}


@pytest.fixture
def bag(tmp_path, images):
    """Six pairs at 20 Hz, 14 bits, calibrated."""
    with BagWriter(tmp_path / "bag") as writer:
        for n in range(6):
            stamp_ns = 10**18 + n * 50_000_000
            for eye, shift in zip(EYES, (0.0, -12.0), strict=True):
                info = CameraInfoFields(
                    width=64,
                    height=48,
                    distortion_model="plumb_bob",
                    d=(0.0,) * 5,
                    k=(60.0, 0.0, 32.0, 0.0, 60.0, 24.0, 0.0, 0.0, 1.0),
                    p=(60.0, 0.0, 32.0, shift, 0.0, 60.0, 24.0, 0.0, 0.0, 0.0, 1.0, 0.0),
                )
                writer.write_image(f"/{eye}/image_raw", stamp_ns, images[eye][n], eye)
                writer.write_camera_info(f"/{eye}/camera_info", stamp_ns, info, eye)
    return tmp_path / "bag"


def config(recording, rate_hz=0.0):
    return StereoCaptureConfig(
        source="recording",
        waiting_pairs=1000,
        recording=FakeConfig(str(recording), rate_hz=rate_hz),
    )


def test_a_bag_plays_bit_for_bit_over_and_over(bag, images):
    capture, calibration = open_stereo_capture(config(bag))
    with capture:
        pairs = list(islice(capture.pairs(), 9))
    assert calibration.baseline_m == pytest.approx(0.2)
    played = []
    for pair in pairs:
        numbers = {
            eye: [n for n in range(6) if np.array_equal(images[eye][n], frame.image)]
            for eye, frame in pair.frames.items()
        }
        assert len(numbers["left"]) == 1
        assert numbers["left"] == numbers["right"]
        played += numbers["left"]
    # A busy machine may tear a pair, which is thrown away then.
    assert len(set(played)) > 2
    assert all(0 < (b - a) % 6 < 4 for a, b in pairwise(played))


def test_a_folder_of_images(tmp_path, images):
    for eye in EYES:
        (tmp_path / eye).mkdir()
        for n, image in enumerate(images[eye]):
            cv2.imwrite(str(tmp_path / eye / f"{n:06d}.png"), image)
    capture, calibration = open_stereo_capture(config(tmp_path, rate_hz=30.0))
    with capture:
        pair = next(iter(capture.pairs()))
    assert calibration is None
    np.testing.assert_array_equal(pair.frames["right"].image, images["right"][0])


def test_no_such_recording(tmp_path):
    with pytest.raises(DatasetError, match="there is no recording"):
        open_stereo_capture(config(tmp_path / "absent"))


def test_the_node_plays_it_with_its_own_calibration(bag, images, start_node, eventually):
    from thermal_stereo_vo.nodes import conversions

    node = start_node(source="recording", recording__recording=bag)
    eventually(lambda: len(node.heard["right/image_raw"]) > 8, node.said)
    known = {image.tobytes() for image in images["right"]}
    for message in list(node.heard["right/image_raw"]):
        assert conversions.image_from_msg(message).tobytes() in known
    assert set(node.stamps("left/image_raw")) & set(node.stamps("right/image_raw"))
    assert node.heard["right/camera_info"][-1].p[3] == pytest.approx(-12.0)
    eventually(lambda: node.health()[1].startswith("streaming at"), node.said)


def test_the_end_of_a_recording_is_told(bag, start_node, eventually):
    node = start_node(
        source="recording", recording__recording=bag, recording__repeat=False, recording__speed=4.0
    )
    eventually(lambda: "the recording is over" in node.health()[1], node.said)
    assert node.health()[0] == ERROR
