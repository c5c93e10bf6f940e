"""Results in ROS's frames and shapes, as plain dataclasses that nodes and bag files both use.

Frames after REP-103 and REP-105: ``odom`` is where ``base_link`` was at the start pose's origin,
x forward, y left, z up.  With A = T_base_rig, ``T_odom_base = A T_world_rig A^-1`` and a point of
the world frame is ``A p`` in ``odom``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.frames import FfcState, Telemetry
from thermal_stereo_vo.core.results import OdometryResult, PointCloud, TrackingStatus
from thermal_stereo_vo.core.transforms import (
    Matrix,
    adjoint,
    inverse,
    quat_xyzw_from_rotation,
    skew,
    transform_points,
)

if TYPE_CHECKING:
    from thermal_stereo_vo.stereo.dense import DisparityMap

Value = TypeVar("Value")

ODOM_FRAME = "odom"
BASE_FRAME = "base_link"
UNKNOWN_VARIANCE = 1e6
"""Variance of what was not measured ((m, rad, m/s, rad/s) squared): ROS has no "absent"."""

DELTA_PX = 1.0 / 16.0
"""Step of the matcher; the step on counts that follows has none."""

OK, WARN, ERROR, STALE = 0, 1, 2, 3
"""Levels of ``diagnostic_msgs/DiagnosticStatus``."""

_LEVELS = {
    TrackingStatus.INITIALISING: OK,
    TrackingStatus.TRACKING: OK,
    TrackingStatus.DEGRADED: WARN,
    TrackingStatus.GAP: WARN,
    TrackingStatus.LOST: ERROR,
}


@dataclass(frozen=True)
class OdometryFields:
    """``nav_msgs/Odometry``: pose in ``frame_id``, twist in ``child_frame_id``.

    ``position_m`` (3,), ``quat_xyzw`` (4,); ``linear_m_s`` and ``angular_rad_s`` (3,); covariances
    (6, 6), translation first, the pose's in axes of ``frame_id``.
    """

    stamp_ns: int
    position_m: NDArray[np.float64]
    quat_xyzw: NDArray[np.float64]
    pose_covariance: NDArray[np.float64]
    linear_m_s: NDArray[np.float64]
    angular_rad_s: NDArray[np.float64]
    twist_covariance: NDArray[np.float64]
    frame_id: str = ODOM_FRAME
    child_frame_id: str = BASE_FRAME


@dataclass(frozen=True)
class PointCloudFields:
    """``sensor_msgs/PointCloud2`` of one row: float32 columns, little-endian.

    x, y, z (m), intensity and, where known, temperature (K) and thermal counts.  ``data``
    (N * ``point_step``,) uint8.
    """

    stamp_ns: int
    width: int
    data: NDArray[np.uint8]
    frame_id: str = ODOM_FRAME
    names: tuple[str, ...] = ("x", "y", "z", "intensity")

    FLOAT32 = 7
    """``sensor_msgs/PointField.FLOAT32``."""

    @property
    def offsets(self) -> tuple[int, ...]:
        """Bytes before each column."""
        return tuple(range(0, self.point_step, 4))

    @property
    def point_step(self) -> int:
        """Bytes of a point."""
        return 4 * len(self.names)


@dataclass(frozen=True)
class DisparityFields:
    """``stereo_msgs/DisparityImage``.

    ``image`` (H, W) float32 with the offset of the principal points taken off, so that
    ``Z = focal_px * baseline_m / d``; unknown pixels lie one below ``min_disparity_px``.
    """

    stamp_ns: int
    image: NDArray[np.float32]
    focal_px: float
    baseline_m: float
    min_disparity_px: float
    max_disparity_px: float
    delta_px: float
    frame_id: str


@dataclass(frozen=True)
class DiagnosticFields:
    """``diagnostic_msgs/DiagnosticStatus`` in an array with the stamp of the image."""

    stamp_ns: int
    level: int
    name: str
    message: str
    values: tuple[tuple[str, str], ...]
    hardware_id: str = ""


def stamp_fields(stamp_ns: int) -> tuple[int, int]:
    """(sec, nanosec) of ``builtin_interfaces/Time``."""
    return divmod(stamp_ns, 1_000_000_000)


def odom_pose(T_world_rig: Matrix, T_base_rig: Matrix) -> Matrix:
    """(4, 4) T_odom_base."""
    return T_base_rig @ T_world_rig @ inverse(T_base_rig)


def world_pose(T_odom_base: Matrix, T_base_rig: Matrix) -> Matrix:
    """(4, 4) T_world_rig, the inverse of ``odom_pose``."""
    return inverse(T_base_rig) @ T_odom_base @ T_base_rig


def odom_covariance(
    covariance: NDArray[np.float64], T_world_rig: Matrix, T_base_rig: Matrix
) -> NDArray[np.float64]:
    """(6, 6) covariance of ``T_odom_base``, in ``odom`` axes, from that of ``T_world_rig``.

    An attitude error swings ``base_link`` about the rig: with A = (R_A, a) and the pose's rotation
    R' in ``odom``, ``dp' = R_A dp + [R' a]x R_A dphi`` and ``dphi' = R_A dphi``.
    """
    R_A, a = T_base_rig[:3, :3], T_base_rig[:3, 3]
    R_odom_base = R_A @ T_world_rig[:3, :3] @ R_A.T
    J = np.zeros((6, 6))
    J[:3, :3] = J[3:, 3:] = R_A
    J[:3, 3:] = skew(R_odom_base @ a) @ R_A
    return _symmetric(J @ covariance @ J.T)


def base_twist(
    twist: NDArray[np.float64], T_base_rig: Matrix
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The twist of ``base_link`` in its own axes and its (6, 6) Jacobian by the rig's twist.

    ``twist`` (6,): linear (m/s), then angular (rad/s) velocity of the rig in rig axes.  The lever
    arm enters through the adjoint: ``v_base = R_A v + a x (R_A omega)``.
    """
    J = adjoint(T_base_rig)
    return J @ twist, J


def odometry_fields(
    result: OdometryResult,
    T_base_rig: Matrix,
    *,
    frame_id: str = ODOM_FRAME,
    child_frame_id: str = BASE_FRAME,
) -> OdometryFields | None:
    """What ``/odom`` says of a result; None when it must be silent (LOST).

    A twist or covariance that the method does not give becomes zero with ``UNKNOWN_VARIANCE``.
    """
    if result.T_world_rig is None:
        return None
    unknown = UNKNOWN_VARIANCE * np.eye(6)
    T_odom_base = odom_pose(result.T_world_rig, T_base_rig)
    pose_covariance = unknown
    if result.covariance is not None:
        pose_covariance = odom_covariance(result.covariance, result.T_world_rig, T_base_rig)
    twist, twist_covariance = np.zeros(6), unknown
    if result.twist is not None:
        twist, J = base_twist(result.twist, T_base_rig)
        if result.twist_covariance is not None:
            twist_covariance = _symmetric(J @ result.twist_covariance @ J.T)
    return OdometryFields(
        stamp_ns=result.stamp_ns,
        position_m=T_odom_base[:3, 3],
        quat_xyzw=quat_xyzw_from_rotation(T_odom_base[:3, :3]),
        pose_covariance=pose_covariance,
        linear_m_s=twist[:3],
        angular_rad_s=twist[3:],
        twist_covariance=twist_covariance,
        frame_id=frame_id,
        child_frame_id=child_frame_id,
    )


def pose_fields(
    stamp_ns: int,
    T_frame_child: Matrix,
    *,
    frame_id: str = ODOM_FRAME,
    child_frame_id: str = BASE_FRAME,
) -> OdometryFields:
    """A known pose (ground truth) as odometry: no pose variance, twist unknown."""
    return OdometryFields(
        stamp_ns=stamp_ns,
        position_m=T_frame_child[:3, 3],
        quat_xyzw=quat_xyzw_from_rotation(T_frame_child[:3, :3]),
        pose_covariance=np.zeros((6, 6)),
        linear_m_s=np.zeros(3),
        angular_rad_s=np.zeros(3),
        twist_covariance=UNKNOWN_VARIANCE * np.eye(6),
        frame_id=frame_id,
        child_frame_id=child_frame_id,
    )


def point_cloud_fields(
    stamp_ns: int, cloud: PointCloud, T_base_rig: Matrix, *, frame_id: str = ODOM_FRAME
) -> PointCloudFields:
    """World points in ``odom`` axes, packed; points that are not finite are left out.

    A point of two bands may have been seen in one of them only: the other is NaN.
    """
    columns: list[NDArray[Any]] = [transform_points(T_base_rig, cloud.xyz), cloud.intensity]
    names: tuple[str, ...] = ("x", "y", "z", "intensity")
    if cloud.temperature_kelvin is not None:
        columns.append(cloud.temperature_kelvin)
        names = (*names, "temperature")
    known = np.column_stack(columns if cloud.thermal_counts is None else columns[:1])
    if cloud.thermal_counts is not None:
        columns.append(cloud.thermal_counts)
        names = (*names, "thermal")
    packed = np.column_stack(columns).astype("<f4")
    packed = np.ascontiguousarray(packed[np.all(np.isfinite(known), axis=1)])
    data = packed.view(np.uint8).reshape(-1)
    return PointCloudFields(stamp_ns, len(packed), data, frame_id, names)


def disparity_fields(disparities: DisparityMap, *, frame_id: str) -> DisparityFields:
    """What ``disparity`` says of a map."""
    offset_px = disparities.camera.cx - disparities.right_cx
    low, high = (limit - offset_px for limit in disparities.limits_px)
    image = disparities.disparity_px - np.float32(offset_px)
    return DisparityFields(
        stamp_ns=disparities.stamp_ns,
        image=np.where(np.isnan(image), np.float32(low - 1.0), image),
        focal_px=float(disparities.camera.fx),
        baseline_m=disparities.baseline_m,
        min_disparity_px=float(low),
        max_disparity_px=float(high),
        delta_px=DELTA_PX,
        frame_id=frame_id,
    )


def status_fields(result: OdometryResult, *, name: str = "odometry") -> DiagnosticFields:
    """Everything countable of a result, for ``status`` and ``/diagnostics``."""
    stats = result.stats
    values = {
        "status": result.status.value,
        "reason": result.reason,
        "reset_counter": str(result.reset_counter),
        "features": str(stats.features),
        "matches": str(stats.matches),
        "inliers": str(stats.inliers),
        "rms_px": f"{stats.rms_px:.3f}",
        "iterations": str(stats.iterations),
        "evaluations": str(stats.evaluations),
        "epipolar_dy_px": f"{stats.epipolar_dy_px:.3f}",
        "right_turn_mrad": " ".join(f"{angle:.3f}" for angle in stats.right_turn_mrad),
        "zero_flow": str(stats.zero_flow),
        "keyframe": str(stats.keyframe).lower(),
    }
    if result.scale_converged is not None:
        values["scale_converged"] = str(result.scale_converged).lower()
    if stats.scale_sigma is not None:
        values["scale_sigma"] = f"{stats.scale_sigma:.4g}"
    values |= {f"{stage}_ms": f"{ms:.3f}" for stage, ms in stats.stage_ms.items()}
    return DiagnosticFields(
        stamp_ns=result.stamp_ns,
        level=_LEVELS[result.status],
        name=name,
        message=result.reason or result.status.value,
        values=tuple(values.items()),
    )


def telemetry_fields(stamp_ns: int, camera: str, telemetry: Telemetry) -> DiagnosticFields:
    """What a camera reports beside the image with this stamp; keys it is silent on are left out."""
    values = {
        "fpa_temperature_kelvin": telemetry.fpa_temperature_kelvin,
        "housing_temperature_kelvin": telemetry.housing_temperature_kelvin,
        "ffc_state": telemetry.ffc_state.value if telemetry.ffc_state is not None else None,
        "frames_since_ffc": telemetry.frames_since_ffc,
        "time_since_ffc_ns": telemetry.time_since_ffc_ns,
    }
    return DiagnosticFields(
        stamp_ns=stamp_ns,
        level=OK,
        name=camera,
        message="telemetry",
        values=tuple((key, str(value)) for key, value in values.items() if value is not None),
        hardware_id=camera,
    )


def telemetry_from_values(values: Mapping[str, str]) -> Telemetry | None:
    """The inverse of ``telemetry_fields``; None when no key is a telemetry key or one is malformed.

    >>> telemetry_from_values({"fpa_temperature_kelvin": "301.5"}).fpa_temperature_kelvin
    301.5
    """

    def read(key: str, parse: Callable[[str], Value]) -> Value | None:
        return parse(values[key]) if key in values else None

    try:
        telemetry = Telemetry(
            fpa_temperature_kelvin=read("fpa_temperature_kelvin", float),
            housing_temperature_kelvin=read("housing_temperature_kelvin", float),
            ffc_state=read("ffc_state", FfcState),
            frames_since_ffc=read("frames_since_ffc", int),
            time_since_ffc_ns=read("time_since_ffc_ns", int),
        )
    except ValueError:
        return None
    return None if telemetry == Telemetry() else telemetry


def _symmetric(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    return 0.5 * (matrix + matrix.T)
