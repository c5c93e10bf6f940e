import numpy as np
import pytest

from thermal_stereo_vo.calibration.lenses import Lens, from_camera, lens_of, project, to_camera

POINTS = np.array([[0.1, 0.2, 1.0], [-0.3, 0.1, 1.2], [0.2, -0.4, 0.9], [0.0, 0.0, 2.0]])


def parameters(lens, rng):
    coefficients = rng.normal(0.0, 0.02, len(lens.names) - 4)
    return np.concatenate([[520.0, 515.0, 322.0, 241.0], coefficients])


@pytest.mark.parametrize("lens", Lens)
def test_derivatives(lens, rng):
    x = parameters(lens, rng)
    _, by_point, by_parameter = project(lens, x, POINTS)
    for k, step in enumerate(1e-4 * np.eye(len(x))):
        numeric = (project(lens, x + step, POINTS)[0] - project(lens, x - step, POINTS)[0]) / 2e-4
        np.testing.assert_allclose(by_parameter[:, :, k], numeric, atol=1e-5)
    for k, step in enumerate(1e-6 * np.eye(3)):
        numeric = (project(lens, x, POINTS + step)[0] - project(lens, x, POINTS - step)[0]) / 2e-6
        np.testing.assert_allclose(by_point[:, :, k], numeric, atol=1e-5)


@pytest.mark.parametrize("lens", Lens)
def test_same_pixels_as_the_camera_of_the_package(lens, rng):
    x = parameters(lens, rng)
    camera = to_camera(lens, x, (640, 480))
    np.testing.assert_allclose(project(lens, x, POINTS)[0], camera.project(POINTS), atol=1e-9)
    np.testing.assert_array_equal(from_camera(lens, camera), x)


def test_lens_of_a_camera(rng):
    for lens in (Lens.NONE, Lens.RADTAN4, Lens.RADTAN5, Lens.RATIONAL, Lens.EQUIDISTANT):
        assert lens_of(to_camera(lens, parameters(lens, rng), (640, 480))) is lens
