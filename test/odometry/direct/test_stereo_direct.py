"""What only a method that compares brightness must be asked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermal_stereo_vo.core.config import with_overrides
from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.core.frames import GapReason
from thermal_stereo_vo.core.results import TrackingStatus
from thermal_stereo_vo.odometry.direct import stereo_method
from thermal_stereo_vo.odometry.factory import OdometryConfig, create_odometry

PERIOD_NS = 100_000_000


@pytest.fixture(scope="module")
def flight(room):
    rng = np.random.default_rng(11)
    poses = room.path(9)
    return [room.rig_frame(i * PERIOD_NS, T, rng) for i, T in enumerate(poses)], poses


def direct(*settings):
    return create_odometry(with_overrides(OdometryConfig(), ["method=direct", *settings]))


def counts(frame, change):
    """14-bit counts by ``change(role, grey levels)``."""
    views = {}
    for role, view in frame.views.items():
        image = np.clip(change(role, view.image.astype(float)), 0, 16383).astype(np.uint16)
        views[role] = replace(view, image=image)
    return replace(frame, views=views)


def error_m(result, T):
    return float(np.linalg.norm(result.T_world_rig[:3, 3] - T[:3, 3]))


def test_counts_that_jump_with_a_flat_field_correction_are_no_motion(flight):
    """Each eye jumps by an amount of its own, ten times the contrast of the scene."""
    frames, poses = flight

    def before(role, grey):
        return 4000 + 2.0 * grey

    def after(role, grey):
        return (7000 if role == "left" else 2500) + 2.2 * grey

    odometry = direct()
    results = [
        odometry.process(counts(frame, before if i < 5 else after))
        for i, frame in enumerate(frames)
    ]
    assert all(result.status is TrackingStatus.TRACKING for result in results[1:])
    for result, T in zip(results, poses, strict=True):
        assert error_m(result, T) < 0.05


@pytest.mark.parametrize("blind", ["left", "right"])
def test_either_eye_carries_on_alone(flight, blind):
    """Measured, not predicted, while the other one is away."""
    frames, poses = flight
    odometry = direct()
    for i, frame in enumerate(frames):
        if 4 <= i < 7:
            views = {role: view for role, view in frame.views.items() if role != blind}
            frame = replace(frame, views=views, blind={blind: GapReason.FFC})
        result = odometry.process(frame)
        if i > 0:
            assert result.status is TrackingStatus.TRACKING, i
            assert result.stats.inliers > 100
            assert error_m(result, poses[i]) < 0.05


def test_the_window_pays(flight):
    """More keyframes, adjusted together, are no worse than two.

    No patch of this room is off as a whole, and to allow for that costs more than keyframes gain.
    """
    frames, poses = flight
    ends = []
    for window in (2, 7):
        odometry = direct(
            f"window={window}",
            "direct.keyframes.parallax_px=1",
            "direct.photometric.patch_offset=0",
        )
        results = [odometry.process(frame) for frame in frames]
        assert sum(result.stats.keyframe for result in results) >= 4
        ends.append(error_m(results[-1], poses[-1]))
    assert 1e-4 < ends[1] < 1.5 * ends[0] < 0.1


@pytest.fixture(params=[1, 2])
def failing(request, monkeypatch):
    """Odometry with many keyframes whose first adjustment fails, with and without a worker."""
    adjust, asked = stereo_method.adjust_photometrically, []

    def fails_first(*args, **kwargs):
        asked.append(args)
        if len(asked) == 1:
            raise np.linalg.LinAlgError("singular matrix")
        return adjust(*args, **kwargs)

    monkeypatch.setattr(stereo_method, "adjust_photometrically", fails_first)
    return direct(f"threads={request.param}", "direct.keyframes.parallax_px=1")


def test_an_adjustment_that_fails_is_told_once_and_the_next_one_counts(flight, failing):
    frames, poses = flight
    results = [failing.process(frame) for frame in frames]
    told = [i for i, result in enumerate(results) if "LinAlgError: singular" in result.reason]
    adjusted = [i for i, result in enumerate(results) if "bundle" in result.stats.stage_ms]
    assert len(told) == 1
    assert len(adjusted) >= 2
    assert told[0] < adjusted[0]
    for result, T in zip(results[1:], poses[1:], strict=True):
        assert result.status is TrackingStatus.TRACKING
        assert error_m(result, T) < 0.05


def until_adjusted(odometry, frames):
    """How many frames it takes until the last one has begun an adjustment."""
    keyframes = (odometry.process(frame).stats.keyframe for frame in frames)
    return next(n for n, keyframe in enumerate(keyframes, start=1) if keyframe and n > 1)


def test_a_failure_does_not_hide_why_a_frame_was_not_measured(flight, failing):
    frames, _ = flight
    frame = frames[until_adjusted(failing, frames)]
    blind = replace(frame, views={}, blind=dict.fromkeys(frame.views, GapReason.FFC))
    reason = failing.process(blind).reason
    assert "ffc" in reason
    assert "LinAlgError: singular matrix" in reason


def test_an_adjustment_that_fails_does_not_hold_up_a_reset(flight, failing):
    frames, poses = flight
    n = until_adjusted(failing, frames)
    failing.reset(poses[n])
    results = [failing.process(frame) for frame in frames[n:]]
    assert not any("LinAlgError" in result.reason for result in results)
    for result, T in zip(results, poses[n:], strict=True):
        assert error_m(result, T) < 0.05


def test_a_lens_that_bends_rays_is_refused(flight):
    frames, _ = flight
    views = {
        role: replace(
            view, camera=replace(view.camera, distortion=(0.1,) * 5, model=_radial()),
        )
        for role, view in frames[0].views.items()
    }  # fmt: skip
    with pytest.raises(CalibrationError, match="do not bend rays: rectify first"):
        direct().process(replace(frames[0], views=views))


def _radial():
    from thermal_stereo_vo.core.cameras import DistortionModel

    return DistortionModel.RADIAL_TANGENTIAL
