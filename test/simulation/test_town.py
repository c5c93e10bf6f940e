from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.core.cameras import LEFT
from thermal_stereo_vo.simulation.materials import Material
from thermal_stereo_vo.simulation.presets import find_preset, plan_run
from thermal_stereo_vo.simulation.ray_casting import RayCaster


@pytest.fixture(scope="module")
def flight():
    from thermal_stereo_vo.core.config import with_overrides

    config = with_overrides(
        find_preset("seq8").config, ("flight.length_m=110", "world.density=0.4")
    )
    plan = plan_run("seq8", config)
    return plan, find_preset("seq8").scene(plan)


def test_nothing_stands_in_the_way(flight) -> None:
    """Rays from the rig in all directions: no wall, branch or leaf within 0.9 m of the flight."""
    plan, scene = flight
    caster = RayCaster(scene.static.vertices)
    rng = np.random.default_rng(1)
    ways = rng.normal(size=(200, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    for t in np.arange(0.0, plan.motion.duration_s, 0.25):
        place = plan.motion.T_map_base(t)[:3, 3].astype(np.float32)
        met = caster.cast(np.tile(place, (200, 1)), ways.astype(np.float32))
        assert met.distance[met.triangle >= 0].min() > 0.9, f"at {t:.2f} s"


def test_cars_and_people_keep_to_their_lanes(flight) -> None:
    _, scene = flight
    assert len(scene.movers) >= 8
    for mover in scene.movers:
        poses = np.array([mover.T_map_object(t) for t in np.arange(0.0, 20.0, 0.1)])
        speed = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) * 10.0
        assert 0.9 < np.median(speed) < 12.0
        heading = np.diff(poses[:5, :3, 3], axis=0)[0]
        assert heading @ poses[0, :3, 0] > 0.99 * np.linalg.norm(heading)


def test_a_street_has_what_streets_have(flight) -> None:
    _, scene = flight
    there = set(np.unique(scene.static.material))
    for kind in ("ASPHALT", "PAVING", "GRASS", "BRICK", "GLASS", "FOLIAGE", "CAR_PAINT", "POLE",
                 "MARKING", "SKIN", "ROOF_TILE"):  # fmt: skip
        assert int(Material[kind]) in there, kind
    assert 50_000 < len(scene.static) < 1_500_000


def test_the_world_does_not_depend_on_how_much_of_it_is_built() -> None:
    """A longer flight past the same place finds the same houses there."""
    from thermal_stereo_vo.core.config import with_overrides

    def near_start(length: int) -> np.ndarray:
        config = with_overrides(
            find_preset("seq4").config, (f"flight.length_m={length}", "world.density=0.2")
        )
        vertices = find_preset("seq4").scene(plan_run("seq4", config)).static.vertices
        # Above ground, near the start, and not leaves, whose number follows the distance.
        walls = vertices[np.linalg.norm(vertices[:, 0, :2] - [20.0, 12.0], axis=1) < 15.0]
        size = np.linalg.norm(walls[:, 1] - walls[:, 0], axis=1)
        kept = walls[size > 3.0].reshape(-1, 9)
        return kept[np.lexsort(kept.T)]

    np.testing.assert_allclose(near_start(60), near_start(90), atol=1e-4)


def test_a_street_by_day_is_warmer_below_than_above(hover_studio) -> None:
    """The sky is the coldest part of the picture and lies at its top; the road is warm."""
    image = hover_studio.render(LEFT, 2.0)
    sky = np.isinf(image.depth_m)
    rows = np.arange(image.depth_m.shape[0])[:, None] * np.ones_like(image.depth_m)
    assert rows[sky].mean() < 0.35 * image.depth_m.shape[0]
    assert np.median(image.radiance[sky]) < np.percentile(image.radiance[~sky], 20)
