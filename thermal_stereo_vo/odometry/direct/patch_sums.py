"""The equations of a patch, gathered over its pixels by the slope of the image.

The derivative of a residual by the motion is the slope of the image there times how the pixel
moves.  The eight pixels of a patch move nearly alike, so that it is taken at its middle for all of
them (Engel et al., DSO, TPAMI 2018, section 2.2): sums of products of slopes, brightness and
residuals are gathered first, and become equations of a pose once per patch, not per pixel.
"""

from __future__ import annotations

from numba import njit

from thermal_stereo_vo.odometry.direct.photometric import PATTERN, PIXELS

SLOPES = 9
"""Columns: motion of the target rig (rho, phi), logarithm of scale, lag, inverse depth."""
LOG_SCALE, BY_LAG, BY_RHO = 6, 7, 8
XX, XY, YY, XA, XB, YA, YB, AA, AB, BB, XR, YR, AR, BR = range(14)
"""Weighted sums of products: x and y slope of the image, a and b brightness, r residual."""
SUMS = 14


@njit(cache=True, nogil=True)
def view_patch(  # type: ignore[no-untyped-def]
    stack, slot, camera, T, at, x, y, rho, sx, sy, view
):
    """Write what an image shows of a patch: ``view`` (3, 8); False where it is not seen whole.

    Rows: brightness, and its slopes in the normalised plane of the camera.  ``stack`` (S, H, W, 3)
    images of a pyramid level, of which ``slot`` is meant; ``camera`` fx fy cx cy of that level;
    ``T`` (M, 4, 4) camera from host camera, of which that ``at`` is meant; ``x``, ``y`` and ``rho``
    the point; ``sx`` and ``sy`` how far one pixel of the level is in the host's plane.
    """
    height, width = stack.shape[1], stack.shape[2]
    fx, fy, cx, cy = camera
    r00, r01, r10, r11 = T[at, 0, 0], T[at, 0, 1], T[at, 1, 0], T[at, 1, 1]
    r20, r21 = T[at, 2, 0], T[at, 2, 1]
    c0 = r00 * x + r01 * y + T[at, 0, 2] + rho * T[at, 0, 3]
    c1 = r10 * x + r11 * y + T[at, 1, 2] + rho * T[at, 1, 3]
    c2 = r20 * x + r21 * y + T[at, 2, 2] + rho * T[at, 2, 3]
    for k in range(PIXELS):
        dx, dy = PATTERN[k, 0] * sx, PATTERN[k, 1] * sy
        q2 = c2 + r20 * dx + r21 * dy
        if q2 < 1e-3:
            return False
        iz = 1.0 / q2
        u = fx * (c0 + r00 * dx + r01 * dy) * iz + cx
        v = fy * (c1 + r10 * dx + r11 * dy) * iz + cy
        if not (u >= 1.0 and v >= 1.0 and u < width - 2.0 and v < height - 2.0):
            return False
        i, j = int(u), int(v)
        f, g = u - i, v - j
        w11 = f * g
        w10, w01 = f - w11, g - w11
        w00 = 1.0 - f - w01
        for m in range(3):
            view[m, k] = (
                w00 * stack[slot, j, i, m]
                + w10 * stack[slot, j, i + 1, m]
                + w01 * stack[slot, j + 1, i, m]
                + w11 * stack[slot, j + 1, i + 1, m]
            )
        view[1, k] *= fx
        view[2, k] *= fy
    return True


@njit(cache=True, nogil=True)
def compare_patch(  # type: ignore[no-untyped-def]
    view, patch, trusts, gain, b_host, b_target, huber, r, weights
):
    """Write residuals and weights (8,) of a patch seen as ``view``; returns its energy.

    Residuals are those of ``photometric.linearise_patch``; weights are trust times Huber's.
    """
    energy = 0.0
    for k in range(PIXELS):
        r[k] = view[0, k] - b_target - gain * (patch[k] - b_host)
        size = abs(r[k])
        if size <= huber:
            weights[k] = trusts[k]
            energy += trusts[k] * size * size
        else:
            weights[k] = trusts[k] * huber / size
            energy += trusts[k] * huber * (2.0 * size - huber)
    return energy


@njit(cache=True, nogil=True)
def gather_patch(view, patch, gain, b_host, looseness, r, weights, sums):  # type: ignore[no-untyped-def]
    """Write ``sums`` (SUMS,) of a patch; the derivative by a is -gain (patch - b), by b -1.

    A patch may be off as a whole: that is an unknown of its own, eliminated here (Schur
    complement).  ``looseness`` is its variance relative to a pixel's own (0 holds it at zero).
    Returns what of the energy is explained by it.
    """
    xx = xy = yy = xa = xb = ya = yb = aa = ab = bb = xr = yr = ar = br = 0.0
    for k in range(PIXELS):
        w, x, y = weights[k], view[1, k], view[2, k]
        a = gain * (b_host - patch[k])
        wx, wy, wa, wr = w * x, w * y, w * a, w * r[k]
        xx += wx * x
        xy += wx * y
        yy += wy * y
        xa += wx * a
        ya += wy * a
        aa += wa * a
        xb -= wx
        yb -= wy
        ab -= wa
        bb += w
        xr += wx * r[k]
        yr += wy * r[k]
        ar += wa * r[k]
        br -= wr
    # The derivative by the patch's own offset is that by b.
    share = looseness / (1.0 + looseness * bb)
    xx -= share * xb * xb
    xy -= share * xb * yb
    yy -= share * yb * yb
    xa -= share * xb * ab
    ya -= share * yb * ab
    aa -= share * ab * ab
    xr -= share * xb * br
    yr -= share * yb * br
    ar -= share * ab * br
    explained = share * br * br
    own = 1.0 - share * bb
    xb, yb, ab, bb, br = own * xb, own * yb, own * ab, own * bb, own * br
    sums[XX], sums[XY], sums[YY], sums[XA], sums[XB], sums[YA], sums[YB] = (
        xx,
        xy,
        yy,
        xa,
        xb,
        ya,
        yb,
    )
    sums[AA], sums[AB], sums[BB], sums[XR], sums[YR], sums[AR], sums[BR] = (
        aa,
        ab,
        bb,
        xr,
        yr,
        ar,
        br,
    )
    return explained


@njit(cache=True, nogil=True)
def middle_slopes(T, at, C, camera, arms, x, y, rho, G):  # type: ignore[no-untyped-def]
    """Write ``G`` (2, SLOPES): how the middle of a patch moves in the target's normalised plane.

    ``T`` (M, 4, 4) target rig from host camera, that ``at``; ``C`` (N, 4, 4) target camera from its
    rig and ``arms`` (N, 2, 3) as for ``photometric.linearise_patch``, those of ``camera``.  The
    column of the lag is left as it is.
    """
    t0, t1, t2 = T[at, 0, 3], T[at, 1, 3], T[at, 2, 3]
    p0 = T[at, 0, 0] * x + T[at, 0, 1] * y + T[at, 0, 2] + rho * t0
    p1 = T[at, 1, 0] * x + T[at, 1, 1] * y + T[at, 1, 2] + rho * t1
    p2 = T[at, 2, 0] * x + T[at, 2, 1] * y + T[at, 2, 2] + rho * t2
    c0, c1, c2, c3 = C[camera, 2, 0], C[camera, 2, 1], C[camera, 2, 2], C[camera, 2, 3]
    iz = 1.0 / (c0 * p0 + c1 * p1 + c2 * p2 + rho * c3)
    for i in range(2):
        b0, b1, b2, b3 = C[camera, i, 0], C[camera, i, 1], C[camera, i, 2], C[camera, i, 3]
        here = (b0 * p0 + b1 * p1 + b2 * p2 + rho * b3) * iz
        d0, d1, d2 = (b0 - here * c0) * iz, (b1 - here * c1) * iz, (b2 - here * c2) * iz
        G[i, 0], G[i, 1], G[i, 2] = rho * d0, rho * d1, rho * d2
        G[i, 3] = p1 * d2 - p2 * d1
        G[i, 4] = p2 * d0 - p0 * d2
        G[i, 5] = p0 * d1 - p1 * d0
        G[i, LOG_SCALE] = -rho * (
            d0 * arms[camera, 0, 0] + d1 * arms[camera, 0, 1] + d2 * arms[camera, 0, 2]
            + (arms[camera, 1, i] - here * arms[camera, 1, 2]) * iz
        )  # fmt: skip
        G[i, BY_RHO] = d0 * t0 + d1 * t1 + d2 * t2 + (b3 - here * c3) * iz


@njit(cache=True, nogil=True)
def middle_slopes_at_home(T, arm, drift, camera, x, y, rho, G):  # type: ignore[no-untyped-def]
    """Write ``G`` (2, 3): how the middle moves where another camera saw it at the host's time.

    By the logarithm of scale, the lag and the inverse depth.
    ``T`` (C, 4, 4), ``arm`` (C, 3) and ``drift`` (C, 6) as for ``photometric.resample_patch``,
    those of ``camera``.
    """
    t0, t1, t2 = T[camera, 0, 3], T[camera, 1, 3], T[camera, 2, 3]
    q0 = T[camera, 0, 0] * x + T[camera, 0, 1] * y + T[camera, 0, 2] + rho * t0
    q1 = T[camera, 1, 0] * x + T[camera, 1, 1] * y + T[camera, 1, 2] + rho * t1
    q2 = T[camera, 2, 0] * x + T[camera, 2, 1] * y + T[camera, 2, 2] + rho * t2
    iz = 1.0 / q2
    u, v = q0 * iz, q1 * iz
    turn0, turn1, turn2 = drift[camera, 3], drift[camera, 4], drift[camera, 5]
    lag0 = rho * drift[camera, 0] + turn1 * q2 - turn2 * q1
    lag1 = rho * drift[camera, 1] + turn2 * q0 - turn0 * q2
    lag2 = rho * drift[camera, 2] + turn0 * q1 - turn1 * q0
    G[0, 0] = -rho * (arm[camera, 0] - u * arm[camera, 2]) * iz
    G[1, 0] = -rho * (arm[camera, 1] - v * arm[camera, 2]) * iz
    G[0, 1] = (lag0 - u * lag2) * iz
    G[1, 1] = (lag1 - v * lag2) * iz
    G[0, 2] = (t0 - u * t2) * iz
    G[1, 2] = (t1 - v * t2) * iz


@njit(cache=True, nogil=True)
def warp_of_patch(T, at, T_home, camera, x, y, rho, warp, back):  # type: ignore[no-untyped-def]
    """Write how a patch is distorted from where it was seen at home to the target, and ``back``.

    Both (2, 2), between normalised planes; ``T`` (M, 4, 4) target from host camera, that ``at``;
    ``T_home`` (C, 4, 4) as ``T`` of ``middle_slopes_at_home``.  False where the patch is seen from
    the side.
    """
    u0, u1, v0, v1 = _plane_slopes(T, at, x, y, rho)
    p0, p1, q0, q1 = _plane_slopes(T_home, camera, x, y, rho)
    there, home = u0 * v1 - u1 * v0, p0 * q1 - p1 * q0
    if there == 0.0 or home == 0.0:
        return False
    there, home = 1.0 / there, 1.0 / home
    warp[0, 0], warp[0, 1] = (u0 * q1 - u1 * q0) * home, (u1 * p0 - u0 * p1) * home
    warp[1, 0], warp[1, 1] = (v0 * q1 - v1 * q0) * home, (v1 * p0 - v0 * p1) * home
    back[0, 0], back[0, 1] = (p0 * v1 - p1 * v0) * there, (p1 * u0 - p0 * u1) * there
    back[1, 0], back[1, 1] = (q0 * v1 - q1 * v0) * there, (q1 * u0 - q0 * u1) * there
    return True


@njit(cache=True, nogil=True)
def _plane_slopes(T, at, x, y, rho):  # type: ignore[no-untyped-def]
    """Derivatives of the normalised coordinates (u, v) in a camera by x and y of the host."""
    q0 = T[at, 0, 0] * x + T[at, 0, 1] * y + T[at, 0, 2] + rho * T[at, 0, 3]
    q1 = T[at, 1, 0] * x + T[at, 1, 1] * y + T[at, 1, 2] + rho * T[at, 1, 3]
    q2 = T[at, 2, 0] * x + T[at, 2, 1] * y + T[at, 2, 2] + rho * T[at, 2, 3]
    iz = 1.0 / q2
    u, v = q0 * iz, q1 * iz
    return (
        (T[at, 0, 0] - u * T[at, 2, 0]) * iz,
        (T[at, 0, 1] - u * T[at, 2, 1]) * iz,
        (T[at, 1, 0] - v * T[at, 2, 0]) * iz,
        (T[at, 1, 1] - v * T[at, 2, 1]) * iz,
    )


@njit(cache=True, nogil=True)
def share_slopes(home, at, gain, back, view):  # type: ignore[no-untyped-def]
    """Give ``view`` (3, 8) the mean slopes of both views of a patch, in the target's plane.

    ``home`` (N, 2, 8), that ``at``, are the slopes at the host's time, ``gain`` times as bright
    there; ``back`` as of ``warp_of_patch``.  The slopes are equal where the views agree.  Where
    they differ by noise, a motion that moves both alike must not count as seen: with slopes of
    their own its two parts (Dai et al. 2019, below eq. 6) do not cancel, and the scale looks some
    four times as well known as it is.
    """
    half = 0.5 * gain
    for k in range(PIXELS):
        x, y = home[at, 0, k], home[at, 1, k]
        view[1, k] = 0.5 * view[1, k] + half * (back[0, 0] * x + back[1, 0] * y)
        view[2, k] = 0.5 * view[2, k] + half * (back[0, 1] * x + back[1, 1] * y)


@njit(cache=True, nogil=True)
def relative_to_home(warp, G_home, at, G):  # type: ignore[no-untyped-def]
    """Take from ``G`` (2, SLOPES) how the patch itself moves, ``G_home`` (N, 2, 3), that ``at``.

    Scale, lag and depth move it at home too; ``warp`` as of ``warp_of_patch``.
    """
    for j in range(3):
        p, q = G_home[at, 0, j], G_home[at, 1, j]
        G[0, LOG_SCALE + j] -= warp[0, 0] * p + warp[0, 1] * q
        G[1, LOG_SCALE + j] -= warp[1, 0] * p + warp[1, 1] * q
