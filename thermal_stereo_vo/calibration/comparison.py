"""Two calibrations side by side, laid out as Tables I to III of P1."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from thermal_stereo_vo.calibration.figures import StereoErrors
from thermal_stereo_vo.calibration.result import CalibrationResult
from thermal_stereo_vo.core.cameras import RigCalibration
from thermal_stereo_vo.core.transforms import exp_so3, inverse, log_so3

_LENS_ROWS = ("fx", "fy", "u0", "v0", "k1", "k2", "p1", "p2", "k3")


@dataclass(frozen=True)
class Column:
    """One calibration in the tables.

    ``lenses`` role -> values in the order fx fy u0 v0 k1 k2 p1 p2 k3; ``sigmas`` likewise where
    known; ``place_sigmas`` are those of translation (mm) and rotation vector (rad).  ``stereo``
    are the figures on the views at hand.
    """

    name: str
    lenses: Mapping[str, tuple[float, ...]]
    translation_mm: tuple[float, float, float] | None
    rotation_vector_rad: tuple[float, float, float] | None
    stereo: StereoErrors | None
    sigmas: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    mre_px: Mapping[str, float] = field(default_factory=dict)
    place_sigmas: tuple[float, ...] | None = None


def column_of_result(name: str, result: CalibrationResult) -> Column:
    """Our own calibration; stereo figures are the held-out ones where there are any."""
    lenses, sigmas = {}, {}
    for role, camera in result.cameras.items():
        values, sigma = (
            camera.parameters,
            dict(zip(camera.lens.names, camera.sigma.tolist(), strict=True)),
        )
        order = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
        lenses[role] = tuple(values.get(n, 0.0) for n in order)
        sigmas[role] = tuple(sigma.get(n, 0.0) for n in order)
    pair = result.pair
    return Column(
        name,
        lenses,
        None if pair is None else _three(1e3 * pair.T_second_first[:3, 3]),
        None if pair is None else _three(pair.rotation_vector_rad),
        None if pair is None else pair.held_out or pair.training,
        sigmas,
        {role: camera.training.mean_px for role, camera in result.cameras.items()},
        None if pair is None else (*(1e3 * pair.sigma[:3]).tolist(), *pair.sigma[3:].tolist()),
    )


def column_of_calibration(
    name: str,
    calibration: RigCalibration,
    roles: Sequence[str],
    stereo: StereoErrors | None,
) -> Column:
    """A calibration from a file."""
    lenses = {}
    for role in roles:
        c = calibration[role].camera
        coefficients = (*c.distortion, *(0.0,) * 5)[:5]
        lenses[role] = (c.fx, c.fy, c.cx, c.cy, *coefficients)
    translation = rotation = None
    if len(roles) == 2:
        T = inverse(calibration.T_a_b(roles[0], roles[1]))
        translation, rotation = _three(1e3 * T[:3, 3]), _three(log_so3(T[:3, :3]))
    return Column(name, lenses, translation, rotation, stereo)


def tables(columns: Sequence[Column]) -> list[tuple[str, list[str], list[list[str]]]]:
    """(title, head, rows) of each table, as text."""
    roles = list(columns[0].lenses)
    found = []
    if any(c.translation_mm is not None for c in columns):
        rows = []
        for c in columns:
            rows.append([c.name, _vector(c.translation_mm, 3), _vector(c.rotation_vector_rad, 5)])
            if c.place_sigmas is not None:
                sigmas = c.place_sigmas
                rows.append(["+-", _vector(sigmas[:3], 3), _vector(sigmas[3:], 5)])
        found.append(("Stereo parameters (P1 Table I)", ["", "T [mm]", "R [rad]"], rows))
    head = ["", *(f"{c.name} {role}" for c in columns for role in roles)]
    rows = []
    for k, name in enumerate(_LENS_ROWS):
        values = [(c, role, c.lenses[role][k]) for c in columns for role in roles]
        if name == "k3" and not any(v for _, _, v in values):
            continue
        rows.append([name, *(_number(v, c.sigmas.get(role), k) for c, role, v in values)])
    if any(c.mre_px for c in columns):
        cells = [
            f"{c.mre_px[role]:.4f}" if role in c.mre_px else "-" for c in columns for role in roles
        ]
        rows.append(["MRE [px]", *cells])
    found.append(("Lenses (P1 Table II)", head, rows))
    with_figures = [c for c in columns if c.stereo is not None]
    if with_figures:
        head = ["", *(c.name for c in with_figures)]
        figures = [c.stereo for c in with_figures if c.stereo is not None]
        rows = [
            ["Error 1-2 [px]", *(f"{s.epipolar_12_px:.4f}" for s in figures)],
            ["Error 2-1 [px]", *(f"{s.epipolar_21_px:.4f}" for s in figures)],
            ["corner spacing [%]", *(f"{s.spacing_error_percent:+.3f}" for s in figures)],
            ["corner spacing scatter [mm]", *(f"{1e3 * s.spacing_rms_m:.3f}" for s in figures)],
            ["flatness [mm]", *(f"{1e3 * s.plane_rms_m:.3f}" for s in figures)],
            ["board distance [%]", *(f"{s.distance_error_percent:+.3f}" for s in figures)],
            ["relative yaw [mrad]", *(f"{1e3 * s.yaw_error_rad:+.3f}" for s in figures)],
            ["points in front [%]", *(f"{100 * s.in_front:.1f}" for s in figures)],
            ["views", *(str(s.views) for s in figures)],
        ]
        found.append(("Epipolar errors (P1 Table III) and what they are blind to", head, rows))
    return found


def truth_lines(result: CalibrationResult, truth: Column) -> list[str]:
    """How far a calibration is from the true one."""
    lines = []
    for role, camera in result.cameras.items():
        c, true = camera.camera, truth.lenses[role]
        lines.append(
            f"against the truth, {role}: fx {100 * (c.fx / true[0] - 1):+.3f} %, fy "
            f"{100 * (c.fy / true[1] - 1):+.3f} %, centre {c.cx - true[2]:+.3f}, "
            f"{c.cy - true[3]:+.3f} px"
        )
    if result.pair is not None and truth.translation_mm is not None:
        true_mm = float(np.linalg.norm(truth.translation_mm))
        turn = result.pair.T_second_first[:3, :3] @ exp_so3(truth.rotation_vector_rad or ()).T
        lines.append(
            f"against the truth: baseline {1e3 * result.pair.baseline_m - true_mm:+.4f} mm, "
            f"rotation {1e3 * float(np.linalg.norm(log_so3(turn))):.3f} mrad"
        )
    return lines


def as_text(columns: Sequence[Column]) -> str:
    """The tables for a terminal."""
    lines = []
    for title, head, rows in tables(columns):
        widths = [max(len(row[k]) for row in [head, *rows]) for k in range(len(head))]
        lines.append(title)
        for row in [head, *rows]:
            cells = [row[0].ljust(widths[0])]
            cells += [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
            lines.append("  " + "  ".join(cells).rstrip())
        lines.append("")
    return "\n".join(lines)


def _three(vector: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in vector)
    return x, y, z


def _vector(values: Sequence[float] | None, digits: int) -> str:
    if values is None:
        return "-"
    return "[" + " ".join(f"{v:.{digits}f}" for v in values) + "]"


def _number(value: float, sigmas: tuple[float, ...] | None, k: int) -> str:
    digits = 3 if k < 4 else 5
    if sigmas is None:
        return f"{value:.{digits}f}"
    if k >= 4 and sigmas[k] == 0.0:
        return "0 (fixed)"
    return f"{value:.{digits}f} +- {sigmas[k]:.{digits}f}"
