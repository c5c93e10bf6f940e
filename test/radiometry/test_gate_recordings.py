"""The gate on real recordings, from images alone."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from thermal_stereo_vo.core.frames import GapReason, RawFrame, Telemetry
from thermal_stereo_vo.radiometry.gate import Cause, FrameGate

EVEN_NS = 113_636_364  # 8.8 Hz


def lepton(folder: Path, name: str) -> dict[str, np.ndarray]:
    with np.load(folder / f"{name}.npz") as archive:
        return {key: archive[key] for key in archive.files}


def gate_of(images, stamps_ns=None, telemetry=None) -> tuple[FrameGate, list]:
    gate = FrameGate()
    decisions = []
    for k, image in enumerate(images):
        stamp_ns = 1 + (EVEN_NS * k if stamps_ns is None else int(stamps_ns[k]))
        told = None if telemetry is None else telemetry[k]
        decisions.append(gate.process(RawFrame(np.array(image), stamp_ns, "left", k, told)))
    return gate, decisions


class TestHedgehog:
    """A real FFC between frames 29 and 30: 1.6 s of silence, the whole image steps."""

    def check(self, gate: FrameGate, decisions: list) -> None:
        (event,) = gate.events
        assert event.reason is GapReason.FFC
        assert event.epoch_changed
        assert (event.first_sequence, event.next_sequence) == (30, 30)
        assert [decision.epoch for decision in decisions] == [0] * 30 + [1] * 89
        assert not any(decision.blind for decision in decisions)

    def test_with_its_stamps(self, recording):
        clip = lepton(recording("lepton_cptv"), "hedgehog")
        stamps_ns = np.round((clip["time_on_s"] - clip["time_on_s"][0]) * 1e9)
        gate, decisions = gate_of(clip["frames"], stamps_ns)
        self.check(gate, decisions)
        assert gate.events[0].duration_ns * 1e-9 == pytest.approx(1.597, abs=0.002)
        assert set(gate.events[0].causes) == {
            Cause.TIME_GAP,
            Cause.OFFSET_STEP,
            Cause.PATTERN_CHANGE,
        }

    def test_from_images_alone(self, recording):
        clip = lepton(recording("lepton_cptv"), "hedgehog")
        gate, decisions = gate_of(clip["frames"])
        self.check(gate, decisions)
        assert set(gate.events[0].causes) == {Cause.OFFSET_STEP, Cause.PATTERN_CHANGE}

    def test_with_its_telemetry(self, recording):
        clip = lepton(recording("lepton_cptv"), "hedgehog")
        since_ns = np.round((clip["time_on_s"] - clip["last_ffc_s"]) * 1e9)
        telemetry = [Telemetry(time_since_ffc_ns=int(value)) for value in since_ns]
        gate, decisions = gate_of(clip["frames"], telemetry=telemetry)
        self.check(gate, decisions)
        assert Cause.TELEMETRY in gate.events[0].causes


@pytest.mark.parametrize("name", ["possum", "v2", "background"])
def test_quiet_lepton_clips_hold_no_event(recording, name):
    gate, decisions = gate_of(lepton(recording("lepton_cptv"), name)["frames"])
    assert list(gate.events) == []
    assert not any(decision.blind or decision.repeat for decision in decisions)


def test_the_stamps_of_possum_and_v2_hold_no_event(recording):
    for name in ("possum", "v2"):
        clip = lepton(recording("lepton_cptv"), name)
        gate, _ = gate_of(clip["frames"], np.round(clip["time_on_s"] * 1e9))
        assert list(gate.events) == []


@pytest.mark.parametrize(
    ("folder", "pattern"),
    [
        ("optris_sweep", "*.png"),
        ("euroc_standing_still", "cam0/data/*.png"),
        ("euroc_standing_still", "cam1/data/*.png"),
        ("kitti_residential", "image_l/*.png"),
    ],
)
def test_a_hand_held_sweep_a_standing_rig_and_a_drive_hold_no_event(recording, folder, pattern):
    files = sorted(recording(folder).glob(pattern))
    assert len(files) >= 20
    gate, decisions = gate_of([cv2.imread(str(file), -1) for file in files])
    assert list(gate.events) == []
    assert not any(decision.blind or decision.repeat for decision in decisions)


@pytest.mark.parametrize("name", ["car_origin_1", "car_cal_2_scene_2"])
def test_a_drive_with_gain_jumps_and_a_stop_holds_no_event(recording, name):
    video = cv2.VideoCapture(str(recording("lwir_drive") / f"{name}.avi"))
    gate, count = FrameGate(), 0
    while True:
        good, picture = video.read()
        if not good:
            break
        raw = RawFrame(picture[..., 0].copy(), 1 + count * 16_666_667, "left", count)
        decision = gate.process(raw)
        assert not decision.blind
        assert not decision.repeat
        count += 1
    assert count >= 600
    assert list(gate.events) == []


@pytest.mark.parametrize("kind", ["copies", "grey"])
def test_ten_pairs_lost_from_a_drive_are_exactly_those_held_back(recording, rng, kind):
    folder = recording("kitti_residential")
    for eye in ("image_l", "image_r"):
        images = [cv2.imread(str(file), 0) for file in sorted((folder / eye).glob("*.png"))]
        for k in range(20, 30):
            grey = 128 + 1.5 * rng.standard_normal(images[0].shape)
            images[k] = images[19] if kind == "copies" else np.round(grey).astype(np.uint8)
        gate, decisions = gate_of(images)
        assert [k for k, d in enumerate(decisions) if d.blind] == list(range(20, 30))
        assert decisions[30].gap.duration_ns == 11 * EVEN_NS
        assert len(gate.events) == 1
