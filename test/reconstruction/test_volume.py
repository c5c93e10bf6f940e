"""Fusion of noisy clouds of known surfaces."""

from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.core.results import PointCloud
from thermal_stereo_vo.reconstruction.volume import Volume, VolumeConfig

EYE = np.zeros(3)
CONFIG = VolumeConfig(voxel_m=0.1, truncation_voxels=4.0, min_count=5)


def wall(rng, distance_m=5.0, noise_m=0.1, count=4000, kelvin=None, eye=EYE):
    """Points of a wall across z, displaced along their rays from ``eye``."""
    spots = np.column_stack([rng.uniform(-1, 1, (count, 2)), np.full(count, distance_m)])
    rays = (spots - eye) / np.linalg.norm(spots - eye, axis=1, keepdims=True)
    xyz = spots + rays * rng.normal(0.0, noise_m, (count, 1)) if noise_m else spots
    intensity = 7000 + 10 * rng.standard_normal(count)
    temperature = None if kelvin is None else np.full(count, kelvin, np.float32)
    return PointCloud(xyz.astype(np.float32), intensity.astype(np.float32), temperature)


def fused(clouds, sigma_m=0.1, config=CONFIG, eyes=None):
    volume = Volume(config)
    for k, cloud in enumerate(clouds):
        eye = EYE if eyes is None else eyes[k]
        volume.add(cloud, eye, np.full(len(cloud.xyz), sigma_m))
    return volume


@pytest.mark.parametrize("distance_m", [5.0, 5.033, -4.98])
def test_noise_averages_out_and_the_surface_lies_between_voxels(distance_m):
    rng = np.random.default_rng(1)
    eyes = [np.array([0.2 * k, 0.0, 0.0]) for k in range(8)]
    clouds = [wall(rng, distance_m, noise_m=0.08, eye=eye) for eye in eyes]
    model = fused(clouds, eyes=eyes).surface()
    # At the rim there is nothing to average with.
    inner = np.all(np.abs(model.cloud.xyz[:, :2]) < 0.9, axis=1)
    off_m = model.cloud.xyz[inner, 2] - distance_m
    assert inner.sum() > 300
    assert abs(np.mean(off_m)) < 0.01
    assert np.sqrt(np.mean(off_m**2)) < 0.04  # half of what a single point is off


def test_surer_clouds_weigh_more():
    rng = np.random.default_rng(2)
    volume = Volume(CONFIG)
    for distance_m, sigma_m in ((5.0, 0.1), (5.2, 0.2)):
        cloud = wall(rng, distance_m, noise_m=0.0)
        volume.add(cloud, EYE, np.full(len(cloud.xyz), sigma_m))
    z = volume.surface().cloud.xyz[:, 2]
    # Weights are 4 to 1.
    assert 5.02 < np.median(z) < 5.045  # 5.04; equal weights give 5.1, weights of 2 to 1 5.07


def test_means_spreads_and_counts_are_those_of_the_points_put_in():
    rng = np.random.default_rng(3)
    clouds = [wall(rng, 5.02, 0.0, kelvin=kelvin) for kelvin in (280.0, 282.0)]
    model = fused(clouds).surface()
    assert np.median(model.cloud.intensity) == pytest.approx(7000, abs=2)
    assert np.median(model.intensity_spread) == pytest.approx(10, rel=0.3)
    assert np.median(model.cloud.temperature_kelvin) == pytest.approx(281.0, abs=0.2)
    assert np.median(model.temperature_spread_kelvin) == pytest.approx(1.0, abs=0.15)
    # 8000 points on 400 faces, each seen once: two voxels make one crossing.
    assert np.median(model.count) == pytest.approx(20, abs=6)
    assert model.count.min() >= CONFIG.min_count


def test_one_cloud_without_temperatures_leaves_the_model_without():
    rng = np.random.default_rng(4)
    model = fused([wall(rng, kelvin=280.0), wall(rng)]).surface()
    assert model.cloud.temperature_kelvin is None
    assert model.temperature_spread_kelvin is None


def test_what_was_seen_too_seldom_is_no_surface():
    rng = np.random.default_rng(5)
    few = fused([wall(rng, count=300, noise_m=0.0)])
    many = fused([wall(rng, count=30_000, noise_m=0.0)])
    assert len(few) > 0
    assert len(few.surface().cloud.xyz) < 0.2 * len(many.surface().cloud.xyz)


def test_an_empty_volume_has_an_empty_surface():
    volume = Volume(CONFIG)
    assert len(volume) == 0
    model = volume.surface()
    assert model.cloud.xyz.shape == (0, 3)
    assert model.cloud.temperature_kelvin is None
    volume.add(PointCloud.empty(), EYE, np.zeros(0))
    assert len(volume.surface().cloud.xyz) == 0


def test_points_that_are_not_finite_are_left_out():
    rng = np.random.default_rng(6)
    cloud = wall(rng, noise_m=0.0)
    cloud.xyz[::2, 0] = np.nan
    assert np.isfinite(fused([cloud, cloud]).surface().cloud.xyz).all()


def test_the_order_of_clouds_does_not_matter():
    rng = np.random.default_rng(7)
    clouds = [wall(rng, kelvin=280.0 + k) for k in range(3)]
    a, b = fused(clouds).surface(), fused(clouds[::-1]).surface()
    np.testing.assert_allclose(a.cloud.xyz, b.cloud.xyz, atol=1e-5)
    np.testing.assert_array_equal(a.count, b.count)
