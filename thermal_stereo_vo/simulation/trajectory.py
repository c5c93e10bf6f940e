"""How the rig flies: smooth splines with the attitude a quadrotor needs to follow them.

The position is a quintic B-spline, so that acceleration and turn rate are smooth.  Thrust must
balance gravity, acceleration and drag, which fixes the tilt; yaw is free (differential flatness,
Mellinger & Kumar 2011).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline

from thermal_stereo_vo.core.errors import SimulationError
from thermal_stereo_vo.core.transforms import log_so3, make_transform

Floats = NDArray[np.float64]

GRAVITY_M_S2 = 9.81
_DEGREE = 5
_KNOT_S = 0.4
_CORNER_M = 7.0
_DRAG_PER_S = 0.2


@dataclass(frozen=True)
class Limits:
    """What the pilot allows himself."""

    speed_m_s: float = 4.5
    acceleration_m_s2: float = 1.6
    lateral_m_s2: float = 1.8
    yaw_rate_rad_s: float = 0.6
    rest_s: float = 1.5
    """Time at rest before the start."""


class Motion:
    """Pose of ``base_link`` (x forward, y left, z up) in the map (east, north, up) over time.

    ``angles`` gives yaw alone for a quadrotor, whose roll and pitch follow from the acceleration;
    a hand-held rig brings a spline of (yaw, pitch, roll).
    """

    def __init__(self, position: BSpline, angles: BSpline, duration_s: float) -> None:
        self._position = position
        self._velocity = position.derivative(1)
        self._acceleration = position.derivative(2)
        self._angles = angles
        self.duration_s = duration_s

    def T_map_base(self, time_s: float) -> Floats:
        """(4, 4) pose; the motion rests before 0 and after its end."""
        t = float(np.clip(time_s, 0.0, self.duration_s))
        return make_transform(self._rotation(t), self._position(t))

    def velocity_m_s(self, time_s: float) -> Floats:
        """(3,) in map axes."""
        return np.asarray(self._velocity(np.clip(time_s, 0.0, self.duration_s)))

    def acceleration_m_s2(self, time_s: float) -> Floats:
        """(3,) in map axes, without gravity."""
        return np.asarray(self._acceleration(np.clip(time_s, 0.0, self.duration_s)))

    def angular_velocity_rad_s(self, time_s: float) -> Floats:
        """(3,) in base axes, by central difference over 2 ms."""
        step_s = 1e-3
        before = self.T_map_base(time_s - step_s)[:3, :3]
        after = self.T_map_base(time_s + step_s)[:3, :3]
        return log_so3(before.T @ after) / (2.0 * step_s)

    def length_m(self) -> float:
        """Distance travelled."""
        times = np.linspace(0.0, self.duration_s, int(self.duration_s * 20) + 2)
        return float(np.linalg.norm(np.diff(self._position(times), axis=0), axis=1).sum())

    def _rotation(self, t: float) -> Floats:
        angles = np.atleast_1d(self._angles(t))
        yaw = float(angles[0])
        if len(angles) == 3:
            return _rotation_zyx(yaw, float(angles[1]), float(angles[2]))
        thrust = self._acceleration(t) + _DRAG_PER_S * self._velocity(t)
        thrust = thrust + np.array([0.0, 0.0, GRAVITY_M_S2])
        z = thrust / np.linalg.norm(thrust)
        y = np.cross(z, [np.cos(yaw), np.sin(yaw), 0.0])
        y /= np.linalg.norm(y)
        return np.column_stack([np.cross(y, z), y, z])


@dataclass(frozen=True)
class Leg:
    """Fly along these points (N, 3) m, rounding the corners, and stop at the last."""

    points_m: tuple[tuple[float, float, float], ...]
    speed_m_s: float | None = None


@dataclass(frozen=True)
class Hover:
    """Stay in place, turning by ``turn_deg`` (counter-clockwise) meanwhile."""

    seconds: float
    turn_deg: float = 0.0


def fly(
    start_m: ArrayLike,
    yaw_rad: float,
    program: Sequence[Leg | Hover],
    limits: Limits,
    rng: np.random.Generator,
    *,
    length_m: float | None = None,
    gust_m: float = 0.05,
) -> Motion:
    """A quadrotor flight through ``program``, cut after ``length_m`` if that is given.

    ``gust_m`` is the standard deviation of the wobble about the wanted path.  Raises
    SimulationError when the program is shorter than ``length_m``.
    """
    wanted = length_m
    for _ in range(3):  # corners are cut by the spline: correct the nominal length for that
        samples, yaws = _nominal(np.asarray(start_m, float), yaw_rad, program, limits, wanted)
        motion = _spline_motion(samples, yaws, np.random.default_rng(0), limits, 0.0)
        if length_m is None or wanted is None:
            break
        wanted += length_m - motion.length_m()
    return _spline_motion(samples, yaws, rng, limits, gust_m)


def wander(
    centre_m: ArrayLike,
    size_m: ArrayLike,
    duration_s: float,
    speed_m_s: float,
    rotation_deg_s: float,
    rng: np.random.Generator,
    *,
    yaw_rad: float = 0.0,
) -> Motion:
    """A hand-held walk about ``centre_m`` with this mean speed and mean turn rate.

    The path stays within a box of ``size_m``; the rig keeps looking about ``yaw_rad``.
    """
    knot_s = 0.25
    count = int(np.ceil(duration_s / knot_s)) + 2 * _DEGREE

    def wave(columns: int, width: float) -> Floats:
        reach = int(4 * width)
        kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / width) ** 2)
        kernel /= np.sqrt(np.sum(kernel**2))
        white = rng.standard_normal((columns, count + 2 * reach))
        waves = [np.convolve(w, kernel, mode="valid") for w in white]
        return np.column_stack(waves).astype(np.float64)

    ramp = np.clip((np.arange(count) - _DEGREE) / 8.0, 0.0, 1.0)[:, None]
    place = np.asarray(size_m, float) / 2.0 * np.tanh(0.8 * wave(3, 6.0)) * ramp
    # A slow look around, and the quick unrest of hands that makes most of the turn rate.
    look = np.radians([14.0, 5.0, 3.0]) * wave(3, 10.0) * ramp
    unrest = np.array([1.0, 0.6, 0.45]) * wave(3, 1.0) * ramp
    knots = _knots(count, knot_s)
    times = np.linspace(0.0, duration_s, int(20 * duration_s))
    path = BSpline(knots, place, _DEGREE)
    speed = np.linalg.norm(np.diff(path(times), axis=0), axis=1).sum() / duration_s
    place *= speed_m_s / speed

    def with_unrest(amount: float) -> Motion:
        angles = look + amount * unrest + np.array([yaw_rad, 0.0, 0.0])
        return Motion(
            BSpline(knots, place + np.asarray(centre_m, float), _DEGREE),
            BSpline(knots, angles, _DEGREE),
            duration_s,
        )

    amount = 0.1
    for _ in range(6):
        angles = BSpline(knots, look + amount * unrest, _DEGREE)
        rate = _turn_rate_rad_s(angles(times), angles.derivative()(times))
        amount *= np.radians(rotation_deg_s) / float(np.mean(rate))
    return with_unrest(amount)


def glide(start_m: ArrayLike, end_m: ArrayLike, duration_s: float) -> Motion:
    """Straight from start to end at a steady speed, looking along +x; on the spot where equal."""
    knot_s = 0.25
    count = int(np.ceil(duration_s / knot_s)) + 2 * _DEGREE
    start = np.asarray(start_m, float)
    share = np.clip((np.arange(count) - _DEGREE) / (count - 2.0 * _DEGREE), 0.0, 1.0)
    place = start + share[:, None] * (np.asarray(end_m, float) - start)
    knots = _knots(count, knot_s)
    still = BSpline(knots, np.zeros((count, 3)), _DEGREE)
    return Motion(BSpline(knots, place, _DEGREE), still, duration_s)


def _turn_rate_rad_s(angles: Floats, rates: Floats) -> Floats:
    """(N,) length of the angular velocity of angles (N, 3) yaw, pitch, roll and their rates."""
    _, pitch, roll = angles.T
    yaw_rate, pitch_rate, roll_rate = rates.T
    x = roll_rate - np.sin(pitch) * yaw_rate
    y = np.cos(roll) * pitch_rate + np.cos(pitch) * np.sin(roll) * yaw_rate
    z = -np.sin(roll) * pitch_rate + np.cos(pitch) * np.cos(roll) * yaw_rate
    return np.asarray(np.sqrt(x * x + y * y + z * z), dtype=np.float64)


def _knots(count: int, knot_s: float = _KNOT_S) -> Floats:
    # Time 0 lies where the first full set of control points begins to act.
    return np.asarray((np.arange(count + _DEGREE + 1) - _DEGREE) * knot_s, dtype=np.float64)


def _spline_motion(
    samples: Floats, yaws: Floats, rng: np.random.Generator, limits: Limits, gust_m: float
) -> Motion:
    before = np.repeat(samples[:1], _DEGREE, axis=0)
    after = np.repeat(samples[-1:], _DEGREE, axis=0)
    control = np.concatenate([before, samples, after])
    angle = np.concatenate([np.full(_DEGREE, yaws[0]), yaws, np.full(_DEGREE, yaws[-1])])
    count = len(control)
    still = int(limits.rest_s / _KNOT_S) + _DEGREE
    ramp = np.clip((np.arange(count) - still) / 4.0, 0.0, 1.0)
    ramp *= np.clip((count - 2 * _DEGREE - np.arange(count)) / 4.0, 0.0, 1.0)  # and at the end
    kernel = np.array([1.0, 2.0, 3.0, 2.0, 1.0])
    kernel /= np.sqrt(np.sum(kernel**2))
    white = rng.standard_normal((count + len(kernel) - 1, 4))
    gusts = np.column_stack([np.convolve(w, kernel, mode="valid") for w in white.T])
    control = control + gust_m * ramp[:, None] * gusts[:, :3]
    angle = angle + 0.35 * gust_m * ramp * gusts[:, 3]
    knots = _knots(count)
    duration_s = (count - _DEGREE) * _KNOT_S
    return Motion(
        BSpline(knots, control, _DEGREE), BSpline(knots, angle[:, None], _DEGREE), duration_s
    )


def _nominal(
    start_m: Floats,
    yaw_rad: float,
    program: Sequence[Leg | Hover],
    limits: Limits,
    length_m: float | None,
) -> tuple[Floats, Floats]:
    """Positions (N, 3) and yaws (N,) at steps of ``_KNOT_S``."""
    at, yaw = start_m, yaw_rad
    steps = max(1, round(limits.rest_s / _KNOT_S))
    places = [np.repeat(at[None], steps, axis=0)]
    yaws = [np.full(steps, yaw)]
    left_m = np.inf if length_m is None else length_m
    for part in program:
        if isinstance(part, Hover):
            turn = np.radians(part.turn_deg)
            seconds = max(part.seconds, 1.5 * abs(turn) / limits.yaw_rate_rad_s)
            steps = max(2, int(np.ceil(seconds / _KNOT_S)))
            f = np.linspace(0.0, 1.0, steps)
            places.append(np.repeat(at[None], steps, axis=0))
            yaws.append(yaw + turn * f * f * (3.0 - 2.0 * f))
            yaw += turn
            continue
        path = _rounded(np.vstack([at, np.asarray(part.points_m, float)]))
        path = _cut(path, left_m)
        left_m -= float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
        place, heading = _timed(path, part.speed_m_s or limits.speed_m_s, limits)
        heading = np.unwrap(np.concatenate([[yaw], heading]))[1:]
        places.append(place)
        yaws.append(heading)
        at, yaw = place[-1], float(heading[-1])
        if left_m < 0.1:
            break
    if np.isfinite(left_m) and left_m > 1.0:
        raise SimulationError(
            f"this flight ends {left_m:.0f} m before the wanted length of {length_m:.0f} m: ask "
            "for a shorter one"
        )
    return np.concatenate(places), np.concatenate(yaws)


def _rounded(points: Floats) -> Floats:
    """The polyline every 0.1 m with corners replaced by arcs (quadratic Bezier)."""
    pieces: list[Floats] = []
    previous = points[0]
    for corner, following in itertools.pairwise(points[1:]):
        into, out = corner - previous, following - corner
        reach = min(_CORNER_M, *(0.45 * float(np.linalg.norm(part)) for part in (into, out)))
        a = corner - reach * into / np.linalg.norm(into)
        b = corner + reach * out / np.linalg.norm(out)
        pieces.append(np.linspace(previous, a, max(2, int(np.linalg.norm(a - previous) / 0.1))))
        f = np.linspace(0.0, 1.0, max(2, int(reach / 0.06)))[:, None]
        pieces.append((1 - f) ** 2 * a + 2 * f * (1 - f) * corner + f**2 * b)
        previous = b
    end = points[-1]
    pieces.append(np.linspace(previous, end, max(2, int(np.linalg.norm(end - previous) / 0.1))))
    path = np.concatenate(pieces)
    step = np.linalg.norm(np.diff(path, axis=0), axis=1)
    return np.asarray(path[np.concatenate([[True], step > 1e-6])])


def _cut(path: Floats, length_m: float) -> Floats:
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    return path[: max(2, int(np.searchsorted(travelled, length_m, side="right")))]


def _timed(path: Floats, speed_m_s: float, limits: Limits) -> tuple[Floats, Floats]:
    """Position and heading every ``_KNOT_S`` along a path flown within the limits."""
    step = np.linalg.norm(np.diff(path, axis=0), axis=1)
    travelled = np.concatenate([[0.0], np.cumsum(step)])
    s = np.arange(0.0, travelled[-1], 0.1)
    place = np.column_stack([np.interp(s, travelled, column) for column in path.T])
    heading = np.unwrap(np.arctan2(*np.gradient(place[:, :2], axis=0).T[::-1]))
    curvature = np.abs(np.gradient(heading, s))
    speed = np.minimum(
        speed_m_s,
        np.minimum(
            np.sqrt(limits.lateral_m_s2 / np.maximum(curvature, 1e-6)),
            limits.yaw_rate_rad_s / np.maximum(curvature, 1e-6),
        ),
    )
    slowest = 0.25
    speed[0] = speed[-1] = slowest
    for i in range(1, len(speed)):
        speed[i] = min(speed[i], np.sqrt(speed[i - 1] ** 2 + 0.2 * limits.acceleration_m_s2))
    for i in range(len(speed) - 2, -1, -1):
        speed[i] = min(speed[i], np.sqrt(speed[i + 1] ** 2 + 0.2 * limits.acceleration_m_s2))
    time = np.concatenate([[0.0], np.cumsum(0.2 / (speed[1:] + speed[:-1]))])
    ticks = np.arange(0.0, time[-1] + _KNOT_S, _KNOT_S)
    placed = np.column_stack([np.interp(ticks, time, column) for column in place.T])
    return placed, np.interp(ticks, time, heading)


def _rotation_zyx(yaw: float, pitch: float, roll: float) -> Floats:
    cy, sy, cp, sp, cr, sr = (f(a) for a in (yaw, pitch, roll) for f in (np.cos, np.sin))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
