"""The residual of one patch between two images, and its Jacobian.

A point is a pixel of its host image with bearing b = (x, y, 1) and inverse depth rho.  With
T = (R, t) from the host camera to the target's rig it is at p = R b + rho t there (the true point
times rho), and (R_c, t_c) takes it to the target camera: q = R_c p + rho t_c.  Eight pixels around
it (the pattern of DSO, Engel et al., TPAMI 2018) move with it at the same inverse depth.  Their
residuals are

    r = (I_target(q) - b_target) - exp(a_target - a_host) (I_host - b_host),

with the affine brightness pair (a, b) of each image (Dai et al. 2019, eq. 3).

Where the target is a camera of another band, the host's brightness says nothing of it: the patch is
sampled again, at each iteration, where that other camera saw it at the host's time (eq. 6).  Both
places depend on the inverse depth, and on the scale s of the map: with lengths of the map in units
of exp(s) metres the lever arms of the cameras are exp(-s) of their length in metres.  How the two
places move is told by one slope, the mean of both views (``patch_sums.share_slopes``).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

PATTERN = np.array(
    [(0, -2), (-1, -1), (1, -1), (-2, 0), (0, 0), (2, 0), (-1, 1), (0, 2)], np.float64
)
PIXELS = len(PATTERN)
COLUMNS = 11
"""Motion of the target rig (rho, phi), a and b of the target, logarithm of scale, lag, inverse
depth."""
SCALE, LAG, RHO = 8, 9, 10


@njit(cache=True, nogil=True)
def sample(image, u, v, out):  # type: ignore[no-untyped-def]
    """Bilinear brightness and gradients of (H, W, 3) at (u, v); False too near to the border."""
    height, width = image.shape[0], image.shape[1]
    if not (u >= 1.0 and v >= 1.0 and u < width - 2.0 and v < height - 2.0):
        return False
    x, y = int(u), int(v)
    fx, fy = np.float32(u - x), np.float32(v - y)
    w11 = fx * fy
    w10, w01 = fx - w11, fy - w11
    w00 = np.float32(1.0) - fx - w01
    for k in range(3):
        out[k] = (
            w00 * image[y, x, k]
            + w10 * image[y, x + 1, k]
            + w01 * image[y + 1, x, k]
            + w11 * image[y + 1, x + 1, k]
        )
    return True


@njit(cache=True, nogil=True)
def linearise_patch(  # type: ignore[no-untyped-def]
    image, camera, scale, T, T_camera_rig, arms, bearing, rho, step, patch, gain, b_host, b_target,
    r, J
):  # fmt: skip
    """Residuals ``r`` (8,) and Jacobian ``J`` (8, 11) of a patch; False where it is not seen whole.

    ``image`` (H, W, 3) of the target at a pyramid level; ``camera`` (4,) fx fy cx cy of level 0 and
    ``scale`` 2^-level; ``T`` (4, 4) target rig from host camera; ``T_camera_rig`` (4, 4) of the
    target; ``arms`` (2, 3) what changes with the scale: the lever arm of the host camera in axes of
    the target's rig, and that of the target camera in its own axes; ``step`` (2,) how far one pixel
    of the level is in the host's normalised plane; ``patch`` (8,) host brightness.  Columns of J:
    left perturbation of the target rig (6), a and b of the target, logarithm of scale, lag (left as
    it is), rho.
    """
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    s = np.empty(3, np.float32)
    for k in range(PIXELS):
        x = bearing[0] + PATTERN[k, 0] * step[0]
        y = bearing[1] + PATTERN[k, 1] * step[1]
        p0 = T[0, 0] * x + T[0, 1] * y + T[0, 2] + rho * T[0, 3]
        p1 = T[1, 0] * x + T[1, 1] * y + T[1, 2] + rho * T[1, 3]
        p2 = T[2, 0] * x + T[2, 1] * y + T[2, 2] + rho * T[2, 3]
        C = T_camera_rig
        q0 = C[0, 0] * p0 + C[0, 1] * p1 + C[0, 2] * p2 + rho * C[0, 3]
        q1 = C[1, 0] * p0 + C[1, 1] * p1 + C[1, 2] * p2 + rho * C[1, 3]
        q2 = C[2, 0] * p0 + C[2, 1] * p1 + C[2, 2] * p2 + rho * C[2, 3]
        if q2 < 1e-3:
            return False
        iz = 1.0 / q2
        if not sample(image, (fx * q0 * iz + cx) * scale, (fy * q1 * iz + cy) * scale, s):
            return False
        host = patch[k] - b_host
        r[k] = s[0] - b_target - gain * host
        g0 = s[1] * fx * scale * iz
        g1 = s[2] * fy * scale * iz
        g2 = -(g0 * q0 + g1 * q1) * iz
        d0 = C[0, 0] * g0 + C[1, 0] * g1 + C[2, 0] * g2
        d1 = C[0, 1] * g0 + C[1, 1] * g1 + C[2, 1] * g2
        d2 = C[0, 2] * g0 + C[1, 2] * g1 + C[2, 2] * g2
        J[k, 0], J[k, 1], J[k, 2] = rho * d0, rho * d1, rho * d2
        J[k, 3] = p1 * d2 - p2 * d1
        J[k, 4] = p2 * d0 - p0 * d2
        J[k, 5] = p0 * d1 - p1 * d0
        J[k, 6] = -gain * host
        J[k, 7] = -1.0
        J[k, SCALE] = -rho * (
            d0 * arms[0, 0] + d1 * arms[0, 1] + d2 * arms[0, 2]
            + g0 * arms[1, 0] + g1 * arms[1, 1] + g2 * arms[1, 2]
        )  # fmt: skip
        J[k, RHO] = (
            d0 * T[0, 3] + d1 * T[1, 3] + d2 * T[2, 3]
            + g0 * C[0, 3] + g1 * C[1, 3] + g2 * C[2, 3]
        )  # fmt: skip
    return True


@njit(cache=True, nogil=True)
def resample_patch(  # type: ignore[no-untyped-def]
    image, camera, T, arm, drift, bearing, rho, step, trust_gradient, patch, trust, slopes
):
    """Take a patch from where another camera saw it at the host's time (Dai et al. 2019, eq. 6).

    The plain reference, pixel by pixel and with the slopes of this image alone: tests hold
    ``patch_sums.view_patch`` and ``patch_sums.middle_slopes_at_home`` to it, no method runs it.
    ``image`` (H, W, 3) and ``camera`` (4,) of that other camera; ``T`` (4, 4) there from the host
    camera, ``arm`` (3,) the part of its translation that changes with the scale, ``drift`` (6,) its
    left perturbation by the lag.  Writes ``patch`` and ``trust`` (8,) and ``slopes`` (3, 8), the
    derivatives of the patch by the logarithm of scale, the lag and rho.  False where it is not
    seen whole.
    """
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    c2 = trust_gradient * trust_gradient
    s = np.empty(3, np.float32)
    for k in range(PIXELS):
        x = bearing[0] + PATTERN[k, 0] * step[0]
        y = bearing[1] + PATTERN[k, 1] * step[1]
        q0 = T[0, 0] * x + T[0, 1] * y + T[0, 2] + rho * T[0, 3]
        q1 = T[1, 0] * x + T[1, 1] * y + T[1, 2] + rho * T[1, 3]
        q2 = T[2, 0] * x + T[2, 1] * y + T[2, 2] + rho * T[2, 3]
        if q2 < 1e-3:
            return False
        iz = 1.0 / q2
        if not sample(image, fx * q0 * iz + cx, fy * q1 * iz + cy, s):
            return False
        patch[k] = s[0]
        trust[k] = c2 / (c2 + s[1] * s[1] + s[2] * s[2])
        g0, g1 = s[1] * fx * iz, s[2] * fy * iz
        g2 = -(g0 * q0 + g1 * q1) * iz
        slopes[0, k] = -rho * (g0 * arm[0] + g1 * arm[1] + g2 * arm[2])
        slopes[1, k] = (
            g0 * (rho * drift[0] + drift[4] * q2 - drift[5] * q1)
            + g1 * (rho * drift[1] + drift[5] * q0 - drift[3] * q2)
            + g2 * (rho * drift[2] + drift[3] * q1 - drift[4] * q0)
        )
        slopes[2, k] = g0 * T[0, 3] + g1 * T[1, 3] + g2 * T[2, 3]
    return True


@njit(cache=True, nogil=True)
def patch_energy(r, trust, huber):  # type: ignore[no-untyped-def]
    """Weighted squared size of the (8,) residuals, flattened beyond ``huber``."""
    energy = 0.0
    for k in range(PIXELS):
        size = abs(r[k])
        if size <= huber:
            energy += trust[k] * size * size
        else:
            energy += trust[k] * huber * (2.0 * size - huber)
    return energy


@njit(cache=True, nogil=True)
def huber_weight(r, huber):  # type: ignore[no-untyped-def]
    """Weight of a residual under the Huber norm."""
    size = abs(r)
    return 1.0 if size <= huber else huber / size


@njit(cache=True, nogil=True)
def take_patches(image, pixels, scale, trust_gradient, patches, trusts):  # type: ignore[no-untyped-def]
    """Brightness and trust of the patches around N pixels (x, y of level 0) of one host level.

    ``image`` (H, W, 3); writes ``patches`` and ``trusts`` (N, 8): c^2 / (c^2 + |gradient|^2), for
    steep brightness forgives no interpolation.  A patch that leaves the image gets trust 0.
    """
    s = np.empty(3, np.float32)
    c2 = trust_gradient * trust_gradient
    for n in range(len(pixels)):
        u, v = pixels[n, 0] * scale, pixels[n, 1] * scale
        for k in range(PIXELS):
            if sample(image, u + PATTERN[k, 0], v + PATTERN[k, 1], s):
                patches[n, k] = s[0]
                trusts[n, k] = c2 / (c2 + s[1] * s[1] + s[2] * s[2])
            else:
                trusts[n] = 0.0
                break


def residuals_reference(
    image: NDArray[np.float32],
    camera: NDArray[np.float64],
    scale: float,
    T_camera_host: NDArray[np.float64],
    bearing: NDArray[np.float64],
    rho: float,
    step: NDArray[np.float64],
    patch: NDArray[np.float64],
    host: tuple[float, float],
    target: tuple[float, float],
) -> NDArray[np.float64]:
    """(8,) residuals of a patch with points in metres: the plain form of ``linearise_patch``."""
    from scipy.ndimage import map_coordinates

    rays = np.column_stack([bearing[:2] + PATTERN * step, np.ones(PIXELS)])
    points = rays / rho @ T_camera_host[:3, :3].T + T_camera_host[:3, 3]
    u = (camera[0] * points[:, 0] / points[:, 2] + camera[2]) * scale
    v = (camera[1] * points[:, 1] / points[:, 2] + camera[3]) * scale
    seen = map_coordinates(image[..., 0].astype(np.float64), [v, u], order=1)
    gain = np.exp(target[0] - host[0])
    return np.asarray(seen - target[1] - gain * (patch - host[1]))
