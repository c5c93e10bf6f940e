"""Where a patch of a keyframe lies in another image, to a small part of a pixel.

Inverse compositional Lucas-Kanade (Baker & Matthews, IJCV 56, 2004) for a translation, coarse to
fine.  The template is the keyframe patch warped by the affinity that depth and predicted motion
give, as in SVO (Forster et al., ICRA 2014).  Mean and contrast of both patches are taken out, so
that offsets after a flat-field correction and a changed gain do no harm.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, nogil=True)
def _inside(x, y, margin, width, height):  # type: ignore[no-untyped-def]
    return (
        x - margin >= 0.0
        and y - margin >= 0.0
        and x + margin < width - 1.0
        and (y + margin < height - 1.0)
    )


@njit(cache=True, nogil=True)
def _sample_template(image, x, y, a, b, c, d, radius, out):  # type: ignore[no-untyped-def]
    """Bilinear samples of a square of side 2 * radius + 1 warped by [[a, b], [c, d]]."""
    side = 2 * radius + 1
    for j in range(side):
        dy = j - radius
        for i in range(side):
            dx = i - radius
            sx = x + a * dx + b * dy
            sy = y + c * dx + d * dy
            ix, iy = int(sx), int(sy)
            fx, fy = np.float32(sx - ix), np.float32(sy - iy)
            row, below = image[iy], image[iy + 1]
            top = row[ix] + fx * (row[ix + 1] - row[ix])
            bottom = below[ix] + fx * (below[ix + 1] - below[ix])
            out[j * side + i] = top + fy * (bottom - top)


@njit(cache=True, nogil=True)
def _sample_square(image, x, y, radius, out):  # type: ignore[no-untyped-def]
    """Bilinear samples of an upright square; one weight serves all of them.  Returns the mean."""
    side = 2 * radius + 1
    ix, iy = int(x) - radius, int(y) - radius
    fx, fy = np.float32(x - int(x)), np.float32(y - int(y))
    w11 = fx * fy
    w10, w01 = fx - w11, fy - w11
    w00 = np.float32(1.0) - fx - fy + w11
    total = np.float32(0.0)
    for j in range(side):
        row = image[iy + j, ix : ix + side + 1]
        below = image[iy + j + 1, ix : ix + side + 1]
        target = out[j * side : (j + 1) * side]
        for i in range(side):
            value = w00 * row[i] + w10 * row[i + 1] + w01 * below[i] + w11 * below[i + 1]
            target[i] = value
            total += value
    return total / np.float32(side * side)


@njit(cache=True, nogil=True)
def align_patches(  # type: ignore[no-untyped-def]
    keyframes,
    image,
    slots,
    host_px,
    warps,
    start_px,
    top_level,
    radius,
    max_iterations,
    out_px,
    out_score,
):
    """Align N keyframe patches to one image.

    ``keyframes``: tuple of (slots, H, W) float32 stacks; ``image``: tuple of (H, W) float32 levels;
    ``slots`` (N,) int64 keyframe of each patch; ``host_px`` (N, 2) its centre there; ``warps``
    (N, 2, 2) d(pixel here) / d(pixel there); ``start_px`` (N, 2) where to start, NaN to skip.
    Writes ``out_px`` (N, 2) and ``out_score`` (N,): the correlation (ZNCC) of the patches, or -1
    where the alignment left the image, found no texture or ran away.
    """
    side = 2 * radius + 1
    count = side * side
    outer = side + 2
    wide = np.empty(outer * outer, np.float32)
    template = np.empty(count, np.float32)
    gx, gy = np.empty(count, np.float32), np.empty(count, np.float32)
    patch = np.empty(count, np.float32)
    for n in range(len(slots)):
        out_score[n] = -1.0
        x, y = start_px[n, 0], start_px[n, 1]
        out_px[n, 0], out_px[n, 1] = x, y
        a, b, c, d = warps[n, 0, 0], warps[n, 0, 1], warps[n, 1, 0], warps[n, 1, 1]
        determinant = a * d - b * c
        if not (np.isfinite(x) and np.isfinite(y) and 0.2 < determinant < 5.0):
            continue
        ia, ib, ic, id_ = d / determinant, -b / determinant, -c / determinant, a / determinant
        reach = (radius + 1) * max(abs(ia) + abs(ib), abs(ic) + abs(id_))
        score = -1.0
        for level in range(top_level, -1, -1):
            score = -1.0
            scale = 1.0 / (1 << level)
            source, target = keyframes[level][slots[n]], image[level]
            height, width = target.shape
            hx, hy = host_px[n, 0] * scale, host_px[n, 1] * scale
            cx, cy = x * scale, y * scale
            if not _inside(hx, hy, reach + 1.0, width, height) or not _inside(
                cx, cy, radius + 1.0, width, height
            ):
                continue  # too near to the border at this level; the next may do
            _sample_template(source, hx, hy, ia, ib, ic, id_, radius + 1, wide)
            mean = np.float32(0.0)
            for j in range(side):
                for i in range(side):
                    k = j * side + i
                    w = (j + 1) * outer + i + 1
                    template[k] = wide[w]
                    mean += wide[w]
                    gx[k] = np.float32(0.5) * (wide[w + 1] - wide[w - 1])
                    gy[k] = np.float32(0.5) * (wide[w + outer] - wide[w - outer])
            mean /= np.float32(count)
            h00 = h01 = h11 = energy = np.float32(0.0)
            sum_gx = sum_gy = np.float32(0.0)
            for k in range(count):
                template[k] -= mean
                energy += template[k] * template[k]
                sum_gx += gx[k]
                sum_gy += gy[k]
            # Taking the mean out of the residual takes it out of the Jacobian too.
            sum_gx /= np.float32(count)
            sum_gy /= np.float32(count)
            for k in range(count):
                gx[k] -= sum_gx
                gy[k] -= sum_gy
                h00 += gx[k] * gx[k]
                h01 += gx[k] * gy[k]
                h11 += gy[k] * gy[k]
            det = h00 * h11 - h01 * h01
            if not (energy > 0.0 and det > 1e-6 * (h00 + h11) * (h00 + h11)):
                continue
            x0, y0 = cx, cy
            for _ in range(max_iterations):
                if not _inside(cx, cy, radius + 1.0, width, height):
                    score = -1.0
                    break
                patch_mean = _sample_square(target, cx, cy, radius, patch)
                patch_energy = cross = np.float32(0.0)
                for k in range(count):
                    value = patch[k] - patch_mean
                    patch[k] = value
                    patch_energy += value * value
                    cross += value * template[k]
                if not patch_energy > 0.0:
                    score = -1.0
                    break
                score = cross / np.sqrt(energy * patch_energy)
                gain = np.sqrt(energy / patch_energy)
                gain = min(max(gain, np.float32(0.5)), np.float32(2.0))
                b0 = b1 = np.float32(0.0)
                for k in range(count):
                    residual = template[k] - gain * patch[k]
                    b0 += gx[k] * residual
                    b1 += gy[k] * residual
                ux = (h11 * b0 - h01 * b1) / det
                uy = (h00 * b1 - h01 * b0) / det
                cx += ux
                cy += uy
                if ux * ux + uy * uy < 1e-4:
                    break
            if abs(cx - x0) > side or abs(cy - y0) > side:
                score = -1.0
                if level == 0:
                    break
                continue
            if score > 0.0:
                x, y = cx / scale, cy / scale
        height, width = image[0].shape
        if score > 0.0 and _inside(x, y, 1.0, width, height):
            out_px[n, 0], out_px[n, 1] = x, y
            out_score[n] = score


@njit(cache=True, nogil=True)
def search_disparity(  # type: ignore[no-untyped-def]
    left, right, pixels, radius, min_disparity, max_disparity, out_disparity, out_score
):
    """Best integer disparity of each left pixel by correlation along the row.

    ``left``, ``right`` (H, W) float32; ``pixels`` (N, 2) int64.  Writes ``out_disparity`` (N,) and
    ``out_score`` (N,) ZNCC; -1 where there is none, or where another peak (more than 2 px away) is
    nearly as good.
    """
    height, width = left.shape
    side = 2 * radius + 1
    count = side * side
    template = np.empty(count, np.float32)
    scores = np.empty(max_disparity - min_disparity + 1, np.float32)
    for n in range(len(pixels)):
        out_disparity[n] = 0
        out_score[n] = -1.0
        x, y = pixels[n, 0], pixels[n, 1]
        if not (radius <= x < width - radius and radius <= y < height - radius):
            continue
        mean = np.float32(0.0)
        for j in range(side):
            row = left[y - radius + j, x - radius : x + radius + 1]
            for i in range(side):
                template[j * side + i] = row[i]
                mean += row[i]
        mean /= np.float32(count)
        energy = np.float32(0.0)
        for k in range(count):
            template[k] -= mean
            energy += template[k] * template[k]
        if not energy > 0.0:
            continue
        best, index = np.float32(-1.0), min_disparity - 1
        last = min(max_disparity, x - radius)
        for disparity in range(min_disparity, last + 1):
            xr = x - disparity
            total = squares = cross = np.float32(0.0)
            if xr >= width - radius:
                scores[disparity - min_disparity] = -1.0
                continue
            # Squares of linear counts would leave no digits for a faint contrast.
            level = right[y, xr]
            for j in range(side):
                row = right[y - radius + j, xr - radius : xr + radius + 1]
                model = template[j * side : (j + 1) * side]
                for i in range(side):
                    value = row[i] - level
                    total += value
                    squares += value * value
                    cross += value * model[i]
            variance = squares - total * total / np.float32(count)
            score = cross / np.sqrt(energy * variance) if variance > 0.0 else np.float32(-1.0)
            scores[disparity - min_disparity] = score
            if score > best:
                best, index = score, disparity
        if index < min_disparity:
            continue
        rival = np.float32(-1.0)
        for disparity in range(min_disparity, last + 1):
            if abs(disparity - index) > 2:
                rival = max(rival, scores[disparity - min_disparity])
        if rival < 0.95 * best:
            out_disparity[n] = index
            out_score[n] = best


def search_disparity_reference(
    left: NDArray[np.float32],
    right: NDArray[np.float32],
    pixel: tuple[int, int],
    radius: int,
    min_disparity: int,
    max_disparity: int,
) -> tuple[int, float]:
    """Disparity and ZNCC of one pixel (x, y), the plain numpy form of ``search_disparity``."""
    x, y = pixel
    height, width = left.shape
    if not (radius <= x < width - radius and radius <= y < height - radius):
        return 0, -1.0
    rows = slice(y - radius, y + radius + 1)
    template = left[rows, x - radius : x + radius + 1]
    scores = {}
    for disparity in range(min_disparity, max_disparity + 1):
        xr = x - disparity
        if radius <= xr < width - radius:
            patch = right[rows, xr - radius : xr + radius + 1]
            flat = np.ptp(patch) == 0.0 or np.ptp(template) == 0.0
            scores[disparity] = -1.0 if flat else correlation_reference(template, patch)
    best = max(scores, key=lambda d: scores[d], default=0)
    rivals = [score for d, score in scores.items() if abs(d - best) > 2]
    if scores.get(best, -1.0) <= -1.0 or max(rivals, default=-1.0) >= 0.95 * scores[best]:
        return 0, -1.0
    return best, scores[best]


def correlation_reference(first: NDArray[np.floating], second: NDArray[np.floating]) -> float:
    """ZNCC of two patches of equal shape, the plain form of the scores."""
    a = np.asarray(first, np.float64) - np.mean(first)
    b = np.asarray(second, np.float64) - np.mean(second)
    return float(np.sum(a * b) / np.sqrt(np.sum(a * a) * np.sum(b * b)))
