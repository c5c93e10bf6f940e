from __future__ import annotations

import itertools

import numpy as np
import pytest

from thermal_stereo_vo.core.cameras import LEFT, RIGHT, THERMAL, VISIBLE
from thermal_stereo_vo.core.errors import ConfigError, SimulationError
from thermal_stereo_vo.core.frames import FfcState
from thermal_stereo_vo.datasets.base import WithImu
from thermal_stereo_vo.datasets.options import SourceOptions
from thermal_stereo_vo.datasets.registry import open_dataset
from thermal_stereo_vo.datasets.simulated import open_simulated

TINY = ("render.scale=0.125", "render.workers=0", "render.lag=none", "world.density=0.1")


def run(preset: str, *overrides: str, seed: int = 0, **options):
    return open_simulated(
        preset, SourceOptions(seed=seed, overrides=(*TINY, *overrides), **options)
    )


def test_a_run_is_a_recording() -> None:
    dataset, reason = open_dataset(
        "sim:blackbody", SourceOptions(overrides=(*TINY, "duration_s=0.2"))
    )
    assert reason == "simulated run 'blackbody'"
    assert dataset.name == "blackbody"
    assert dataset.cameras == (LEFT, RIGHT)
    frames = list(dataset.frames())
    assert [f.camera for f in frames[:4]] == [LEFT, RIGHT, LEFT, RIGHT]
    assert dataset.instants() == len(frames) / 2 == 7
    assert frames[0].image.dtype == np.uint16
    assert frames[0].image.max() <= 16383
    assert [f.sequence for f in frames if f.camera == LEFT] == list(range(7))
    truth = dataset.ground_truth()
    np.testing.assert_array_equal(truth.stamps_ns, [f.stamp_ns for f in frames if f.camera == LEFT])
    np.testing.assert_allclose(truth.T_world_rig[0], np.eye(4), atol=1e-12)
    again = list(dataset.frames())
    np.testing.assert_array_equal(again[5].image, frames[5].image)


def test_the_truth_is_the_way_of_the_camera_that_sees() -> None:
    """Depth and truth fit together: a point of the ground seen at two times is one point."""
    from thermal_stereo_vo.core.transforms import inverse, transform_points
    from thermal_stereo_vo.simulation.studio import Studio

    dataset = run("corridor", "render.scale=0.25", "world.traffic=false")
    plan, truth = dataset.simulation.plan, dataset.ground_truth()
    studio = Studio(plan)
    first, second = 60, 66
    views = [studio.render(LEFT, i / 10.0) for i in (first, second)]
    camera, T_rig_left = plan.rig[LEFT].camera, plan.rig[LEFT].T_rig_camera
    T_then_now = [truth.T_world_rig[i] @ T_rig_left for i in (first, second)]
    pixels = np.array([[x, y] for x in range(50, 110, 6) for y in range(80, 112, 6)], float)
    depth = views[0].depth_m[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
    points = camera.unproject(pixels) * depth[:, None]
    there = transform_points(inverse(T_then_now[1]) @ T_then_now[0], points)
    seen = camera.project(there)
    inside = (there[:, 2] > 1.0) & np.all((seen > 2) & (seen < [157, 117]), axis=1)
    assert inside.sum() > 15
    found = views[1].depth_m[
        np.rint(seen[inside, 1]).astype(int), np.rint(seen[inside, 0]).astype(int)
    ]
    assert np.median(np.abs(found / there[inside, 2] - 1.0)) < 0.02


def test_the_number_of_processes_changes_no_bit() -> None:
    alone = list(run("blackbody", "duration_s=0.1", "render.lag=reprojected").frames())
    shared = list(
        run("blackbody", "duration_s=0.1", "render.lag=reprojected", "render.workers=1").frames()
    )
    assert len(alone) == len(shared) == 8
    for a, b in zip(alone, shared, strict=True):
        np.testing.assert_array_equal(a.image, b.image)
        assert a.stamp_ns == b.stamp_ns


def test_seeds_change_the_noise_and_nothing_else() -> None:
    one, two, same = (run("blackbody", "duration_s=0.1", seed=s) for s in (0, 1, 0))
    first, other, again = ([f.image for f in d.frames()] for d in (one, two, same))
    np.testing.assert_array_equal(first[3], again[3])
    assert np.mean(first[3] == other[3]) < 0.6
    np.testing.assert_array_equal(one.ground_truth().T_world_rig, two.ground_truth().T_world_rig)


def test_rate_length_and_settings_are_heeded() -> None:
    dataset = run("corridor", rate_hz=5.0, length_m=30.0)
    assert dataset.ground_truth().path_lengths_m[-1] == pytest.approx(30.0, rel=0.02)
    assert np.all(np.diff(dataset.ground_truth().stamps_ns) == 200_000_000)


def test_each_camera_freezes_at_its_own_time() -> None:
    dataset = run("blackbody", "rate_hz=10", "duration_s=2.5", "ffc.mode=periodic",
                  "ffc.first_s=0.5", "ffc.arrangement=staggered", "ffc.stagger_s=1.0")  # fmt: skip
    frames = list(dataset.frames())
    for role, start in ((LEFT, 5), (RIGHT, 15)):
        mine = [f for f in frames if f.camera == role]
        same = [np.array_equal(a.image, b.image) for a, b in itertools.pairwise(mine)]
        assert same == [start - 1 <= i < start + 4 for i in range(len(same))]
        states = [f.telemetry.ffc_state for f in mine]
        assert states[start : start + 5] == [FfcState.IN_PROGRESS] * 5
        assert states[start + 5] is FfcState.COMPLETE


def test_eight_bits_go_through_the_cameras_own_gain_control() -> None:
    dataset = run(
        "hot_arm", "thermal.output=agc", "duration_s=4", "rate_hz=5", "thermal.agc_damping=255"
    )
    frames = [f for f in dataset.frames() if f.camera == LEFT]
    assert all(f.image.dtype == np.uint8 for f in frames)
    before, with_arm = frames[10].image.astype(float), frames[19].image.astype(float)
    # The arm takes the upper grey levels; the street below must give way.
    corner = (slice(40, 58), slice(0, 20))
    assert with_arm[corner].mean() < before[corner].mean() - 5.0


def test_cameras_may_be_silent_about_themselves() -> None:
    dataset = run("blackbody", "duration_s=0.1", "thermal.telemetry=false")
    assert all(f.telemetry is None for f in dataset.frames())


def test_a_visible_and_thermal_run_has_both_bands() -> None:
    dataset = run("ms-01", "duration_s=0.1")
    frames = list(dataset.frames())
    assert [f.camera for f in frames[:2]] == [VISIBLE, THERMAL]
    assert frames[0].image.dtype == np.uint8
    assert frames[1].image.dtype == np.uint16


def test_a_run_has_an_inertial_sensor() -> None:
    dataset = run("corridor", "duration_s=0.5")
    assert isinstance(dataset, WithImu)
    samples = list(dataset.imu())
    assert len(samples) == 101
    assert np.all(np.diff([s.stamp_ns for s in samples]) == 5_000_000)


@pytest.mark.parametrize(
    ("preset", "overrides", "error", "text"),
    [
        ("seq0", (), SimulationError, "no preset 'seq0': choose one of seq1"),
        ("hover", ("thermal.netd=5",), ConfigError, "did you mean 'thermal.netd_mk'"),
        ("hover", ("world.weather=hail",), ConfigError, "world.weather must be one of sunny_day"),
        ("hover", ("rate_hz=0",), ConfigError, "rate_hz = 0 is out of range"),
        ("blackbody", ("render.scale=0.1016",), SimulationError, "must be even; choose another"),
    ],
)
def test_wrong_wishes_are_refused(preset, overrides, error, text) -> None:
    with pytest.raises(error, match=text):
        list(
            open_simulated(
                preset, SourceOptions(overrides=("render.workers=0", *overrides))
            ).frames()
        )


def test_when_the_light_goes_out_the_thermal_camera_sees_on() -> None:
    """And the pictures are those of the run with light: they may be shared."""
    cut = ("duration_s=1", "visible.dark_first_s=0.4", "visible.dark_s=0.3")
    dark, lit = run("ms-still", *cut), run("ms-still", "duration_s=1")
    assert dark.simulation.plan.picture_key() == lit.simulation.plan.picture_key()
    spread = {VISIBLE: [], THERMAL: []}
    for a, b in zip(dark.frames(), lit.frames(), strict=True):
        seconds = a.stamp_ns * 1e-9 - lit.ground_truth().stamps_ns[0] * 1e-9
        out = a.camera == VISIBLE and 0.4 - 1e-6 <= seconds < 0.7 - 1e-6
        assert np.array_equal(a.image, b.image) != out
        spread[a.camera].append((out, float(np.ptp(np.percentile(a.image, (5, 95))))))
    assert max(s for out, s in spread[VISIBLE] if out) < 15
    assert min(s for out, s in spread[VISIBLE] if not out) > 25
