"""One patch: the kernel against its plain form, and its Jacobian against differences."""

from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.core.transforms import exp_se3, inverse
from thermal_stereo_vo.odometry.direct.photometric import (
    LAG,
    PATTERN,
    linearise_patch,
    patch_energy,
    resample_patch,
    residuals_reference,
    take_patches,
)

from .smooth_world import CAMERAS, T_RIG_CAMERA, smooth_image

STEPS = [8e-3] * 6 + [1e-3] * 2 + [0.05, 0.04]
"""About a pixel each: the slope between neighbours is what interpolated gradients stand for."""


@pytest.fixture
def patch(rng):
    """Everything a residual depends on."""
    return {
        "image": smooth_image(rng),
        "T_rig_host": exp_se3([0.05, -0.03, 0.04, 0.02, -0.03, 0.05]),
        "arm": np.array([0.1, -0.2, 0.05]),
        "bearing": np.array([0.1, -0.05, 1.0]),
        "rho": 0.4,
        "patch": rng.normal(size=8) * 30,
        "host": np.array([0.1, 4.0]),
        "target": np.array([-0.2, -3.0]),
    }


def linearised(patch, camera, scale=1.0):
    r, J = np.empty(8), np.zeros((8, 11))
    inside = linearise_patch(
        patch["image"], CAMERAS[camera], scale, patch["T_rig_host"], inverse(T_RIG_CAMERA[camera]),
        np.stack([patch["arm"], inverse(T_RIG_CAMERA[camera])[:3, 3]]), patch["bearing"],
        patch["rho"], 1.0 / CAMERAS[0, :2] / scale, patch["patch"],
        np.exp(patch["target"][0] - patch["host"][0]), patch["host"][1], patch["target"][1], r, J,
    )  # fmt: skip
    return inside, r, J


def reference(patch, camera, scale=1.0):
    # The host camera sits at an arm of the rig, the target at that of its own: both shrink.
    s = np.exp(-patch.get("log_scale", 0.0))
    T_rig_host, T_rig_camera = patch["T_rig_host"].copy(), T_RIG_CAMERA[camera].copy()
    T_rig_host[:3, 3] += (s - 1.0) * patch["arm"]
    T_rig_camera[:3, 3] *= s
    return residuals_reference(
        patch["image"], CAMERAS[camera], scale, inverse(T_rig_camera) @ T_rig_host,
        patch["bearing"], patch["rho"], 1.0 / CAMERAS[0, :2] / scale, patch["patch"],
        tuple(patch["host"]), tuple(patch["target"]),
    )  # fmt: skip


@pytest.mark.parametrize("camera", [0, 1])
@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_residuals_are_those_of_the_plain_form(patch, camera, scale):
    inside, r, _ = linearised(patch, camera, scale)
    assert inside
    np.testing.assert_allclose(r, reference(patch, camera, scale), atol=2e-4)


@pytest.mark.parametrize("camera", [0, 1])
def test_jacobian_is_what_differences_say(patch, camera):
    _, _, J = linearised(patch, camera)
    J = np.delete(J, LAG, axis=1)  # left to the window, which knows how the rig moves
    numeric = np.zeros((8, 10))
    for column in range(10):
        ends = []
        for sign in (-1.0, 1.0):
            moved = dict(patch)
            h = sign * STEPS[column]
            if column < 6:
                moved["T_rig_host"] = exp_se3(h * np.eye(6)[column]) @ patch["T_rig_host"]
            elif column < 8:
                moved["target"] = patch["target"] + h * np.eye(2)[column - 6]
            elif column == 8:
                moved["log_scale"] = h
            else:
                moved["rho"] = patch["rho"] + h
            ends.append(reference(moved, camera))
        numeric[:, column] = (ends[1] - ends[0]) / (2 * STEPS[column])
    scale = np.abs(numeric).max(axis=0)
    assert (scale > 0.1).all()
    np.testing.assert_allclose(J / scale, numeric / scale, atol=0.08)


def test_a_patch_is_sampled_again_where_another_camera_saw_it(patch):
    """Brightness, and its derivatives by scale, lag and depth, against differences."""
    arm, drift = np.array([0.15, 0.02, -0.01]), np.array([0.2, -0.1, 0.1, 0.1, -0.15, 0.3])
    T = exp_se3([0.15, 0.02, -0.03, 0.01, -0.02, 0.015])

    def sampled(log_scale=0.0, lag_s=0.0, rho=patch["rho"]):
        moved = T.copy()
        moved[:3, 3] += (np.exp(-log_scale) - 1.0) * arm
        out, trust, slopes = np.zeros(8), np.zeros(8), np.zeros((3, 8))
        assert resample_patch(
            patch["image"], CAMERAS[1], exp_se3(lag_s * drift) @ moved, arm, drift,
            patch["bearing"], rho, 1.0 / CAMERAS[0, :2], 30.0, out, trust, slopes,
        )  # fmt: skip
        return out, trust, slopes

    out, trust, slopes = sampled()
    plain = residuals_reference(
        patch["image"], CAMERAS[1], 1.0, T, patch["bearing"], patch["rho"], 1.0 / CAMERAS[0, :2],
        np.zeros(8), (0.0, 0.0), (0.0, 0.0),
    )  # fmt: skip
    np.testing.assert_allclose(out, plain, atol=2e-4)
    assert ((trust > 0.1) & (trust < 1.0)).all()
    for row, (name, at, step) in enumerate(
        [("log_scale", 0.0, 0.05), ("lag_s", 0.0, 0.02), ("rho", patch["rho"], 0.04)]
    ):
        numeric = (sampled(**{name: at + step})[0] - sampled(**{name: at - step})[0]) / (2 * step)
        assert np.abs(numeric).max() > 1.0
        np.testing.assert_allclose(slopes[row], numeric, atol=0.08 * np.abs(numeric).max())


def test_a_patch_that_leaves_the_image_or_lies_behind_is_not_seen(patch):
    for bearing in ([0.7, 0.0, 1.0], [-0.7, 0.0, 1.0], [0.0, 0.6, 1.0]):
        assert not linearised(dict(patch, bearing=np.array(bearing)), 0)[0]
    behind = exp_se3([0.0, 0.0, -3.0, 0.0, 0.0, 0.0])
    assert not linearised(dict(patch, T_rig_host=behind), 0)[0]


def test_energy_is_huber_s(rng):
    trust = rng.uniform(0.2, 1.0, 8)
    r = np.array([0.5, -1.0, 3.0, -8.0, 20.0, 0.0, 9.0, -100.0])
    size = np.abs(r)
    expected = np.where(size <= 3.0, r * r, 3.0 * (2 * size - 3.0))
    assert patch_energy(r, trust, 3.0) == pytest.approx(np.sum(trust * expected))


def test_patches_are_taken_around_the_pixel_and_steep_ones_are_trusted_less(rng):
    image = smooth_image(rng)
    pixels = np.array([[80.0, 60.0], [40.0, 30.0], [1.0, 60.0]])
    patches, trusts = np.zeros((3, 8)), np.ones((3, 8))
    take_patches(image, pixels, 1.0, 5.0, patches, trusts)
    x, y = (pixels[0] + PATTERN).astype(int).T
    np.testing.assert_allclose(patches[0], image[y, x, 0], rtol=1e-5)
    slope2 = np.sum(image[y, x, 1:].astype(float) ** 2, axis=1)
    np.testing.assert_allclose(trusts[0], 25.0 / (25.0 + slope2), rtol=1e-4)
    assert (trusts[2] == 0.0).all()
