from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.core.cameras import THERMAL, VISIBLE
from thermal_stereo_vo.core.config import with_overrides
from thermal_stereo_vo.simulation.presets import find_preset, plan_run
from thermal_stereo_vo.simulation.settings import VisibleCameraConfig
from thermal_stereo_vo.simulation.simulation import Simulation
from thermal_stereo_vo.simulation.studio import Studio
from thermal_stereo_vo.simulation.visible_camera import SIGNAL_STEP, VisibleCamera

GREY = np.full((80, 80), round(0.25 / SIGNAL_STEP), np.uint16)


def picture(illumination: float, **settings) -> np.ndarray:
    camera = VisibleCamera(VisibleCameraConfig(blur_px=0.0, **settings), illumination, (1,))
    return camera.expose(GREY, illumination, 0).astype(float)


def test_exposure_keeps_the_grey_until_the_light_runs_out() -> None:
    day, dusk, night = (picture(light).mean() for light in (1.0, 0.005, 3e-4))
    assert day == pytest.approx(78.5, abs=1.0)
    assert dusk == pytest.approx(day, abs=1.0)
    assert night < 0.8 * day


def test_noise_is_that_of_photons_and_read_out() -> None:
    found = picture(1.0)
    electrons = 0.30 * 10000.0
    sigma = np.sqrt(electrons + 8.0**2) * 255.0 / 10000.0
    assert found.std() == pytest.approx(np.hypot(sigma, np.sqrt(1 / 12)), rel=0.05)
    # In the dark the same grey is made of fewer photons.
    assert 2.0 < picture(0.005).std() / found.std() < 3.2


def test_the_bands_share_geometry_and_not_texture() -> None:
    config = with_overrides(
        find_preset("ms-01").config, ("render.scale=0.25", "render.workers=0", "render.lag=none")
    )
    studio = Studio(plan_run("ms-01", config))
    seen = {role: studio.render(role, 20.0) for role in (VISIBLE, THERMAL)}
    depths = [np.median(view.depth_m) for view in seen.values()]
    assert depths[0] == pytest.approx(depths[1], rel=0.15)
    again = studio.render(VISIBLE, 20.0)
    np.testing.assert_array_equal(again.radiance, seen[VISIBLE].radiance)
    # Within flat parts the textures have nothing in common: compare the same camera's two bands.
    thermal_as_visible = studio._renderer.render(  # the same lens, the other band
        studio._lenses[VISIBLE], studio._thermal, studio._plan.camera_poses(VISIBLE), 20.0
    )
    np.testing.assert_array_equal(thermal_as_visible.depth_m, seen[VISIBLE].depth_m)
    patch = (slice(5, 35), slice(60, 100))
    a = seen[VISIBLE].radiance[patch].ravel()
    b = thermal_as_visible.radiance[patch].ravel()
    a, b = a - a.mean(), b - b.mean()
    assert abs(a @ b) < 0.5 * np.linalg.norm(a) * np.linalg.norm(b)


def test_dusk_dims_the_visible_band_and_leaves_the_thermal_one() -> None:
    def frames(*overrides: str) -> tuple[np.ndarray, ...]:
        settings = ("render.scale=0.125", "render.workers=0", "duration_s=0.05", *overrides)
        run = Simulation("ms-01", with_overrides(find_preset("ms-01").config, settings))
        return tuple(frame.image for frame in run.frames())

    lit, dusk, dark = (frames(f"world.illumination={light}") for light in ("0.5", "0.01", "0.0003"))
    for other in (dusk, dark):
        np.testing.assert_array_equal(other[1], lit[1])
    # Exposure makes up for dusk, at the price of noise; for darkness it cannot.
    assert dusk[0].mean() == pytest.approx(lit[0].mean(), rel=0.1)
    assert dark[0].mean() < 0.7 * lit[0].mean()
    # The rig rests: what differs between two frames is noise.
    noise = [np.std(view[2].astype(float) - view[0]) for view in (lit, dusk)]
    assert noise[1] > 1.2 * noise[0]
