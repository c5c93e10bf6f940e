"""A whole calibration, from images to a folder of results."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.calibration.checks import check_eyes, check_known_baseline, verify
from thermal_stereo_vo.calibration.comparison import (
    Column,
    as_text,
    column_of_calibration,
    column_of_result,
    truth_lines,
)
from thermal_stereo_vo.calibration.figures import pair_views
from thermal_stereo_vo.calibration.gathering import Gathered, gather
from thermal_stereo_vo.calibration.geometric import calibrate
from thermal_stereo_vo.calibration.image_sources import (
    ImageShot,
    Source,
    image_shots,
    simulated_truth,
)
from thermal_stereo_vo.calibration.lenses import Lens
from thermal_stereo_vo.calibration.problem import KnownLens, Settings
from thermal_stereo_vo.calibration.report import figure_lines, html_report
from thermal_stereo_vo.calibration.result import CalibrationResult
from thermal_stereo_vo.calibration.targets import Target
from thermal_stereo_vo.calibration.views import camera_called
from thermal_stereo_vo.core.calibration_files import load_calibration, save_calibration
from thermal_stereo_vo.core.calibration_yaml import dump_camera_info
from thermal_stereo_vo.core.camera_info import infos_from_calibration
from thermal_stereo_vo.core.cameras import LEFT, RIGHT, RigCalibration
from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.outputs.replacing import write_text
from thermal_stereo_vo.outputs.run_folder import PROGRAM, RUN_FILE, RunFolder, versions

REPORT_FILE = "report.json"
PAGE_FILE = "report.html"
OVERLAYS = "overlays"

Say = Callable[[str], Any]
Step = Callable[[], None]


@dataclass(frozen=True)
class Request:
    """What is asked for.

    One role calibrates one camera, two a pair.  ``lens`` is a name of ``Lens`` or ``auto``.
    ``lens_from`` are results folders of earlier calibrations, one a role (or one that has all).
    ``baseline_m`` is the distance of the cameras where it is known otherwise.
    """

    source: Source
    target: Target
    roles: tuple[str, ...]
    output: Path
    lens: str = "auto"
    lens_from: tuple[Path, ...] = ()
    view_limit: int = 40
    baseline_m: float | None = None
    compare: Path | None = None
    command_line: tuple[str, ...] = ()


def open_images(request: Request) -> list[ImageShot]:
    """The images of a request."""
    return image_shots(request.source, request.roles)


def calibrate_and_report(
    request: Request,
    images: Sequence[ImageShot],
    *,
    step: Step = lambda: None,
    say: Say = lambda _: None,
) -> CalibrationResult:
    """Calibrate and write the results folder; after an error nothing is left behind.

    Raises CalibrationError with one sentence for whatever makes the views unfit.
    """
    known = _known_lenses(request)
    other = None if request.compare is None else load_calibration(request.compare)
    truth = simulated_truth(request.source)
    with RunFolder(request.output) as folder:
        gathered = gather(
            images, request.target, request.roles, overlays=folder.path / OVERLAYS, step=step
        )
        _tell_views(gathered, images, request.roles, say)
        lens = None if request.lens == "auto" else Lens(request.lens)
        result = calibrate(
            gathered.shots,
            request.target,
            {role: gathered.sizes[role] for role in request.roles},
            Settings(lens, request.view_limit, known),
        )
        result = replace(
            result,
            views=tuple(sorted((*result.views, *gathered.refused), key=lambda view: view.name)),
            warnings=(*result.warnings, *_missing(gathered, request.roles)),
        )
        if result.pair is not None:
            check_eyes(result.pair, request.roles)
            if request.baseline_m is not None:
                check_known_baseline(result.pair, request.target, request.baseline_m)
        columns = [column_of_result("this", result)]
        if other is not None:
            columns.append(_other_column(request, gathered, other, say))
        if truth is not None and set(request.roles) <= set(truth.cameras):
            columns.append(column_of_calibration("truth", truth, request.roles, None))
        rig = result.rig_calibration(f"calibration from {' '.join(request.source.paths)}")
        _write(request, folder, result, columns, rig, images)
    for line in (*figure_lines(result), "", as_text(columns)):
        say(line)
    if columns[-1].name == "truth":
        for line in truth_lines(result, columns[-1]):
            say(line)
    for warning in result.warnings:
        say(f"warning: {warning}")
    say(f"written to {request.output}: {PAGE_FILE}, {REPORT_FILE}, rig.yaml and camera_info")
    return result


def verify_and_tell(
    path: Path,
    source: Source,
    target: Target,
    roles: tuple[str, str],
    *,
    step: Step = lambda: None,
    say: Say = lambda _: None,
) -> None:
    """Judge the calibration in ``path`` by board images.

    Raises CalibrationError when it is wrong in one of the known ways.
    """
    try:
        calibration = load_calibration(path)
    except CalibrationError as error:
        raise CalibrationError(f"{path} cannot be used at all: {error}") from None
    gathered = gather(image_shots(source, roles), target, roles, step=step)
    for role in roles:
        if gathered.sizes[role] != calibration[role].camera.size:
            raise CalibrationError(
                f"the images of {camera_called(role)} are {gathered.sizes[role]} pixels, the "
                f"calibration is for {calibration[role].camera.size}"
            )
    views = _same_ends(gathered, calibration, roles, target)
    verdict = verify(calibration, roles, target, views)
    say(as_text([column_of_calibration(path.name, calibration, roles, verdict.errors)]))
    if verdict.findings:
        raise CalibrationError(f"{path} is wrong: {'; '.join(verdict.findings)}")
    say(f"{path} explains the views")


def _same_ends(
    gathered: Gathered, calibration: RigCalibration, roles: Sequence[str], target: Target
) -> list[Any]:
    """Pairs of views whose boards are numbered from the same end."""
    from thermal_stereo_vo.calibration.initial_rig import with_same_ends

    cameras = [calibration[role].camera for role in roles]
    shots = with_same_ends(gathered.shots, roles, cameras, target)
    return pair_views(shots, roles)


def _known_lenses(request: Request) -> dict[str, KnownLens]:
    known: dict[str, KnownLens] = {}
    for k, path in enumerate(request.lens_from):
        file = path / REPORT_FILE if path.is_dir() else path
        if not file.is_file():
            raise CalibrationError(f"there is no {file}: give a folder that 'calibrate' wrote")
        try:
            cameras = json.loads(file.read_text(encoding="utf-8"))["cameras"]
            for role, camera in cameras.items():
                lens = Lens(camera["lens"])
                lens_of_role = KnownLens(
                    lens,
                    np.array([camera["parameters"][name] for name in lens.names]),
                    np.array(camera["covariance"], dtype=np.float64),
                )
                if len(cameras) == 1 and len(request.lens_from) == len(request.roles):
                    known[request.roles[k]] = lens_of_role
                elif role in request.roles:
                    known[role] = lens_of_role
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise CalibrationError(
                f"{file} is no report of a calibration ({type(error).__name__}: {error}): give the "
                "folder that 'calibrate' wrote"
            ) from None
    if request.lens_from and not known:
        raise CalibrationError(
            f"none of {', '.join(map(str, request.lens_from))} holds a camera named "
            f"{' or '.join(request.roles)}"
        )
    return known


def _tell_views(
    gathered: Gathered, images: Sequence[ImageShot], roles: Sequence[str], say: Say
) -> None:
    for shot in images:
        for role in shot.load:
            detection = gathered.detections[shot.name, role]
            if not detection.found:
                say(f"{shot.name} {role}: refused, {detection.reason}")
    for role in roles:
        say(f"{role}: board found in {gathered.found(role)} of {gathered.seen(role)} images")
    if len(roles) == 2:
        both = sum(len(shot.views) == 2 for shot in gathered.shots)
        say(f"both cameras: {both} of {len(images)} shots")


def _missing(gathered: Gathered, roles: Sequence[str]) -> list[str]:
    return [
        f"{role}: board found in only {gathered.found(role)} of {gathered.seen(role)} images"
        for role in roles
        if gathered.found(role) < 0.5 * gathered.seen(role)
    ]


def _other_column(request: Request, gathered: Gathered, other: RigCalibration, say: Say) -> Column:
    assert request.compare is not None
    stereo = None
    if len(request.roles) == 2:
        views = _same_ends(gathered, other, request.roles, request.target)
        verdict = verify(other, request.roles, request.target, views)
        stereo = verdict.errors
        for finding in verdict.findings:
            say(f"{request.compare}: {finding}")
    return column_of_calibration(request.compare.name, other, request.roles, stereo)


def _write(
    request: Request,
    folder: RunFolder,
    result: CalibrationResult,
    columns: Sequence[Column],
    rig: RigCalibration,
    images: Sequence[ImageShot],
) -> None:
    from thermal_stereo_vo.calibration import plots

    save_calibration(rig, folder.path)
    if set(request.roles) != {LEFT, RIGHT}:
        for role, info in infos_from_calibration(_as_singles(rig)).items():
            write_text(folder.path / f"{role}.yaml", dump_camera_info(replace(info, name=role)))
    folder.write_json(REPORT_FILE, result.as_dict())
    pictures = {
        "Coverage": (
            "Every corner of every view that took part; orange cells saw none.",
            plots.coverage_picture(result),
        ),
        "Residuals": (
            "Arrows without pattern are noise; a swirl or a ring is a lens that the model does not "
            "hold.",
            plots.residual_picture(result),
        ),
        "Views": ("One bar a view and camera.", plots.view_picture(result)),
    }
    if request.roles == (LEFT, RIGHT):
        pair = _example_pair(result, images)
        if pair is not None:
            pictures["Rectified pair"] = (
                "The same point must lie on the same line in both eyes.",
                plots.rectified_picture(rig, pair),
            )
    what = " and ".join(request.roles)
    page = html_report(
        f"Calibration of {what}",
        result,
        columns,
        pictures,
        board_note=_board_note(result),
        command=" ".join(request.command_line),
    )
    write_text(folder.path / PAGE_FILE, page)
    folder.write_json(
        RUN_FILE,
        {
            "program": PROGRAM,
            "command_line": request.command_line,
            "source": request.source.paths,
            "versions": versions(),
        },
    )


def _as_singles(rig: RigCalibration) -> RigCalibration:
    """Each camera on its own, for camera_info files that know no pair."""
    return RigCalibration(
        {
            role: replace(
                mounted,
                rectification=np.eye(3),
                projection=np.column_stack([mounted.camera.matrix, np.zeros(3)]),
            )
            for role, mounted in rig.cameras.items()
        }
    )


def _example_pair(
    result: CalibrationResult, images: Sequence[ImageShot]
) -> dict[str, NDArray[Any]] | None:
    """Images of the used view with the least error in both eyes."""
    errors: Mapping[str, float] = {
        view.name: sum(view.rms_px.values()) for view in result.views if len(view.rms_px) == 2
    }
    names = [shot for shot in images if shot.name in errors and len(shot.load) == 2]
    if not names:
        return None
    best = min(names, key=lambda shot: errors[shot.name])
    return {role: load() for role, load in best.load.items()}


def _board_note(result: CalibrationResult) -> str:
    if result.hole_widening_m is None or result.hole_depth_m is None:
        return ""
    return (
        f"Its holes are {1e3 * result.hole_widening_m:+.2f} mm wider than said and their edges lie "
        f"{1e3 * result.hole_depth_m:.2f} mm behind the front (estimated)."
    )
