from __future__ import annotations

import dataclasses
import itertools

import cv2
import numpy as np
import pytest

from thermal_stereo_vo.core.cameras import LEFT, RIGHT, Camera
from thermal_stereo_vo.core.errors import SimulationError
from thermal_stereo_vo.core.transforms import exp_so3, make_transform, transform_points
from thermal_stereo_vo.simulation.materials import Material
from thermal_stereo_vo.simulation.mesh import Mesh, MeshBuilder
from thermal_stereo_vo.simulation.render import Lens
from thermal_stereo_vo.simulation.rig import stereo_rig
from thermal_stereo_vo.simulation.scene import Mover, Scene

from .small_worlds import BENT_LENS, LOOK_NORTH, renderer_of, wall_scene

IDEAL = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)


def test_depth_is_that_of_the_geometry(band) -> None:
    """A slanted wall: along the optical axis, through the bent lens, to 1 part in 10 000.

    What is left is the bend of the lens within a block of pixels, sixteen times less at full size.
    """
    pose = LOOK_NORTH @ make_transform(exp_so3([0.1, 0.5, 0.05]), [0.3, -0.2, 0.1])
    found = renderer_of(wall_scene(6.0)).render(Lens(BENT_LENS), band, lambda _: pose, 0.0)
    pixels = np.array([[x, y] for x in range(0, 160, 7) for y in range(0, 120, 7)], float)
    rays = BENT_LENS.unproject(pixels) @ pose[:3, :3].T
    expected = (6.0 - pose[1, 3]) / rays[:, 1]
    depth = found.depth_m[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
    np.testing.assert_allclose(depth, expected, rtol=1e-4)


def test_corners_lie_where_the_camera_model_projects_them(band) -> None:
    """Sign, order and half pixels of lens and grid: a warm square's edges, found by area."""
    for centre in ([0.0, 0.0], [1.1, 0.7], [-1.3, -0.8]):
        builder = MeshBuilder()
        x, z = centre
        half = 0.25
        builder.quads(
            np.array([[[x - half, 4.0, z - half], [x + half, 4.0, z - half],
                       [x + half, 4.0, z + half], [x - half, 4.0, z + half]]]),
            Material.BLACKBODY, offset_kelvin=10.0,
        )  # fmt: skip
        wall = wall_scene(4.5, Material.BLACKBODY).static
        builder.triangles(wall.vertices, Material.BLACKBODY)
        image = renderer_of(Scene(builder.build())).render(
            Lens(BENT_LENS), band, lambda _: LOOK_NORTH, 0.0
        )
        weight = (image.radiance - image.radiance.min()).astype(float)
        gy, gx = np.mgrid[:120, :160]
        found = np.array([(gx * weight).sum(), (gy * weight).sum()]) / weight.sum()
        # The centroid of the projected square, whose sides the lens bends.
        f = np.linspace(-half, half, 41)
        side = np.full_like(f, half)
        ring = np.vstack(
            [np.column_stack(p) for p in ((f, -side), (side, f), (-f, side), (-side, -f))]
        )
        points = np.column_stack([x + ring[:, 0], -z + ring[:, 1], np.full(len(ring), 4.0)])
        m = cv2.moments(BENT_LENS.project(points).astype(np.float32))
        expected = [m["m10"] / m["m00"], m["m01"] / m["m00"]]
        np.testing.assert_allclose(found, expected, atol=0.1)


def displacement(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Sub-pixel shift (x, y) of patch ``b`` against ``a``."""
    warp = np.eye(2, 3, dtype=np.float32)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-7)
    scale = 1.0 / (a.std() + 1e-9)
    _, warp = cv2.findTransformECC(
        ((a - a.mean()) * scale).astype(np.float32), ((b - b.mean()) * scale).astype(np.float32),
        warp, cv2.MOTION_TRANSLATION, criteria, None, 1,
    )  # fmt: skip
    return warp[:, 2]


def test_disparity_agrees_with_depth(band) -> None:
    """Where the left depth says a point is, the right picture shows it: within 0.02 px."""
    rig = stereo_rig(0.5)
    scene = wall_scene(7.0, Material.GRASS)
    renderer = renderer_of(scene)
    pose = LOOK_NORTH @ make_transform(exp_so3([0.0, 0.25, 0.0]), [0.0, 0.0, 0.0])
    views = {
        role: renderer.render(
            Lens(rig[role].camera), band, lambda _, T=rig[role].T_rig_camera: pose @ T, 0.0
        )
        for role in (LEFT, RIGHT)
    }
    left = rig[LEFT].camera
    errors = []
    half = 12
    for x, y in itertools.product(range(90, 250, 32), range(60, 200, 28)):
        depth = views[LEFT].depth_m[y, x]
        point = left.unproject(np.array([[x, y]], float)) * depth
        expected = rig[RIGHT].camera.project(transform_points(rig.T_a_b(RIGHT, LEFT), point))[0]
        rx, ry = np.rint(expected).astype(int)
        a = views[LEFT].radiance[y - half : y + half + 1, x - half : x + half + 1]
        b = views[RIGHT].radiance[ry - half : ry + half + 1, rx - half : rx + half + 1]
        errors.append(displacement(a, b) + np.array([rx, ry]) - expected)
    assert len(errors) >= 20
    median = np.median(errors, axis=0)
    assert np.all(np.abs(median) < 0.02), median
    assert np.median(np.abs(np.array(errors) - median)) < 0.04


def brute_force(renderer, band, camera: Camera, times: int) -> np.ndarray:
    """The mean of ``times`` x ``times`` rays in every pixel."""
    fine = Camera(
        camera.width * times, camera.height * times, camera.fx * times, camera.fy * times,
        (camera.cx + 0.5) * times - 0.5, (camera.cy + 0.5) * times - 0.5,
    )  # fmt: skip
    image = renderer.render(Lens(fine), band, lambda _: LOOK_NORTH, 0.0).radiance
    return image.reshape(camera.height, times, camera.width, times).mean(axis=(1, 3))


def picket_fence() -> Scene:
    """Posts from thicker to much thinner than a pixel before a cold wall, some slanting."""
    builder = MeshBuilder()
    for k, x in enumerate(np.linspace(-2.2, 2.2, 23)):
        width = 0.004 * 1.25**k
        lean = 0.2 * (k % 3 - 1)
        builder.quads(
            np.array([[[x, 4.0, -3], [x + width, 4.0, -3], [x + width + lean, 4.0, 3],
                       [x + lean, 4.0, 3]]]), Material.BLACKBODY, offset_kelvin=10.0,
        )  # fmt: skip
    builder.triangles(wall_scene(6.0, Material.BLACKBODY).static.vertices, Material.BLACKBODY)
    return Scene(builder.build())


def test_few_rays_see_what_many_see(band) -> None:
    """Fine posts come out with the right strength: no post is missed, none is too bold."""
    renderer = renderer_of(picket_fence())
    found, finer = (
        renderer.render(Lens(IDEAL, n), band, lambda _: LOOK_NORTH, 0.0).radiance for n in (2, 16)
    )
    truth = brute_force(renderer, band, IDEAL, 6)
    contrast = truth.max() - truth.min()
    error = found - truth
    assert np.sqrt(np.mean(error**2)) < 0.07 * contrast
    assert abs(error.mean()) < 0.004 * contrast
    assert np.sqrt(np.mean((finer - truth) ** 2)) < 0.6 * np.sqrt(np.mean(error**2))
    # Row sums over the visible posts: each carries its energy to a fifth.
    columns_found = (found - found.min()).mean(axis=0)
    columns_truth = (truth - truth.min()).mean(axis=0)
    assert 0.8 < columns_found.sum() / columns_truth.sum() < 1.2


def test_textures_do_not_alias(band) -> None:
    """A rough lawn far away: neighbouring pixels stay as alike as under many rays."""
    builder = MeshBuilder()
    far = 400.0
    builder.quads(
        np.array([[[-far, 0, -2.0], [far, 0, -2.0], [far, far, -2.0], [-far, far, -2.0]]]),
        Material.GRASS,
    )
    renderer = renderer_of(Scene(builder.build()))
    found = renderer.render(Lens(IDEAL), band, lambda _: LOOK_NORTH, 0.0).radiance[64:90]
    truth = brute_force(renderer, band, IDEAL, 4)[64:90]
    rough_found = np.std(np.diff(found, axis=1))
    rough_truth = np.std(np.diff(truth, axis=1))
    assert 0.5 < rough_found / rough_truth < 1.3


def test_rolling_rows_see_the_pose_of_their_time(band) -> None:
    """Each row of a rolling picture is that row of a picture taken at its time."""
    renderer = renderer_of(wall_scene(5.0, Material.GRASS))
    lens = Lens(BENT_LENS)

    def poses(time_s: float) -> np.ndarray:
        return LOOK_NORTH @ make_transform(exp_so3([0.0, 2.0 * time_s, 0.0]), [time_s, 0, 0])

    row_time_s = 5e-4
    rolling = renderer.render(lens, band, poses, 0.2, row_time_s=row_time_s).radiance
    still = renderer.render(lens, band, poses, 0.2).radiance
    for row in (20, 60, 110):
        then = renderer.render(lens, band, poses, 0.2 + row * row_time_s).radiance[row]
        step = np.abs(np.diff(then)).mean()
        assert np.abs(rolling[row] - then).mean() < 0.1 * step
        assert np.abs(rolling[row] - still[row]).mean() > 0.5 * step


def test_a_mover_carries_its_texture_along(band) -> None:
    builder = MeshBuilder()
    builder.box([-0.5, -0.1, -0.5], [0.5, 0.1, 0.5], Material.HEDGE)

    def pose(time_s: float) -> np.ndarray:
        return make_transform(np.eye(3), [0.4 * time_s, 3.0, 0.0])

    scene = Scene(wall_scene(9.0, Material.BLACKBODY).static, (Mover(builder.build(), pose),))
    renderer = renderer_of(scene)
    lens = Lens(IDEAL)
    first = renderer.render(lens, band, lambda _: LOOK_NORTH, 0.0)
    later = renderer.render(lens, band, lambda _: LOOK_NORTH, 1.0)
    assert np.all(first.depth_m[first.owner == 0] < 3.2)
    assert np.all(first.depth_m[first.owner == -1] > 3.2)
    shift = displacement(first.radiance[45:75, 65:95], later.radiance[45:75, 83:113])
    shift += np.array([18, 0])
    np.testing.assert_allclose(shift, [130.0 * 0.4 / 2.9, 0.0], atol=0.05)
    assert (later.owner == 0).sum() == pytest.approx((first.owner == 0).sum(), rel=0.03)


@pytest.mark.parametrize(
    "place",
    [[0.3, 5.0, 0.2], [-2.9, 4.0, 1.0], [-1.3, 0.4, -0.4], [0.0, -0.6, 1.1], [1.4, 1.0, 0.0],
     [0.0, -9.0, 0.0]],
)  # fmt: skip
def test_a_mover_is_seen_wherever_it_stands(band, place) -> None:
    """Before, beside and behind the camera: as if it were part of what stands still."""
    pose = make_transform(exp_so3([0.1, 0.2, 0.7]), place)
    builder = MeshBuilder()
    builder.box([-1.0, -0.3, -0.5], [1.0, 0.3, 0.5], Material.BLACKBODY, offset_kelvin=9.0)
    builder.cylinder([0, 0, 0.5], [0.1, 0.2, 1.6], 0.01, Material.BLACKBODY, offset_kelvin=9.0)
    body = builder.build()
    still = MeshBuilder()
    still.triangles(wall_scene(8.0, Material.BLACKBODY).static.vertices, Material.BLACKBODY)
    wall = still.build()
    placed = dataclasses.replace(
        body, vertices=(body.vertices @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32)
    )
    T = pose[:3]
    thin = body.thin.copy()
    for ends in (slice(0, 3), slice(3, 6)):
        thin[:, ends] = thin[:, ends] @ T[:, :3].T + T[:, 3]
    both = Mesh(
        np.concatenate([wall.vertices, placed.vertices]),
        np.concatenate([wall.material, placed.material]),
        np.concatenate([wall.surface, placed.surface + wall.surfaces]),
        np.concatenate([wall.offset_kelvin, placed.offset_kelvin]),
        np.concatenate([wall.thin, thin]).astype(np.float32),
    )
    lens = Lens(BENT_LENS)
    moving = renderer_of(Scene(wall, (Mover(body, lambda _: pose),)))
    found = moving.render(lens, band, lambda _: LOOK_NORTH, 0.0)
    expected = renderer_of(Scene(both)).render(lens, band, lambda _: LOOK_NORTH, 0.0)
    np.testing.assert_allclose(found.depth_m, expected.depth_m, rtol=1e-4)
    np.testing.assert_allclose(found.radiance, expected.radiance, rtol=1e-4)
    assert np.array_equal(found.owner == 0, expected.depth_m < 7.0)


def test_the_rig_is_that_of_the_paper() -> None:
    rig = stereo_rig()
    T_right_left = rig.T_a_b(RIGHT, LEFT)
    np.testing.assert_allclose(T_right_left[:3, 3], [-0.2678441, 0.0004702, 0.0005850], atol=1e-9)
    rig.check_stereo()
    # The right eye lies on the x axis of the rig: the frame is that of the rectified left camera.
    np.testing.assert_allclose(rig[RIGHT].T_rig_camera[1:3, 3], 0.0, atol=1e-9)
    assert 0.267 < rig[RIGHT].T_rig_camera[0, 3] < 0.269


def test_a_smaller_image_keeps_the_view(band) -> None:
    whole, half = stereo_rig(1.0)[LEFT].camera, stereo_rig(0.5)[LEFT].camera
    corner = whole.unproject(np.array([[-0.5, -0.5]]))
    np.testing.assert_allclose(half.unproject(np.array([[-0.5, -0.5]])), corner, atol=1e-6)


def test_odd_sizes_are_refused() -> None:
    with pytest.raises(SimulationError, match="must be even; choose another scale"):
        Lens(Camera(101, 80, 90.0, 90.0, 50.0, 40.0))


def test_a_still_rig_sees_the_same_twice(hover_studio) -> None:
    plan_pose = hover_studio.render(LEFT, 0.2), hover_studio.render(LEFT, 0.2)
    np.testing.assert_array_equal(plan_pose[0].radiance, plan_pose[1].radiance)
    assert np.isfinite(plan_pose[0].radiance).all()
    assert 0.05 < np.isinf(plan_pose[0].depth_m).mean() < 0.6  # there is sky, and not only sky
