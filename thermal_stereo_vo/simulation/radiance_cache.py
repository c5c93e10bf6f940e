"""Noise-free pictures on disk: render once, sense many times.

One file for each camera, ``<role>.signal``: (instants, H, W) uint16, mapped into memory, beside
``<role>.times`` (instants,) float64: the time each picture shows, NaN where there is none yet.  A
run that was interrupted goes on where it stopped.
"""

from __future__ import annotations

import json
from collections.abc import Generator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.errors import SimulationError
from thermal_stereo_vo.simulation.render_farm import render_in_order
from thermal_stereo_vo.simulation.run import RunPlan
from thermal_stereo_vo.simulation.schedule import Exposure

_NOTE = "pictures.json"


class RadianceCache:
    """Pictures of one run in ``folder``, made when missing.

    Raises SimulationError when the folder holds something else, or pictures of another run.
    """

    def __init__(self, folder: Path, plan: RunPlan, instants: int) -> None:
        self._signals: dict[str, NDArray[np.uint16]] = {}
        self._times: dict[str, NDArray[np.float64]] = {}
        note = {"preset": plan.preset, "key": plan.picture_key(), "instants": instants}
        self._claim(folder, note)
        for role in plan.roles:
            camera = plan.rig[role].camera
            shape = (instants, camera.height, camera.width)
            self._signals[role] = _mapped(folder / f"{role}.signal", np.uint16, shape)
            self._times[role] = _mapped(folder / f"{role}.times", np.float64, (instants,))

    def find(self, role: str, index: int, time_s: float) -> NDArray[np.uint16] | None:
        """(H, W) uint16 picture of that frame, or None when it must be rendered."""
        if self._times[role][index] != time_s:
            return None
        return np.asarray(self._signals[role][index])

    def keep(self, role: str, index: int, time_s: float, signal: NDArray[np.uint16]) -> None:
        """Store a picture; it counts only once it is whole."""
        self._signals[role][index] = signal
        self._times[role][index] = time_s

    def _claim(self, folder: Path, note: dict[str, object]) -> None:
        path = folder / _NOTE
        if path.exists():
            if json.loads(path.read_text(encoding="utf-8")) != note:
                raise SimulationError(
                    f"{folder} keeps the pictures of another run: choose an empty folder for "
                    "render.cache, or remove this one"
                )
            return
        if folder.exists() and any(folder.iterdir()):
            raise SimulationError(
                f"{folder} is not empty and keeps no pictures: choose another for render.cache"
            )
        folder.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(note), encoding="utf-8")


def cached_signals(
    plan: RunPlan, exposures: list[Exposure], instants: int
) -> Generator[NDArray[np.uint16], None, None]:
    """The signal of each exposure in order, from the cache where the settings name one."""
    config = plan.config.render
    if not config.cache:
        jobs = [(plan.roles[exposure.camera], exposure.time_s) for exposure in exposures]
        yield from render_in_order(plan, jobs, config.workers)
        return
    cache = RadianceCache(Path(config.cache), plan, instants)

    def find(exposure: Exposure) -> NDArray[np.uint16] | None:
        return cache.find(plan.roles[exposure.camera], exposure.index, exposure.time_s)

    # What is missing is settled now: another process may fill the same folder meanwhile.
    kept = [find(exposure) is not None for exposure in exposures]
    missing = [exposure for exposure, is_kept in zip(exposures, kept, strict=True) if not is_kept]
    jobs = [(plan.roles[exposure.camera], exposure.time_s) for exposure in missing]
    rendered = render_in_order(plan, jobs, config.workers if missing else 0)
    try:
        for exposure, is_kept in zip(exposures, kept, strict=True):
            signal = find(exposure) if is_kept else next(rendered)
            assert signal is not None
            if not is_kept:
                cache.keep(plan.roles[exposure.camera], exposure.index, exposure.time_s, signal)
            yield signal
    finally:
        rendered.close()


def _mapped(path: Path, dtype: type, shape: tuple[int, ...]) -> NDArray[Any]:
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    if not path.exists() or path.stat().st_size != size:
        fresh = np.memmap(path, dtype, "w+", shape=shape)
        if dtype is np.float64:
            fresh[:] = np.nan
        return fresh
    return np.memmap(path, dtype, "r+", shape=shape)
