"""One frame against patches whose place is known."""

from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.core.transforms import exp_se3, inverse, log_se3
from thermal_stereo_vo.odometry.direct.frame_alignment import align_frame, linearise_frame
from thermal_stereo_vo.odometry.direct.photometric import residuals_reference, take_patches

from .smooth_world import CAMERAS, T_RIG_CAMERA, smooth_image

HUBER, GATE, N = 12.0, 1e4, 40


@pytest.fixture
def scene(rng):
    """Points of two keyframes and the images of one frame, as the kernels take them."""
    hosts = np.sort(rng.integers(0, 2, N))
    host_cameras = np.zeros(N, np.int64)
    bearings = np.column_stack([rng.uniform(-0.3, 0.25, (N, 2)), np.ones(N)])
    return {
        "T": exp_se3([0.02, 0.03, -0.02, 0.01, 0.015, -0.02]),
        "light": np.array([[0.05, 2.0], [-0.1, -1.0]]),
        "images": (smooth_image(rng), smooth_image(rng)),
        "T_host_world": np.stack([np.eye(4), exp_se3([0.05, 0, 0.03, 0.01, 0, 0])]),
        "host_light": rng.normal(size=(2, 2, 2)) * [0.1, 2.0],
        "hosts": hosts,
        "host_cameras": host_cameras,
        "bearings": bearings,
        "rhos": rng.uniform(0.1, 0.5, N),
        "information": rng.uniform(1e3, 1e5, N),
        "patches": rng.normal(size=(N, 8)) * 20,
        "trusts": rng.uniform(0.4, 1.0, (N, 8)),
    }


def residuals(scene, step, depth_step):
    """(2, N, 8) by the plain form after a step of pose and brightness (10,) and depths (N,)."""
    T = exp_se3(step[:6]) @ scene["T"]
    light = scene["light"] + step[6:].reshape(2, 2)
    out = np.empty((2, N, 8))
    for c in range(2):
        for n in range(N):
            h = scene["hosts"][n]
            out[c, n] = residuals_reference(
                scene["images"][c], CAMERAS[c], 1.0,
                inverse(T_RIG_CAMERA[c]) @ T @ inverse(scene["T_host_world"][h]),
                scene["bearings"][n], scene["rhos"][n] + depth_step[n], 1 / CAMERAS[0, :2],
                scene["patches"][n], tuple(scene["host_light"][h, 0]), tuple(light[c]),
            )  # fmt: skip
    return out


def arguments(scene, free_depth, bands=False, bolometers=None):
    bolometers = np.zeros(2, np.bool_) if bolometers is None else bolometers
    T_camera_rig = np.stack([inverse(T) for T in T_RIG_CAMERA])
    return (
        tuple(i[None] for i in scene["images"]), np.ones(2, bool), CAMERAS, T_camera_rig, 1.0,
        scene["T_host_world"], scene["host_light"], np.tile(T_RIG_CAMERA, (2, 1, 1, 1)),
        scene["hosts"], scene["host_cameras"], scene["bearings"],
        scene["rhos"], scene["information"], 1 / CAMERAS[:, :2], scene["patches"], scene["trusts"],
        bands, bolometers, np.zeros(2), HUBER, GATE, free_depth,
    )  # fmt: skip


@pytest.mark.parametrize("free_depth", [False, True])
def test_equations_are_those_of_the_dense_problem(scene, free_depth):
    A, g, energies = np.zeros((10, 10)), np.zeros(10), np.empty((2, N))
    cost, seen = linearise_frame(
        scene["T"], scene["light"], *arguments(scene, free_depth), A, g, energies
    )
    assert seen == 2 * N
    none, nowhere = np.zeros(10), np.zeros(N)
    r = residuals(scene, none, nowhere)
    J = np.empty((*r.shape, 10 + N))
    for i in range(10):
        h = 1e-3 * np.eye(10)[i]
        J[..., i] = (residuals(scene, h, nowhere) - residuals(scene, -h, nowhere)) / 2e-3
    J[..., 10:] = 0.0
    d = (residuals(scene, none, nowhere + 1e-3) - residuals(scene, none, nowhere - 1e-3)) / 2e-3
    for n in range(N):
        J[:, n, :, 10 + n] = d[:, n]
    w = scene["trusts"] * np.minimum(1.0, HUBER / np.abs(r))
    rows, flat = J.reshape(-1, 10 + N), (w * r).ravel()
    H, b = rows.T @ (w.reshape(-1, 1) * rows), -rows.T @ flat
    expected_A, expected_g = H[:10, :10], b[:10]
    if free_depth:
        Hdd = np.diag(H)[10:] + scene["information"]
        expected_A = expected_A - H[:10, 10:] @ (H[:10, 10:] / Hdd).T
        expected_g = expected_g - H[:10, 10:] @ (b[10:] / Hdd)
    unit = np.sqrt(np.diag(H)[:10])
    np.testing.assert_allclose(
        A / np.outer(unit, unit), expected_A / np.outer(unit, unit), atol=0.02
    )
    np.testing.assert_allclose(g / unit, expected_g / unit, atol=4.0)
    assert np.abs(expected_g / unit).max() > 50.0
    size = np.abs(r)
    energy = scene["trusts"] * np.where(size <= HUBER, r**2, HUBER * (2 * size - HUBER))
    assert cost == pytest.approx(energy.sum() / (2 * N), rel=1e-4)
    np.testing.assert_allclose(
        energies, energy.sum(axis=2) / scene["trusts"].sum(axis=1), rtol=1e-3, atol=1e-3
    )


def test_a_camera_of_another_band_looks_for_its_own_points_only(scene):
    A, g, energies = np.zeros((10, 10)), np.zeros(10), np.empty((2, N))
    given = arguments(scene, False, True)
    _, seen = linearise_frame(scene["T"], scene["light"], *given, A, g, energies)
    assert seen == N
    assert np.isfinite(energies[0]).all()
    assert np.isnan(energies[1]).all()
    np.testing.assert_array_equal(A[8:], 0.0)


def test_residuals_of_a_bolometer_count_as_they_weigh(scene):
    found = []
    for bolometers in (np.zeros(2, np.bool_), np.ones(2, np.bool_)):
        A, g, energies = np.zeros((10, 10)), np.zeros(10), np.empty((2, N))
        given = arguments(scene, False, False, bolometers)
        linearise_frame(scene["T"], scene["light"], *given, A, g, energies)
        found.append(energies * (8.0 if bolometers[0] else scene["trusts"].sum(axis=1)))
    np.testing.assert_allclose(found[0], found[1], rtol=1e-9)


def test_a_frame_is_found_from_some_way_off(scene):
    """The frame is the first keyframe itself: pose and brightness must come back exactly."""
    image = scene["images"][0]
    pixels = scene["bearings"][:, :2] * CAMERAS[0, :2] + CAMERAS[0, 2:]
    take_patches(image, pixels, 1.0, 50.0, scene["patches"], scene["trusts"])
    scene |= {"hosts": np.zeros(N, np.int64), "host_light": np.zeros((2, 2, 2))}
    brighter = (1.3 * image + np.array([5, 0, 0], np.float32)).astype(np.float32)
    scene["images"] = (brighter, np.zeros((1, 1, 3), np.float32))
    given = list(arguments(scene, False))
    given[1] = np.array([True, False])
    T, light = exp_se3([0.03, -0.02, 0.02, 0.01, 0.01, -0.01]), np.zeros((2, 2))
    A, g, energies = np.zeros((10, 10)), np.zeros(10), np.full((2, N), np.nan)
    cost, seen, iterations = align_frame(T, light, *given, 30, A, g, energies)
    assert seen == N
    assert 2 <= iterations <= 30
    assert cost < 0.05
    assert np.linalg.norm(log_se3(T)) < 1e-3
    np.testing.assert_allclose(light[0], [np.log(1.3), 5.0], atol=0.1)
    np.testing.assert_array_equal(light[1], 0.0)
    assert np.isnan(energies[1]).all()


def test_an_empty_view_is_no_place_to_start_from(scene):
    given = list(arguments(scene, False))
    given[1] = np.array([False, False])
    T, light = np.eye(4), np.zeros((2, 2))
    A, g, energies = np.zeros((10, 10)), np.zeros(10), np.full((2, N), np.nan)
    cost, seen, iterations = align_frame(T, light, *given, 10, A, g, energies)
    assert (cost, seen, iterations) == (np.inf, 0, 0)
    np.testing.assert_array_equal(T, np.eye(4))
