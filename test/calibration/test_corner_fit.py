import cv2
import numpy as np
import pytest

from thermal_stereo_vo.calibration.corner_fit import fit_corners

SPACING = 20.0


def lattice_image(rng, offset, *, convex, angle=0.2, noise=0.0, gradient=(0.0, 0.0), blur=0.9):
    """(H, W) picture of 5 x 5 corners with true pixels (25, 2) and edge vectors (25, 2, 2)."""
    n = 11
    size, centre = 160, 80.0 + np.asarray(offset)
    sub = (np.arange(size * n) + 0.5) / n - 0.5
    x, y = np.meshgrid(sub, sub)
    c, s = np.cos(angle), np.sin(angle)
    u = ((x - centre[0]) * c + (y - centre[1]) * s) / SPACING
    v = (-(x - centre[0]) * s + (y - centre[1]) * c) / SPACING
    if convex:  # holes of one spacing, two apart
        marked = (np.floor(u) % 2 == 0) & (np.floor(v) % 2 == 0)
    else:
        marked = (np.floor(u) + np.floor(v)) % 2 == 0
    image = marked.reshape(size, n, size, n).mean((1, 3)) * 100.0
    image = cv2.GaussianBlur(image, (0, 0), blur)
    gx, gy = np.meshgrid(np.arange(size), np.arange(size))
    image = image + gradient[0] * gx + gradient[1] * gy + 1000.0
    image = image + rng.normal(0.0, noise, image.shape)
    j, i = np.mgrid[-2:3, -2:3]
    along, across = np.array([c, s]) * SPACING, np.array([-s, c]) * SPACING
    pixels = centre + i.reshape(-1, 1) * along + j.reshape(-1, 1) * across
    edges = np.broadcast_to(np.stack([along, across]), (25, 2, 2)).copy()
    if convex:  # towards the hole that the corner belongs to
        signs = np.stack([1 - 2 * (i % 2).ravel(), 1 - 2 * (j % 2).ravel()], axis=1)
        edges *= signs[:, :, None]
    return image, pixels, edges


@pytest.mark.parametrize("convex", [False, True])
@pytest.mark.parametrize("gradient", [(0.0, 0.0), (3.0, -2.0)])
def test_exact_without_noise(rng, convex, gradient):
    """Neither blur nor a slope of three counts a pixel moves the corner."""
    image, pixels, edges = lattice_image(rng, [0.31, -0.17], convex=convex, gradient=gradient)
    guess = pixels + rng.uniform(-2.0, 2.0, pixels.shape)
    fit = fit_corners(image, guess, edges, convex=convex)
    assert fit.good.all()
    assert np.abs(fit.pixels - pixels).max() < 0.03
    assert np.median(fit.blur_px) == pytest.approx(0.95, abs=0.1)  # 0.9 and the pixel itself


@pytest.mark.parametrize("convex", [False, True])
def test_claimed_uncertainty_is_the_true_one(rng, convex):
    claims, errors = [], []
    for _ in range(6):
        image, pixels, edges = lattice_image(
            rng, rng.uniform(-0.5, 0.5, 2), convex=convex, noise=15.0
        )
        fit = fit_corners(image, pixels + rng.normal(0, 0.5, pixels.shape), edges, convex=convex)
        good = fit.good & (fit.sigma_px < 0.5)
        assert good.mean() > 0.8
        errors.append((fit.pixels - pixels)[good])
        claims.append(fit.sigma_px[good])
    error, claim = np.concatenate(errors), np.concatenate(claims)
    normalised = np.mean(np.sum(error**2, axis=1) / (2.0 * claim**2))
    assert 0.6 < normalised < 1.7
    assert np.abs(error.mean(0)).max() < 4.0 * error.std() / np.sqrt(len(error)) + 0.01


def test_sixteen_bits_are_used(rng):
    """A board of eight counts contrast at 14000 counts: a shift to 8 bit would see nothing."""
    image, pixels, edges = lattice_image(rng, [0.2, 0.4], convex=False, noise=5.0)
    counts = np.rint(14000 + 0.08 * (image - 1000.0)).astype(np.uint16)
    assert counts.max() - counts.min() < 16
    fit = fit_corners(counts, pixels + 0.7, edges, convex=False)
    assert fit.good.all()
    assert np.abs(fit.pixels - pixels).max() < 0.25


def test_signs_alternate_on_a_chessboard(rng):
    image, pixels, edges = lattice_image(rng, [0.0, 0.0], convex=False)
    amplitude = fit_corners(image, pixels, edges, convex=False).amplitude.reshape(5, 5)
    assert (np.sign(amplitude[:, 1:]) == -np.sign(amplitude[:, :-1])).all()
    assert (np.sign(amplitude[1:]) == -np.sign(amplitude[:-1])).all()


def test_outer_corner_is_no_crossing(rng):
    """Beside the last square there are three fields of one shade, not two and two."""
    image, pixels, edges = lattice_image(rng, [0.0, 0.0], convex=True)
    fit = fit_corners(image, pixels, np.abs(edges), convex=False)
    assert not fit.good.any()


def test_corner_without_contrast_or_at_the_border_is_not_good(rng):
    flat = rng.normal(1000.0, 5.0, (60, 60))
    edges = np.array([[[12.0, 0.0], [0.0, 12.0]]])
    assert not fit_corners(flat, np.array([[30.0, 30.0]]), edges, convex=False).good[0]
    outside = fit_corners(flat, np.array([[-30.0, 30.0]]), edges, convex=False)
    assert not outside.good[0]
    assert len(fit_corners(flat, np.zeros((0, 2)), np.zeros((0, 2, 2)), convex=True).good) == 0
