"""Images so smooth that interpolation errors vanish, and points before two cameras."""

from __future__ import annotations

import numpy as np

from thermal_stereo_vo.core.transforms import exp_se3, make_transform
from thermal_stereo_vo.odometry.direct.photometric_bundle import PhotometricProblem

WIDTH, HEIGHT = 160, 120
CAMERAS = np.array([[150.0, 148.0, 79.0, 61.0], [140.0, 141.0, 82.0, 58.0]])
T_RIG_CAMERA = np.stack(
    [np.eye(4), make_transform(exp_se3([0, 0, 0, 0.01, -0.02, 0.015])[:3, :3], [0.2, 0.01, -0.02])]
)


def smooth_image(rng, shape=(HEIGHT, WIDTH)):
    """(H, W, 3) float32: waves of 50 to 90 px and their exact gradients."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    out = np.zeros((*shape, 3))
    for _ in range(4):
        k = 2 * np.pi / rng.uniform(50, 90)
        angle, phase, size = rng.uniform(0, 2 * np.pi), rng.uniform(0, 7), rng.uniform(20, 40)
        kx, ky = k * np.cos(angle), k * np.sin(angle)
        wave = kx * x + ky * y + phase
        out[..., 0] += size * np.sin(wave)
        out[..., 1] += size * kx * np.cos(wave)
        out[..., 2] += size * ky * np.cos(wave)
    return out.astype(np.float32)


def window_problem(rng, points=12, keyframes=3) -> PhotometricProblem:
    """Keyframes near each other that all see all points; brightness does not fit the patches."""
    images = tuple(np.stack([smooth_image(rng) for _ in range(keyframes)]) for _ in range(2))
    T_k_w = np.stack([exp_se3(rng.normal(size=6) * 0.03) for _ in range(keyframes)])
    hosts = np.sort(np.arange(points) % keyframes)
    host_cameras = np.zeros(points, np.int64)
    host_cameras[points // 2 :: 2] = 1
    order = np.lexsort((host_cameras, hosts))
    bearings = np.column_stack(
        [rng.uniform(-0.25, 0.2, points), rng.uniform(-0.2, 0.2, points), np.ones(points)]
    )
    seen = np.ones((points, keyframes, 2), bool)
    seen[np.arange(points), hosts[order], host_cameras[order]] = False
    seen[1, 2] = False
    return PhotometricProblem(
        images=images,
        slots=np.arange(keyframes),
        T_k_w=T_k_w,
        twists=rng.normal(size=(keyframes, 6)) * 0.3,
        lags_s=np.array([0.0, 0.02]),
        brightness=rng.normal(size=(keyframes, 2, 2)) * [0.1, 3.0],
        cameras=CAMERAS,
        T_rig_camera=T_RIG_CAMERA,
        hosts=hosts[order],
        host_cameras=host_cameras[order],
        bearings=bearings,
        rhos=rng.uniform(0.1, 0.6, points),
        rho_priors=rng.uniform(0.1, 0.6, points),
        prior_information=rng.uniform(0.0, 1e4, points) * (np.arange(points) % 2),
        patches=rng.normal(size=(points, 8)) * 30,
        trusts=rng.uniform(0.3, 1.0, (points, 8)),
        seen=seen,
        bands=False,
        bolometers=np.zeros(2, np.bool_),
        trust_gradient=1e9,
        looseness=np.zeros(2),
        guesses_err_together=True,
    )
