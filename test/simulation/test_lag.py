from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.core.cameras import LEFT
from thermal_stereo_vo.core.config import with_overrides
from thermal_stereo_vo.core.transforms import exp_so3, inverse, make_transform
from thermal_stereo_vo.simulation.lag import (
    backward_flow,
    exponential_delays,
    smear,
    uniform_delays,
)
from thermal_stereo_vo.simulation.materials import Material
from thermal_stereo_vo.simulation.presets import find_preset, plan_run
from thermal_stereo_vo.simulation.render import Lens
from thermal_stereo_vo.simulation.studio import Studio

from .small_worlds import BENT_LENS, LOOK_NORTH, renderer_of, wall_scene


@pytest.mark.parametrize("count", [1, 2, 8, 64])
def test_delays_are_those_of_an_exponential(count: int) -> None:
    delays = exponential_delays(count)
    assert delays.mean() == pytest.approx(1.0, abs=1e-12)
    assert np.all(np.diff(delays) > 0)
    if count >= 64:  # the variance of the exponential is 1
        assert 0.85 < delays.var() < 1.0


def test_delays_of_an_exposure_are_even() -> None:
    np.testing.assert_allclose(uniform_delays(4), [0.125, 0.375, 0.625, 0.875])


def test_63_percent_of_a_step_show_after_one_time_constant() -> None:
    """The preset ``step``: its source warms by 5 K at 1 s, seen every millisecond."""
    config = with_overrides(find_preset("step").config, ("render.workers=0",))
    plan = plan_run("step", config)
    studio = Studio(plan)
    tau_s = config.thermal.time_constant_ms * 1e-3

    def level(time_s: float) -> float:
        return float(np.median(studio.picture(LEFT, time_s).signal))

    before, after = level(0.9), level(1.0 + 12 * tau_s)
    risen = [(level(1.0 + k * tau_s) - before) / (after - before) for k in (0.5, 1.0, 2.0)]
    np.testing.assert_allclose(risen, 1.0 - np.exp([-0.5, -1.0, -2.0]), atol=0.02)


def test_without_lag_a_step_is_a_step() -> None:
    config = with_overrides(
        find_preset("step").config, ("render.workers=0", "thermal.time_constant_ms=0")
    )
    studio = Studio(plan_run("step", config))
    low, high = (float(np.median(studio.picture(LEFT, t).signal)) for t in (0.999, 1.0))
    # 5 K at 30 counts a kelvin, kept in eighths of a count; a little more above 300 K.
    assert 5 * 30 * 8 < high - low < 1.06 * 5 * 30 * 8


def test_moving_one_picture_equals_rendering_many(band) -> None:
    """A turn and a side step before a wall: the quick way shows what the slow way shows."""
    lens = Lens(BENT_LENS)
    renderer = renderer_of(wall_scene(5.0, Material.HEDGE))

    def poses(time_s: float) -> np.ndarray:
        return LOOK_NORTH @ make_transform(
            exp_so3([0.0, 1.2 * time_s, 0.3 * time_s]), [time_s, 0, 0]
        )

    tau_s, delays = 0.02, exponential_delays(16)
    sharp = renderer.render(lens, band, poses, 0.0)
    slow = np.mean(
        [renderer.render(lens, band, poses, -d * tau_s).radiance for d in delays], axis=0
    )
    flow = np.empty((120, 160, 2), np.float32)
    T_then_now = (inverse(poses(-tau_s)) @ poses(0.0))[None]
    largest = backward_flow(
        lens.centres, lens.pixels_per_plane, sharp.depth_m, sharp.owner, T_then_now, flow
    )
    assert 2.0 < largest < 8.0
    quick = np.empty_like(sharp.radiance)
    smear(sharp.radiance, flow, delays, delays, quick)
    inner = (slice(10, -10), slice(12, -12))
    texture = sharp.radiance[inner].std()
    assert np.sqrt(np.mean((quick - slow)[inner] ** 2)) < 0.06 * texture
    # Without the smear, or with its sign turned, they are far apart.
    assert np.sqrt(np.mean((sharp.radiance - slow)[inner] ** 2)) > 0.3 * texture
    smear(sharp.radiance, -flow, delays, delays, quick)
    assert np.sqrt(np.mean((quick - slow)[inner] ** 2)) > 0.5 * texture


def test_what_stands_still_is_not_smeared(rng) -> None:
    image = rng.uniform(0, 100, (20, 30)).astype(np.float32)
    out = np.empty_like(image)
    delays = exponential_delays(8)
    smear(image, np.zeros((20, 30, 2), np.float32), delays, delays, out)
    np.testing.assert_array_equal(out, image)
