"""Rectified pairs of simulated flights with their true disparities."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import LEFT, RIGHT
from thermal_stereo_vo.core.frames import RadiometricFrame, RigFrame
from thermal_stereo_vo.datasets.options import SourceOptions
from thermal_stereo_vo.datasets.simulated import open_simulated
from thermal_stereo_vo.simulation.render import Lens
from thermal_stereo_vo.simulation.schedule import Exposure, stamp_ns
from thermal_stereo_vo.simulation.studio import Studio
from thermal_stereo_vo.stereo.rectification import RectificationConfig, Rectifier, assemble


@dataclass(frozen=True)
class TrueView:
    """A rectified pair as the sensors saw it, and the truth.

    ``disparity_px`` (H, W) float32 of the left image, 0 in the sky.  ``judged`` (H, W) bool: where
    both cameras look, so that there is something to match.
    """

    frame: RigFrame
    disparity_px: NDArray[np.float32]
    judged: NDArray[np.bool_]
    baseline_m: float


def true_views(
    preset: str, pairs: int, overrides: tuple[str, ...] = (), seed: int = 0
) -> Iterator[TrueView]:
    """``pairs`` instants spread over a simulated flight of a stereo rig.

    Raises SimulationError for an unknown preset.
    """
    simulation = open_simulated(preset, SourceOptions(seed=seed, overrides=overrides)).simulation
    plan = simulation.plan
    studio = Studio(plan)
    rectifier = Rectifier(plan.rig, RectificationConfig())
    camera = rectifier.rectified_calibration[LEFT].camera
    lens = Lens(camera)
    for k in range(pairs):
        index = int((k + 0.5) / pairs * simulation.instants)
        time_s = index / simulation.config.rate_hz
        corrected = []
        for number, role in enumerate((LEFT, RIGHT)):
            signal = studio.picture(role, time_s).signal
            exposure = Exposure(number, index, time_s, stamp_ns(time_s), False)
            raw = simulation.sensor(number, corrections=False).frame(signal, exposure)
            assert raw is not None
            corrected.append(RadiometricFrame(raw.image, raw.stamp_ns, role))
        frame = assemble(rectifier, corrected[0], corrected[1], corrected[0].stamp_ns)
        depth_m = studio.thermal_view(
            lens, lambda time_s: plan.T_map_rig(time_s) @ rectifier.T_rig_rectified, time_s
        ).depth_m
        disparity_px = np.float32(camera.fx * rectifier.baseline_m) / depth_m
        yield TrueView(frame, disparity_px, _in_both(frame, disparity_px), rectifier.baseline_m)


def _in_both(frame: RigFrame, disparity_px: NDArray[np.float32]) -> NDArray[np.bool_]:
    seen_at = np.arange(disparity_px.shape[1]) - disparity_px
    inside = seen_at >= 0.0
    left_mask, right_mask = (frame.views[role].mask for role in (LEFT, RIGHT))
    if left_mask is not None:
        inside &= left_mask
    if right_mask is not None:
        inside &= np.take_along_axis(right_mask, np.maximum(seen_at, 0.0).astype(np.intp), axis=1)
    return inside
