"""What every odometry method promises to the pipeline, whatever it does inside.

A new method is held to all of this by one line in ``METHODS``.
"""

from __future__ import annotations

import builtins
import hashlib
from dataclasses import dataclass, fields, replace

import numpy as np
import pytest

from thermal_stereo_vo.core.cameras import THERMAL, VISIBLE, Camera
from thermal_stereo_vo.core.config import with_overrides
from thermal_stereo_vo.core.errors import OutOfOrderError
from thermal_stereo_vo.core.frames import CameraView, GapReason, RigFrame
from thermal_stereo_vo.core.results import (
    OdometryResult,
    PointCloud,
    TrackingStatus,
    TrackStats,
)
from thermal_stereo_vo.core.transforms import exp_se3, inverse, log_so3
from thermal_stereo_vo.odometry.factory import OdometryConfig, create_odometry
from thermal_stereo_vo.odometry.interface import Odometry

STEREO, BANDS = ("left", "right"), (VISIBLE, THERMAL)


@dataclass(frozen=True)
class Method:
    """Settings of a method, and the cameras it sees with.

    One of two bands goes on with either camera alone, and its lengths are in ``unit_m``.
    """

    settings: tuple[str, ...]
    roles: tuple[str, str] = STEREO
    unit_m: float = 1.0

    @property
    def of_bands(self) -> bool:
        return self.roles == BANDS


METHODS = {
    "frame to frame": Method(("method=feature", "window=0")),
    "window": Method(("method=feature", "window=7")),
    "direct": Method(("method=direct",)),
    "multispectral": Method(
        ("method=multispectral", "multispectral.selection.points=250", "threads=1"), BANDS
    ),
}
PERIOD_NS = 100_000_000
FRAMES = 12
INITIALISING, TRACKING, DEGRADED, GAP, LOST = TrackingStatus
MEASURED = (TRACKING, DEGRADED)


@pytest.fixture(params=METHODS.values(), ids=METHODS, scope="session")
def settings(request, stereo_flight) -> Method:
    """A method, with the unit it takes for a steady flight."""
    method = request.param
    if not method.of_bands:
        return method
    last = run(create(method), [named(frame, method) for frame in stereo_flight.frames])[-1]
    return replace(method, unit_m=1.0 / error_m(last, np.eye(4)) * way_m(stereo_flight.poses[-1]))


class InMetres:
    """A method whose lengths are in another unit."""

    def __init__(self, odometry: Odometry, unit_m: float) -> None:
        self._odometry = odometry
        self._unit_m = unit_m
        self.warm_up = odometry.warm_up

    def process(self, frame: RigFrame) -> OdometryResult:
        result = self._odometry.process(frame)
        if result.T_world_rig is None:
            return result
        twist = result.twist * np.repeat([self._unit_m, 1.0], 3)
        return replace(result, T_world_rig=scaled(result.T_world_rig, self._unit_m), twist=twist)

    def reset(self, T_world_rig: np.ndarray) -> None:
        self._odometry.reset(scaled(T_world_rig, 1.0 / self._unit_m))

    def local_map(self) -> PointCloud:
        cloud = self._odometry.local_map()
        return replace(cloud, xyz=cloud.xyz * np.float32(self._unit_m))


def scaled(T: np.ndarray, factor: float) -> np.ndarray:
    out = T.copy()
    out[:3, 3] *= factor
    return out


def way_m(T: np.ndarray) -> float:
    return float(np.linalg.norm(T[:3, 3]))


@dataclass(frozen=True)
class Flight:
    """Frames of a steady flight and where the rig truly was."""

    frames: tuple[RigFrame, ...]
    poses: np.ndarray


@pytest.fixture(scope="session")
def stereo_flight(room) -> Flight:
    rng = np.random.default_rng(5)
    poses = room.path(FRAMES)
    frames = tuple(room.rig_frame(i * PERIOD_NS, T, rng) for i, T in enumerate(poses))
    return Flight(frames, poses)


@pytest.fixture
def flight(settings, stereo_flight) -> Flight:
    return replace(
        stereo_flight, frames=tuple(named(frame, settings) for frame in stereo_flight.frames)
    )


def named(frame: RigFrame, method: Method) -> RigFrame:
    """The same views under the names of a method's cameras."""
    return replace(frame, views=dict(zip(method.roles, frame.views.values(), strict=True)))


def create(method: Method, *more) -> Odometry:
    odometry = create_odometry(with_overrides(OdometryConfig(), [*method.settings, *more]))
    return odometry if method.unit_m == 1.0 else InMetres(odometry, method.unit_m)


def at(frame: RigFrame, index: int) -> RigFrame:
    """The same images at the time of another frame."""
    return replace(frame, stamp_ns=index * PERIOD_NS)


def check(result: OdometryResult, frame: RigFrame) -> None:
    """What must hold of every single result."""
    assert result.stamp_ns == frame.stamp_ns
    if result.status is LOST:
        assert result.T_world_rig is None
        assert result.covariance is None
        assert result.reason
        return
    T, C = result.T_world_rig, result.covariance
    assert T.shape == (4, 4)
    assert np.isfinite(T).all()
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
    np.testing.assert_array_equal(T[3], [0, 0, 0, 1])
    for matrix in (C, result.twist_covariance):
        assert matrix.shape == (6, 6)
        assert np.isfinite(matrix).all()
        np.testing.assert_allclose(matrix, matrix.T, atol=1e-9 * np.abs(matrix).max() + 1e-15)
        assert np.linalg.eigvalsh(matrix).min() >= -1e-9 * np.abs(matrix).max()
    assert result.twist.shape == (6,)
    assert np.isfinite(result.twist).all()
    if result.status in MEASURED:
        assert result.stats.inliers > 0
        assert np.trace(C) > 0


def run(odometry: Odometry, frames) -> list[OdometryResult]:
    results = []
    for frame in frames:
        results.append(odometry.process(frame))
        check(results[-1], frame)
    return results


def error_m(result, T_true) -> float:
    return float(np.linalg.norm(result.T_world_rig[:3, 3] - T_true[:3, 3]))


def without(frame: RigFrame, *eyes: int) -> RigFrame:
    """The frame without its first (0) or second (1) camera."""
    roles = [list(frame.views)[eye] for eye in eyes]
    views = {role: view for role, view in frame.views.items() if role not in roles}
    return replace(frame, views=views, blind=dict.fromkeys(roles, GapReason.FFC))


def filled(frame: RigFrame, make) -> RigFrame:
    """Every image (and its 8-bit view) replaced by ``make(shape)``."""
    views = {}
    for role, view in frame.views.items():
        image = make(view.image.shape)
        views[role] = replace(view, image=image, display=image)
    return replace(frame, views=views)


def masked(frame: RigFrame) -> RigFrame:
    views = {
        role: replace(view, mask=np.zeros(view.image.shape, bool))
        for role, view in frame.views.items()
    }
    return replace(frame, views=views)


def noise(frame: RigFrame) -> RigFrame:
    rng = np.random.default_rng(frame.stamp_ns)
    return filled(frame, lambda shape: rng.integers(0, 256, shape, np.uint8))


BAD = {
    "black": lambda frame: filled(frame, lambda shape: np.zeros(shape, np.uint8)),
    "saturated": lambda frame: filled(frame, lambda shape: np.full(shape, 255, np.uint8)),
    "noise": noise,
    "masked": masked,
    "no first": lambda frame: without(frame, 0),
    "no second": lambda frame: without(frame, 1),
    "no eye": lambda frame: without(frame, 0, 1),
}


def needs_both_eyes(method: Method, fault) -> None:
    if method.of_bands and fault in (BAD["no first"], BAD["no second"]):
        pytest.skip("one camera is enough for a map without unit")


each_fault = pytest.mark.parametrize("fault", BAD.values(), ids=BAD)


# -------------------------------------------------------------------------------------- good frames


def test_a_steady_flight_is_tracked(settings, flight):
    """Small error, but not zero: noise went in, so noise must come out."""
    results = run(create(settings), flight.frames)
    assert results[0].status is INITIALISING
    np.testing.assert_array_equal(results[0].T_world_rig, np.eye(4))
    assert all(result.status is TRACKING for result in results[1:])
    assert all(result.reset_counter == 0 for result in results)
    assert 1e-5 < error_m(results[-1], flight.poses[-1]) < 0.08  # of 0.7 m at QVGA
    turn = log_so3(results[-1].T_world_rig[:3, :3].T @ flight.poses[-1][:3, :3])
    assert 1e-6 < np.linalg.norm(turn) < 0.01
    np.testing.assert_allclose(
        np.median([r.twist for r in results[2:]], axis=0),
        [0.2, 0.0, 0.6, 0.0, 0.1, 0.03],
        atol=0.05,
    )


def test_covariance_grows_along_the_way_and_is_of_the_size_of_the_error(settings, flight):
    results = run(create(settings), flight.frames)
    if settings.of_bands:  # of lengths without a unit nothing is known, and that is said
        assert all(np.trace(r.covariance[:3, :3]) > 1e5 for r in results)
        turn = [np.trace(r.covariance[3:, 3:]) for r in results]
        assert turn[0] == 0.0
        assert 0.0 < min(turn[1:]) <= max(turn[1:]) < 1e-3
        return
    sigma_m = [np.sqrt(np.trace(r.covariance[:3, :3])) for r in results]
    assert sigma_m[0] == 0.0
    assert sigma_m[-1] > sigma_m[1] > 0.0
    assert 0.02 < error_m(results[-1], flight.poses[-1]) / sigma_m[-1] < 8.0


def test_the_map_lies_on_the_walls(settings, flight, room):
    odometry = create(settings)
    assert odometry.local_map().xyz.shape == (0, 3)
    run(odometry, flight.frames)
    cloud = odometry.local_map()
    assert cloud.xyz.dtype == cloud.intensity.dtype == np.float32
    assert len(cloud.xyz) == len(cloud.intensity) > 50
    to_wall_m = np.minimum(np.abs(cloud.xyz - room.low), np.abs(cloud.xyz - room.high)).min(axis=1)
    assert 1e-4 < np.median(to_wall_m) < 0.15
    ahead = (cloud.xyz - flight.poses[-1][:3, 3]) @ flight.poses[-1][:3, 2]
    assert (ahead > 0).all()
    assert 0 <= cloud.intensity.min() < 60 < 200 < cloud.intensity.max() <= 255


def test_sixteen_bit_counts_are_taken_as_they_are(settings, flight):
    """The method may use the counts or the 8-bit view, but must not need 8-bit counts."""
    frames = []
    for frame in flight.frames[:6]:
        views = {
            role: replace(view, image=view.image.astype(np.uint16) * 20 + 4000)
            for role, view in frame.views.items()
        }
        frames.append(replace(frame, views=views))
    results = run(create(settings), frames)
    assert results[-1].status is TRACKING
    assert error_m(results[-1], flight.poses[5]) < 0.08


def test_a_rig_that_stands_still_stays(settings, flight):
    """The very same image: no motion, and no claim of more than noise."""
    results = run(create(settings), [at(flight.frames[0], i) for i in range(6)])
    for result in results[1:]:
        assert result.status is TRACKING
        assert error_m(result, np.eye(4)) < 1e-3


def test_frames_that_are_missing_altogether_are_bridged(settings, flight):
    """Nobody tells the method of a frame the recorder dropped: the stamps do."""
    frames = [frame for i, frame in enumerate(flight.frames) if i not in (4, 5, 8)]
    results = run(create(settings), frames)
    assert all(result.status is TRACKING for result in results[1:])
    assert error_m(results[-1], flight.poses[-1]) < 0.08


@pytest.mark.parametrize("shift_px", [20, -20])
def test_principal_points_may_differ(settings, flight, shift_px):
    """Some calibrations shift the right image: disparity counts from the principal points."""
    frames = [shifted(frame, shift_px) for frame in flight.frames]
    first, second = (frames[0].views[role] for role in settings.roles)
    assert first.camera.cx - second.camera.cx == shift_px
    results = run(create(settings), frames)
    assert all(result.status is TRACKING for result in results[1:])
    assert error_m(results[-1], flight.poses[-1]) < 0.12


def shifted(frame: RigFrame, shift_px: int) -> RigFrame:
    """Columns cut off on the left of one eye and on the right of the other."""
    views = {}
    for role, view in frame.views.items():
        cut = abs(shift_px) if (role in ("right", THERMAL)) == (shift_px > 0) else 0
        width = view.camera.width - abs(shift_px)
        image = np.ascontiguousarray(view.image[:, cut : cut + width])
        views[role] = CameraView(
            image,
            replace(view.camera, width=width, cx=view.camera.cx - cut),
            view.T_rig_camera.copy(),
            mask=np.ones(image.shape, bool),
            display=image,
        )
    return replace(frame, views=views)


# ---------------------------------------------------------------------------- order, reset and seed


def test_stamps_must_increase_and_a_refusal_changes_nothing(settings, flight):
    odometry, other = create(settings), create(settings)
    run(odometry, flight.frames[:3])
    run(other, flight.frames[:3])
    for index in (2, 1, 0):
        with pytest.raises(OutOfOrderError, match=r"does not come after .* reset the odometry"):
            odometry.process(at(flight.frames[3], index))
    assert same(odometry.process(flight.frames[3]), other.process(flight.frames[3]))


def same(a: OdometryResult, b: OdometryResult) -> bool:
    """Bit for bit, times aside."""
    for item in fields(OdometryResult):
        x, y = getattr(a, item.name), getattr(b, item.name)
        if isinstance(x, np.ndarray) or isinstance(y, np.ndarray):
            if x is None or y is None or not np.array_equal(x, y):
                return False
        elif isinstance(x, TrackStats):
            if repr(replace(x, stage_ms={})) != repr(replace(y, stage_ms={})):
                return False
        elif x != y:
            return False
    return True


def test_same_seed_same_bits(settings, flight):
    frames = [*flight.frames[:5], BAD["black"](flight.frames[5]), *flight.frames[6:]]
    a, b = (create(settings, "seed=3") for _ in range(2))
    for x, y in zip(run(a, frames), run(b, frames), strict=True):
        assert same(x, y)
    assert np.array_equal(a.local_map().xyz, b.local_map().xyz)


def test_reset_forgets_everything_and_goes_on_from_the_pose_given(settings, flight):
    odometry = create(settings)
    odometry.reset(np.eye(4))
    first = run(odometry, flight.frames)
    odometry.reset(np.eye(4))  # and time may begin anew
    again = run(odometry, flight.frames)
    assert {r.reset_counter for r in first} == {1}
    assert {r.reset_counter for r in again} == {2}  # it never shrinks
    assert all(same(a, replace(b, reset_counter=1)) for a, b in zip(first, again, strict=True))
    T_start = exp_se3([3.0, -2.0, 1.0, 0.3, 1.0, -0.4])
    given = T_start.copy()
    odometry.reset(given)
    moved = run(odometry, flight.frames)
    np.testing.assert_array_equal(given, T_start)
    for a, b in zip(first, moved, strict=True):
        np.testing.assert_allclose(b.T_world_rig, T_start @ a.T_world_rig, atol=1e-6)
    known = 3 if settings.of_bands else 0
    assert np.linalg.norm(moved[0].covariance[known:, known:]) == 0.0


def test_two_rigs_of_different_size_in_one_process(settings, flight):
    """No state is shared: interleaved runs equal separate ones."""
    small = [
        RigFrame(
            frame.stamp_ns,
            {
                role: CameraView(
                    np.ascontiguousarray(view.image[:200, :280]),
                    Camera(280, 200, *(view.camera.fx, view.camera.fy, view.camera.cx, 120.0)),
                    view.T_rig_camera.copy(),
                    mask=np.ones((200, 280), bool),
                    display=np.ascontiguousarray(view.image[:200, :280]),
                )
                for role, view in frame.views.items()
            },
        )
        for frame in flight.frames[:5]
    ]
    alone = run(create(settings), flight.frames[:5]), run(create(settings), small)
    a, b = create(settings), create(settings)
    for i in range(5):
        assert same(a.process(flight.frames[i]), alone[0][i])
        assert same(b.process(small[i]), alone[1][i])
    assert alone[1][-1].status is TRACKING


# --------------------------------------------------------------------------------------- bad frames


@each_fault
def test_bad_frames_in_mid_flight_do_no_lasting_harm(settings, flight, fault):
    frames = list(flight.frames)
    frames[5], frames[6] = fault(frames[5]), fault(frames[6])
    results = run(create(settings), frames)
    for i in (5, 6):
        assert results[i].status is not LOST
        assert results[i].reset_counter == 0
        # Predicted or measured with what is left: near the truth, not back at the start.
        assert error_m(results[i], flight.poses[i]) < 0.12
    assert results[7].status in MEASURED
    assert results[-1].status is TRACKING
    assert results[-1].reset_counter == 0
    assert error_m(results[-1], flight.poses[-1]) < 0.1


@each_fault
def test_bad_frames_at_the_start_are_waited_out(settings, flight, fault):
    needs_both_eyes(settings, fault)
    frames = list(flight.frames[:8])
    frames[0], frames[1] = fault(frames[0]), fault(frames[1])
    results = run(create(settings), frames)
    for result in results[:2]:
        assert result.status in (INITIALISING, GAP)
        np.testing.assert_array_equal(result.T_world_rig, np.eye(4))
    # Nothing was measured before frame 2 or 3: the world starts there.
    assert results[-1].status is TRACKING
    started = next(i for i, r in enumerate(results) if r.status in MEASURED) - 1
    T_true = inverse(flight.poses[started]) @ flight.poses[7]
    assert error_m(results[-1], T_true) < 0.08


@each_fault
def test_nothing_but_bad_frames_ends_in_no_pose_or_the_start(settings, flight, fault):
    """Thirty bad frames never become a motion."""
    needs_both_eyes(settings, fault)
    results = run(create(settings), [fault(at(flight.frames[i % 12], i)) for i in range(30)])
    for result in results:
        assert result.status in (INITIALISING, GAP, LOST)
        if result.T_world_rig is not None:
            assert error_m(result, np.eye(4)) == 0.0


def test_a_blind_eye_is_named_in_the_reason(settings, flight):
    odometry = create(settings)
    run(odometry, flight.frames[:2])
    result = odometry.process(without(flight.frames[2], 0, 1))
    assert result.status is GAP
    assert settings.roles[0] in result.reason
    assert "ffc" in result.reason


def test_one_wild_frame_moves_nothing(settings, flight):
    """A frame of another place: told as unmeasured, not as a jump of metres."""
    frames = list(flight.frames)
    shuffled = {
        role: replace(v, image=np.ascontiguousarray(v.image[::-1, ::-1]), display=None)
        for role, v in frames[6].views.items()
    }
    frames[6] = replace(
        frames[6], views={r: replace(v, display=v.image) for r, v in shuffled.items()}
    )
    results = run(create(settings), frames)
    assert error_m(results[6], flight.poses[6]) < 0.5
    assert error_m(results[-1], flight.poses[-1]) < 0.15


# ------------------------------------------------------------------------------- gaps, loss, return


def blind_frames(first: int, last: int, frame: RigFrame):
    return [without(at(frame, i), 0, 1) for i in range(first, last)]


def test_a_gap_is_predicted_with_growing_covariance_and_ends_as_lost(settings, flight):
    """GAP for ``coast_max_s``, then no pose at all: never identity, never the last one again."""
    odometry = create(settings, "status.coast_max_s=0.5")
    run(odometry, flight.frames[:6])
    last = odometry.process(flight.frames[6])
    results = run(odometry, blind_frames(7, 16, flight.frames[0]))
    gaps, lost = results[:5], results[5:]
    assert [r.status for r in gaps] == [GAP] * 5
    assert [r.status for r in lost] == [LOST] * 4
    before = last
    for i, result in enumerate(gaps):
        assert result.reason
        known = slice(3 if settings.of_bands else 0, 6)
        for now, then in (
            (result.covariance, before.covariance),
            (result.twist_covariance, last.twist_covariance),
        ):
            assert np.all(np.diag(now)[known] > np.diag(then)[known])
        moved = np.linalg.norm(result.T_world_rig[:3, 3] - before.T_world_rig[:3, 3])
        assert 0.02 < moved < 0.12  # it flew 0.06 m a frame
        assert error_m(result, flight.poses[7] if i == 0 else result.T_world_rig) < 0.12
        before = result
    # 0.5 s at 3 m/s^2 of unknown acceleration.
    if not settings.of_bands:
        assert 0.3 < np.sqrt(gaps[-1].covariance[0, 0]) < 1.0


def test_a_gap_that_ends_in_time_is_no_reset(settings, flight):
    odometry = create(settings)
    run(odometry, flight.frames[:4])
    run(odometry, [without(f, 0, 1) for f in flight.frames[4:8]])
    results = run(odometry, flight.frames[8:])
    assert results[0].status in MEASURED
    assert results[-1].reset_counter == 0
    assert error_m(results[-1], flight.poses[-1]) < 0.1
    # What was measured again is as sure as before, not as unsure as the guess was.
    at_least = 3 if settings.of_bands else 0
    assert np.sqrt(results[-1].covariance[at_least, at_least]) < 0.1


def test_recovery_elsewhere_is_a_reset_without_a_jump(settings, flight, room):
    """Lost, and seen again far from where it was lost: go on from the last pose, and say so."""
    odometry = create(settings, "status.coast_max_s=0.3")
    run(odometry, flight.frames[:5])
    gap = run(odometry, blind_frames(5, 20, flight.frames[0]))
    last_known = [r for r in gap if r.T_world_rig is not None][-1]
    T_elsewhere = exp_se3([0.0, 0.0, 2.0, 0.0, np.pi, 0.0])  # facing the wall behind
    rng = np.random.default_rng(8)
    path = T_elsewhere @ room.path(6)
    frames = [
        named(room.rig_frame((20 + i) * PERIOD_NS, T, rng), settings) for i, T in enumerate(path)
    ]
    results = run(odometry, frames)
    assert results[-1].status in MEASURED
    assert results[-1].reset_counter == 1
    first = next(i for i, r in enumerate(results) if r.status in MEASURED)
    assert first <= 3
    counters = [r.reset_counter for r in results]
    assert counters == [0] * first + [1] * (6 - first)
    jump = np.linalg.norm(results[first].T_world_rig[:3, 3] - last_known.T_world_rig[:3, 3])
    assert jump < 0.15 * (first + 1)
    steps_m = []
    known = slice(3 if settings.of_bands else 0, 6)
    assert np.trace(results[first].covariance[known, known]) > np.trace(
        last_known.covariance[known, known]
    )
    for a, b in zip(results[first:-1], results[first + 1 :], strict=True):
        steps_m.append(np.linalg.norm((inverse(a.T_world_rig) @ b.T_world_rig)[:3, 3]))
    # A map that begins anew has a unit of its own.
    step_m = np.median(steps_m) if settings.of_bands else 0.063
    assert step_m == pytest.approx(0.063, abs=0.06)
    np.testing.assert_allclose(steps_m, step_m, atol=0.04)


def test_lost_stays_lost_until_something_is_measured(settings, flight):
    odometry = create(settings, "status.coast_max_s=0.2")
    run(odometry, flight.frames[:3])
    results = run(odometry, blind_frames(3, 40, flight.frames[0]))
    assert {r.status for r in results[2:]} == {LOST}
    assert {r.reset_counter for r in results} == {0}


# ------------------------------------------------------------------------------------ good manners


def digest(frame: RigFrame) -> str:
    h = hashlib.sha256(repr((frame.stamp_ns, sorted(frame.views), frame.skew_ns)).encode())
    for role in sorted(frame.views):
        view = frame.views[role]
        for array in (view.image, view.mask, view.display, view.T_rig_camera):
            h.update(b"none" if array is None else np.ascontiguousarray(array).tobytes())
    return h.hexdigest()


def test_frames_are_not_changed(settings, flight):
    """Arrays are read-only besides; here also those whose owner left them open."""
    odometry = create(settings)
    for frame in flight.frames[:4]:
        before = digest(frame)
        for view in frame.views.values():
            view.image.flags.writeable = view.display.flags.writeable = True
        odometry.process(frame)
        for view in frame.views.values():
            view.image.flags.writeable = view.display.flags.writeable = False
        assert digest(frame) == before


def test_results_are_the_callers_own(settings, flight):
    """Whoever scribbles on a result does not reach the method."""
    odometry, other = create(settings), create(settings)
    for frame in flight.frames[:6]:
        result, expected = odometry.process(frame), other.process(frame)
        assert same(result, expected)
        for array in (result.T_world_rig, result.covariance, result.twist, result.twist_covariance):
            if array.flags.writeable:
                array[...] = 7e7
        cloud = odometry.local_map()
        for array in (cloud.xyz, cloud.intensity):
            if array.flags.writeable:
                array[...] = 7e7


def test_no_file_is_opened_and_nothing_is_printed(settings, flight, monkeypatch, capfd):
    odometry = create(settings)
    odometry.warm_up()
    run(odometry, flight.frames[:2])

    def refuse(*arguments, **_):
        raise AssertionError(f"a method opened {arguments[0]}")

    monkeypatch.setattr(builtins, "open", refuse)
    run(odometry, flight.frames[2:5])
    run(odometry, [BAD["black"](flight.frames[5]), without(flight.frames[6], 0, 1)])
    run(odometry, flight.frames[7:9])
    odometry.local_map()
    monkeypatch.undo()
    assert capfd.readouterr() == ("", "")


def test_warm_up_leaves_no_trace(settings, flight):
    """Warm or cold, before the first frame or between two: the same results."""
    cold, warm = create(settings), create(settings)
    warm.warm_up()
    for i, frame in enumerate(flight.frames[:5]):
        if i == 2:
            warm.warm_up()
        assert same(cold.process(frame), warm.process(frame))


def test_stage_times_name_what_took_time(settings, flight):
    odometry = create(settings)
    result = run(odometry, flight.frames[:3])[-1]
    assert result.stats.stage_ms
    assert all(ms >= 0 for ms in result.stats.stage_ms.values())
