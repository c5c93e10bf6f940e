"""A look at a preset: six frames over the run on one sheet."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import VISIBLE, Camera
from thermal_stereo_vo.core.errors import SimulationError
from thermal_stereo_vo.core.frames import CameraView, RigFrame
from thermal_stereo_vo.radiometry.agc import AgcConfig, AutomaticGain
from thermal_stereo_vo.simulation.schedule import Exposure, stamp_ns
from thermal_stereo_vo.simulation.settings import SimulationConfig
from thermal_stereo_vo.simulation.simulation import Simulation
from thermal_stereo_vo.simulation.studio import Studio

_SIZE = (320, 240)
_SHOWN = (0.12, 0.3, 0.45, 0.6, 0.75, 0.9)
_AGC = AgcConfig(mode="plateau", roi=(0.0, 0.35, 1.0, 1.0))


def display(
    counts: NDArray[np.uint16] | NDArray[np.uint8], config: AgcConfig = _AGC
) -> NDArray[np.uint8]:
    """(H, W) uint8 view of a single frame."""
    if counts.dtype == np.uint8:
        return np.asarray(counts, np.uint8)
    height, width = counts.shape
    camera = Camera(width, height, float(width), float(width), width / 2, height / 2)
    frame = RigFrame(0, {"thermal": CameraView(counts, camera)})
    shown = AutomaticGain(config).process(frame).views["thermal"].display
    assert shown is not None
    return shown


def sample_frames(
    preset: str, config: SimulationConfig, fractions: tuple[float, ...], seed: int = 0
) -> list[NDArray[np.uint16] | NDArray[np.uint8]]:
    """Frames of every camera but the right one, at these fractions of the run."""
    simulation = Simulation(preset, config, seed)
    plan = simulation.plan
    studio = Studio(plan)
    roles = plan.roles if VISIBLE in plan.roles else plan.roles[:1]
    frames: list[NDArray[np.uint16] | NDArray[np.uint8]] = []
    for fraction in fractions:
        index = round(fraction * (simulation.instants - 1))
        time_s = index / config.rate_hz
        for role in roles:
            camera = plan.roles.index(role)
            signal = studio.picture(role, time_s).signal
            # A sensor of its own, so that a correction under way does not hide the scene.
            frame = simulation.sensor(camera, corrections=False).frame(
                signal, Exposure(camera, index, time_s, stamp_ns(time_s), False)
            )
            assert frame is not None
            frames.append(frame.image)
    return frames


def write_preview(preset: str, config: SimulationConfig, path: Path, seed: int = 0) -> None:
    """Write the sheet as PNG.  Raises SimulationError when the file cannot be written."""
    shown = _SHOWN
    frames = sample_frames(preset, config, shown, seed)
    pictures = [cv2.resize(display(f), _SIZE, interpolation=cv2.INTER_AREA) for f in frames]
    across = 4 if len(pictures) > len(shown) else 3
    rows = [np.hstack(pictures[k : k + across]) for k in range(0, len(pictures), across)]
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), np.vstack(rows)):
        raise SimulationError(f"cannot write the picture {path}: give a name that ends in .png")
