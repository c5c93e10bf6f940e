"""A look at the presets: six frames of one on a sheet, or all of them on a few."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import VISIBLE, Camera
from thermal_stereo_vo.core.errors import SimulationError
from thermal_stereo_vo.core.frames import CameraView, RigFrame
from thermal_stereo_vo.radiometry.agc import AgcConfig, AutomaticGain
from thermal_stereo_vo.simulation.presets import find_preset
from thermal_stereo_vo.simulation.schedule import Exposure, stamp_ns
from thermal_stereo_vo.simulation.settings import SimulationConfig
from thermal_stereo_vo.simulation.simulation import Simulation
from thermal_stereo_vo.simulation.studio import Studio

_SIZE = (320, 240)
_SHOWN = (0.12, 0.3, 0.45, 0.6, 0.75, 0.9)
_TILE = (240, 180)
GALLERY = {
    "sim_flights.png": tuple(f"seq{n}" for n in range(1, 10)),
    "sim_short.png": ("demo", "hover", "turn", "quick_turn", "corridor", "ffc", "hot_arm"),
    "sim_office.png": tuple(f"ms-{n:02d}" for n in range(1, 8)),
    "sim_bands.png": ("ms-forward", "ms-still", "ms-dusk"),
    "sim_targets.png": ("board_aluminium", "board_mask", "blackbody", "step"),
}
"""Sheets of the gallery and the presets on each."""
_GALLERY_SHOWN = {"hot_arm": (0.2, 0.42), "step": (0.2, 1.0)}
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
    _write(path, np.vstack(rows))


def write_gallery(folder: Path, on_preset: Callable[[], None] = lambda: None) -> None:
    """Write the sheets of ``GALLERY``: two frames of each preset.

    Raises SimulationError when a file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name, presets in GALLERY.items():
        tiles = []
        for preset in presets:
            tiles += _tiles(preset)
            on_preset()
        across = 6 if len(tiles) % 6 == 0 else 4
        blank = np.zeros_like(tiles[0])
        tiles += [blank] * (-len(tiles) % across)
        rows = [np.hstack(tiles[k : k + across]) for k in range(0, len(tiles), across)]
        _write(folder / name, np.vstack(rows))


def _tiles(preset: str) -> list[NDArray[np.uint8]]:
    """Two small pictures with the name: at two times, or of both bands at one."""
    config = find_preset(preset).config
    office = preset.startswith("ms-")
    shown = (0.35,) if office else _GALLERY_SHOWN.get(preset, (0.22, 0.68))
    tiles = []
    for n, frame in enumerate(sample_frames(preset, config, shown)):
        tile = cv2.resize(display(frame), _TILE, interpolation=cv2.INTER_AREA)
        label = preset + ((" visible", " thermal")[n] if office else "")
        cv2.rectangle(tile, (0, 0), (8 * len(label) + 8, 17), 0, -1)
        cv2.putText(tile, label, (4, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.42, 255, 1, cv2.LINE_AA)
        tiles.append(np.asarray(tile, np.uint8))
    return tiles


def _write(path: Path, image: NDArray[np.uint8]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), image, [cv2.IMWRITE_PNG_COMPRESSION, 9]):
        raise SimulationError(f"cannot write the picture {path}: give a name that ends in .png")
