"""What a calibration gives, as an object and as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.calibration.figures import PixelErrors, StereoErrors
from thermal_stereo_vo.calibration.lenses import Lens
from thermal_stereo_vo.core.cameras import LEFT, RIGHT, Camera, RigCalibration, RigCamera
from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.core.transforms import inverse, log_so3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CameraResult:
    """One camera: its lens, the covariance of its parameters, and how well it fits.

    ``covariance`` (P, P) has the order of ``lens.names``.  ``held_out`` is measured on views that
    took no part;
    None where there were too few.
    """

    camera: Camera
    lens: Lens
    covariance: Array
    training: PixelErrors
    held_out: PixelErrors | None
    coverage: NDArray[np.bool_]
    tilt_range_rad: float

    @property
    def sigma(self) -> Array:
        """(P,) standard deviations."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def parameters(self) -> dict[str, float]:
        """Name -> value."""
        c = self.camera
        values = (c.fx, c.fy, c.cx, c.cy, *c.distortion)
        return dict(zip(self.lens.names, values, strict=False))


@dataclass(frozen=True)
class PairResult:
    """Where the second camera is: ``T_second_first`` (4, 4), metres.

    ``covariance`` (6, 6) is that of the left perturbation (rho, phi) of ``T_second_first``;
    ``sigma`` (6,) the standard deviations of its translation (m) and rotation vector (rad).
    """

    T_second_first: Array
    covariance: Array
    sigma: Array
    training: StereoErrors
    held_out: StereoErrors | None
    held_out_how: str

    @property
    def rotation_vector_rad(self) -> Array:
        """(3,) as in P1 Table I."""
        return log_so3(self.T_second_first[:3, :3])

    @property
    def baseline_m(self) -> float:
        """Distance of the two cameras."""
        return float(np.linalg.norm(self.T_second_first[:3, 3]))

    @property
    def baseline_sigma_m(self) -> float:
        """Standard deviation of that distance."""
        direction = self.T_second_first[:3, 3] / self.baseline_m
        # |t| moves by direction . rho only: the rotation part of a left perturbation keeps it.
        return float(np.sqrt(direction @ self.covariance[:3, :3] @ direction))


@dataclass(frozen=True)
class ViewRecord:
    """What became of one shot: ``used``, ``held out`` or ``refused``, with the reason.

    ``rms_px`` maps role to the reprojection error of that view in the final calibration.
    """

    name: str
    state: str
    reason: str = ""
    rms_px: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class CalibrationResult:
    """A calibration of one camera or of a pair (``pair`` is None for one).

    ``hole_widening_m`` and ``hole_depth_m`` are what a mask's holes came out as (see
    ``mask_model``); None for other boards.
    """

    board: str
    cameras: Mapping[str, CameraResult]
    pair: PairResult | None
    views: tuple[ViewRecord, ...]
    warnings: tuple[str, ...]
    hole_widening_m: float | None = None
    hole_depth_m: float | None = None
    residuals: Mapping[str, Array] = field(default_factory=dict)
    """role -> (N, 4): x, y of the point and its residual, px, for plots."""

    @property
    def stereo_rms_px(self) -> float:
        """RMS over the points of all cameras, as ``cv2.stereoCalibrate`` returns it."""
        parts = [camera.training for camera in self.cameras.values()]
        squares = sum(p.points * p.rms_px**2 for p in parts)
        return float(np.sqrt(squares / max(sum(p.points for p in parts), 1)))

    def rig_calibration(self, origin: str = "") -> RigCalibration:
        """The rig as the rest of the package knows it; left and right bring R and P."""
        roles = tuple(self.cameras)
        places = {roles[0]: np.eye(4)}
        if self.pair is not None:
            places[roles[1]] = inverse(self.pair.T_second_first)
        rig = {role: RigCamera(self.cameras[role].camera, places[role]) for role in roles}
        calibration = RigCalibration(rig, origin=origin)
        if roles == (LEFT, RIGHT):
            from thermal_stereo_vo.stereo.rectification import (
                RectificationConfig,
                with_rectification,
            )

            calibration, _ = with_rectification(calibration, RectificationConfig())
        return calibration

    def as_dict(self) -> dict[str, Any]:
        """Plain types for JSON."""
        document: dict[str, Any] = {
            "format": 1,
            "board": self.board,
            "cameras": {role: _camera_dict(c) for role, c in self.cameras.items()},
            "views": [asdict(view) for view in self.views],
            "warnings": list(self.warnings),
            "hole_widening_m": self.hole_widening_m,
            "hole_depth_m": self.hole_depth_m,
        }
        if self.pair is not None:
            pair = self.pair
            document["pair"] = {
                "first": next(iter(self.cameras)),
                "second": list(self.cameras)[1],
                "T_second_first": pair.T_second_first.tolist(),
                "translation_mm": (1e3 * pair.T_second_first[:3, 3]).tolist(),
                "translation_sigma_mm": (1e3 * pair.sigma[:3]).tolist(),
                "rotation_vector_rad": pair.rotation_vector_rad.tolist(),
                "rotation_vector_sigma_rad": pair.sigma[3:].tolist(),
                "covariance": pair.covariance.tolist(),
                "baseline_m": pair.baseline_m,
                "baseline_sigma_m": pair.baseline_sigma_m,
                "rms_px": self.stereo_rms_px,
                "training": pair.training.as_dict(),
                "held_out": None if pair.held_out is None else pair.held_out.as_dict(),
                "held_out_how": pair.held_out_how,
            }
        return document


def _camera_dict(result: CameraResult) -> dict[str, Any]:
    return {
        "image_size": list(result.camera.size),
        "lens": result.lens.value,
        "parameters": result.parameters,
        "sigma": dict(zip(result.lens.names, result.sigma.tolist(), strict=True)),
        "covariance": result.covariance.tolist(),
        "training": asdict(result.training),
        "held_out": None if result.held_out is None else asdict(result.held_out),
        "coverage_percent": 100.0 * float(result.coverage.mean()),
        "tilt_range_deg": float(np.degrees(result.tilt_range_rad)),
    }


@dataclass(frozen=True)
class StoredPair:
    """Place and uncertainty of a pair, read back from a report."""

    first: str
    second: str
    T_second_first: Array
    covariance: Array
    origin: str


def load_pair(path: Path) -> StoredPair:
    """Read ``report.json`` (or the folder that holds it).

    Raises CalibrationError for a file that is missing or holds no pair.
    """
    if path.is_dir():
        path = path / "report.json"
    if not path.is_file():
        raise CalibrationError(f"there is no {path}: give a folder that 'calibrate stereo' wrote")
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        pair = document["pair"]
        return StoredPair(
            pair["first"],
            pair["second"],
            np.array(pair["T_second_first"], dtype=np.float64).reshape(4, 4),
            np.array(pair["covariance"], dtype=np.float64).reshape(6, 6),
            str(path),
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CalibrationError(
            f"{path} is no report of a stereo calibration ({type(error).__name__}: {error}): give "
            "the report.json that 'calibrate stereo' wrote"
        ) from None
