"""A visible camera is blind in darkness and glare, and nowhere else."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from thermal_stereo_vo.core.frames import GapReason, RawFrame
from thermal_stereo_vo.radiometry.front_end import (
    FrontEndConfig,
    ThermalFrontEnd,
    VisibleFrontEnd,
    create_front_end,
)
from thermal_stereo_vo.radiometry.gate import Cause
from thermal_stereo_vo.simulation.settings import VisibleCameraConfig
from thermal_stereo_vo.simulation.visible_camera import VisibleCamera

PERIOD_NS = 50_000_000
SHAPE = (120, 160)


class Scene:
    """A textured wall that moves past a simulated camera in any light."""

    def __init__(self, illumination: float = 0.01):
        rng = np.random.default_rng(4)
        texture = cv2.GaussianBlur(rng.normal(size=(120, 400)).astype(np.float32), (0, 0), 2.0)
        self._signal = (8000 + 60000 * texture / np.abs(texture).max() * 0.1).astype(np.uint16)
        self._camera = VisibleCamera(VisibleCameraConfig(), illumination, (1, 21, 0))

    def frame(self, i: int, light: float) -> RawFrame:
        part = np.ascontiguousarray(self._signal[:, i : i + SHAPE[1]])
        return RawFrame(self._camera.expose(part, light, i), i * PERIOD_NS, "visible", i)


def run(lights, events=None):
    on_event = None if events is None else events.append
    front_end = VisibleFrontEnd(FrontEndConfig(), "visible", on_event)
    scene = Scene()
    return [front_end.process(scene.frame(i, light)) for i, light in enumerate(lights)]


def test_pictures_pass_as_they_are():
    scene = Scene()
    front_end = VisibleFrontEnd(FrontEndConfig(), "visible")
    raw = scene.frame(0, 0.01)
    frame = front_end.process(raw)
    assert frame.image is raw.image
    assert (frame.blind, frame.epoch, frame.gap) == (None, 0, None)


@pytest.mark.parametrize(
    ("light", "reason", "cause"),
    [
        (1e-7, GapReason.DARK, Cause.DARKNESS),
        (0.2, GapReason.GLARE, Cause.GLARE),
    ],
)
def test_darkness_and_glare_are_told_and_no_fault_however_long(light, reason, cause):
    events = []
    frames = run([0.01] * 10 + [light] * 90 + [0.01] * 10, events)  # 4.5 s: more than ffc_max_s
    assert [frame.image is None for frame in frames] == [False] * 10 + [True] * 90 + [False] * 10
    assert {frame.blind for frame in frames[10:100]} == {reason}
    back = frames[100]
    assert back.gap.reason is reason
    assert back.gap.epoch_changed
    assert back.gap.duration_ns == 91 * PERIOD_NS
    assert (frames[9].epoch, back.epoch) == (0, 1)
    assert [(event.reason, event.causes) for event in events] == [(reason, (cause,))]


def test_half_the_light_blinds_nobody():
    frames = run([0.01] * 10 + [0.005] * 10 + [0.01] * 10)
    assert all(frame.image is not None for frame in frames)
    assert frames[-1].epoch == 0


def test_black_and_white_pictures_are_dark_and_glare():
    front_end = VisibleFrontEnd(FrontEndConfig(), "visible")
    for i, (grey, reason) in enumerate([(0, GapReason.DARK), (255, GapReason.GLARE)]):
        frame = front_end.process(RawFrame(np.full(SHAPE, grey, np.uint8), i + 1, "visible"))
        assert frame.blind is reason


def test_a_frozen_picture_is_no_correction_of_a_shutter():
    scene, events = Scene(), []
    front_end = VisibleFrontEnd(FrontEndConfig(), "visible", events.append)
    for i in range(10):
        front_end.process(scene.frame(i, 0.01))
    frozen = scene.frame(9, 0.01).image
    told = [front_end.process(RawFrame(frozen, i * PERIOD_NS, "visible", i)) for i in range(10, 20)]
    back = front_end.process(scene.frame(20, 0.01))
    assert all(frame is None or frame.blind is GapReason.FROZEN for frame in told)
    assert back.gap.reason is GapReason.FROZEN
    assert not back.gap.epoch_changed


def test_a_dead_stream_is_a_fault():
    events = []
    front_end = VisibleFrontEnd(FrontEndConfig(), "visible", events.append)
    scene = Scene()
    for i in range(6):
        front_end.process(scene.frame(i, 0.01))
    assert front_end.check(1.0) is None
    assert front_end.check(4.0).reason is GapReason.FAULT


def test_the_role_decides_who_judges():
    assert isinstance(create_front_end(FrontEndConfig(), "visible"), VisibleFrontEnd)
    assert isinstance(create_front_end(FrontEndConfig(), "thermal"), ThermalFrontEnd)
    assert isinstance(create_front_end(FrontEndConfig(), "left"), ThermalFrontEnd)
