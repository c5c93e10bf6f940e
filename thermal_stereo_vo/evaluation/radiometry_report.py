"""Figures of the thermal front end on real recordings: flat field, gate, refinement, cost."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.calibration.flat_field_recordings import read_flat_fields
from thermal_stereo_vo.calibration.radiometric import (
    FlatFrame,
    every_second_temperature,
    fit_flat_field,
    non_uniformity,
    residual_counts,
)
from thermal_stereo_vo.core.cameras import LEFT, RIGHT, Camera
from thermal_stereo_vo.core.frames import CameraView, RawFrame, RigFrame
from thermal_stereo_vo.radiometry.agc import AutomaticGain
from thermal_stereo_vo.radiometry.flat_field import KELVIN, FlatField
from thermal_stereo_vo.radiometry.front_end import warm_up
from thermal_stereo_vo.radiometry.gate import FrameGate
from thermal_stereo_vo.radiometry.scene_based import SceneBasedConfig, SceneBasedCorrection

OUTSIDE_KELVIN = 10.0

Image = NDArray[np.generic]


def radiometry_report(data: Path) -> Iterator[str]:
    """Lines of the report, section by section; a recording that is absent is named.

    Args:
        data: folder with the recordings ``flat_fields_fpa``, ``lepton_cptv``, ``optris_sweep``,
            ``euroc_standing_still`` and ``lwir_drive``.
    """
    sections: list[tuple[str, str, Callable[[Path], Iterator[str]]]] = [
        ("stored flat field", "flat_fields_fpa", flat_field_figures),
        ("gate on thermal video", "lepton_cptv", gate_figures),
        ("gate on a hand-held sweep", "optris_sweep", gate_figures),
        ("gate on a standing rig", "euroc_standing_still", gate_figures),
        ("gate on a drive", "lwir_drive", gate_figures),
        ("scene-based refinement on a drive", "lwir_drive", refinement_figures),
    ]
    for title, folder, figures in sections:
        yield f"# {title}"
        if (data / folder).is_dir():
            yield from figures(data / folder)
        else:
            yield f"left out: there is no {data / folder}"
        yield ""
    yield "# cost of a 640x480 pair"
    yield from cost_figures()


def flat_field_figures(folder: Path) -> Iterator[str]:
    """Non-uniformity under a fit to every second FPA temperature, tested on the others."""
    fitted, tested = every_second_temperature(read_flat_fields(folder).frames)
    calibration = fit_flat_field(fitted)
    middle_kelvin = float(np.median([frame.fpa_kelvin for frame in fitted]))
    middle = min(fitted, key=lambda frame: abs(frame.fpa_kelvin - middle_kelvin))
    single = fit_flat_field([middle])
    before = np.array([non_uniformity(frame.image, calibration.bad) for frame in tested])
    by_single = residual_counts(single, tested)
    after = residual_counts(calibration, tested, reach_kelvin=OUTSIDE_KELVIN)
    yield "FPA degC   uncorrected   one temperature   polynomial   [counts, spatial std]"
    for frame, *values in zip(tested, before, by_single, after, strict=True):
        uncorrected, one, polynomial = values
        yield (
            f"{frame.fpa_kelvin - KELVIN:8.2f} {uncorrected:13.1f} {one:17.1f} {polynomial:12.2f}"
        )
    yield (
        f"mean: uncorrected {before.mean():.1f}, offset of {middle.fpa_kelvin - KELVIN:.1f} degC "
        f"{by_single.mean():.1f}, polynomial {after.mean():.2f} counts"
    )
    yield (
        f"the polynomial is {before.mean() / after.mean():.0f} times below uncorrected and "
        f"{by_single.mean() / after.mean():.0f} times below the offset of one temperature "
        f"(worst temperature: {np.min(before / after):.0f} times below uncorrected)"
    )
    yield from _outside_figures([*fitted, *tested])


def _outside_figures(frames: list[FlatFrame]) -> Iterator[str]:
    kelvins = np.array([frame.fpa_kelvin for frame in frames])
    low, high = np.percentile(kelvins, (25, 75))
    inside = [frame for frame in frames if low <= frame.fpa_kelvin <= high]
    calibration = fit_flat_field(inside)
    for edge, sign in ((calibration.minimum_kelvin, -1), (calibration.maximum_kelvin, 1)):
        wanted = edge + sign * OUTSIDE_KELVIN
        frame = min(frames, key=lambda frame: abs(frame.fpa_kelvin - wanted))
        clamped = residual_counts(calibration, [frame])[0]
        followed = residual_counts(calibration, [frame], reach_kelvin=2 * OUTSIDE_KELVIN)[0]
        distance = abs(frame.fpa_kelvin - edge)
        yield (
            f"{distance:.1f} K outside a fit of {low - KELVIN:.0f} to {high - KELVIN:.0f} degC, at "
            f"{frame.fpa_kelvin - KELVIN:.1f} degC: uncorrected "
            f"{non_uniformity(frame.image, calibration.bad):.0f}, clamped {clamped:.0f}, "
            f"extrapolated {followed:.0f} counts"
        )


def gate_figures(folder: Path) -> Iterator[str]:
    """Events in each clip of a folder, from images alone at even stamps."""
    for name, images in clips(folder):
        gate, held, repeats, count = FrameGate(camera=name), 0, 0, 0
        start = time.process_time()
        for image in images:
            decision = gate.process(RawFrame(image, 1 + count * 100_000_000, name, count))
            held, repeats, count = held + decision.blind, repeats + decision.repeat, count + 1
        wall_ms = (time.process_time() - start) * 1e3 / max(count, 1)
        yield (
            f"{name}: {count} frames, {len(gate.events)} events, {held} held back, "
            f"{repeats} repeats; {wall_ms:.2f} ms a frame with reading"
        )
        for event in gate.events:
            yield f"  {event}"


def clips(folder: Path) -> Iterator[tuple[str, Iterator[Image]]]:
    """Every clip in a folder: .npz with ``frames``, videos, folders of pictures."""
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as archive:
            yield path.stem, iter(archive["frames"])
    for path in sorted(folder.glob("*.avi")):
        yield path.stem, _video(path)
    for inner in sorted({path.parent for path in folder.rglob("*.png")}):
        files = sorted(inner.glob("*.png"))
        pictures = (cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in files)
        yield str(inner.relative_to(folder.parent)), iter(p for p in pictures if p is not None)


def _video(path: Path) -> Iterator[Image]:
    video = cv2.VideoCapture(str(path))
    while True:
        good, picture = video.read()
        if not good:
            return
        yield np.ascontiguousarray(picture[..., 0])


def refinement_figures(folder: Path) -> Iterator[str]:
    """Roughness and pattern of a drive before and after scene-based refinement, and its stop."""
    path = folder / "car_origin_1.avi"
    correction = SceneBasedCorrection(SceneBasedConfig(enabled=True))
    moving = range(300, 460)
    sums = np.zeros((2, 480, 640))
    rough: list[tuple[float, float]] = []
    views, offsets = [], {}
    for k, raw in enumerate(_video(path)):
        corrected = correction.process(raw, settled=True, epoch=0)
        views.append(correction.views)
        if k in moving:
            sums += np.stack([raw, corrected])
            if k % 20 == 0:
                rough.append((roughness(raw), roughness(corrected)))
        if k in (579, 599):
            offsets[k] = correction.offset
    before, after = np.mean(rough, axis=0)
    pattern = [float(np.std(_fine(part / len(moving)))) for part in sums]
    yield f"roughness {before:.4f} -> {after:.4f} ({after / before:.2f} of it)"
    yield (
        f"fine structure of the mean over {len(moving)} moving frames {pattern[0]:.2f} -> "
        f"{pattern[1]:.2f} grey levels ({(pattern[1] / pattern[0]) ** 2:.2f} of the energy)"
    )
    if len(offsets) == 2:
        change = float(np.abs(offsets[599] - offsets[579]).mean())
        yield (
            f"views learnt from: {views[-1]} of {len(views)} frames, {views[599] - views[579]} in "
            f"the last 20 frames at a stop; the pattern moved by {change:.2f} grey levels there"
        )


def roughness(image: Image) -> float:
    """L1 norm of the gradients over the L1 norm of the image."""
    values = image.astype(np.float64)
    gradients = np.abs(np.diff(values, axis=0)).sum() + np.abs(np.diff(values, axis=1)).sum()
    return float(gradients / max(np.abs(values).sum(), 1.0))


def _fine(image: NDArray[np.float64]) -> NDArray[np.float64]:
    smooth: NDArray[np.float64] = image - cv2.GaussianBlur(image, (0, 0), 5.0)
    return smooth


def cost_figures(pairs: int = 100) -> Iterator[str]:
    """Processor time of gate, flat field and gain control on one core, median of ``pairs``."""
    rng = np.random.default_rng(1)
    shape = (480, 640)
    flat = [
        FlatFrame(8000 + 40 * rng.standard_normal(shape) + 0.5 * fpa, fpa, None, "made up")
        for fpa in np.linspace(280.0, 320.0, 10)
    ]
    calibration = replace(fit_flat_field(flat), gain=np.full((1, *shape), 1.01, np.float32))
    slope = np.linspace(0, 400, shape[1])
    images = [(8000 + slope + 30 * rng.standard_normal(shape)).astype(np.uint16) for _ in range(8)]
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
    gates = {role: FrameGate(camera=role) for role in (LEFT, RIGHT)}
    fields = {role: FlatField(calibration) for role in (LEFT, RIGHT)}
    gain = AutomaticGain()
    warm_up()
    gain.warm_up()
    spent: dict[str, list[float]] = {"gate": [], "flat field": [], "gain control": []}
    for k in range(pairs):
        stamp_ns = 1 + k * 33_333_333
        raws = {r: RawFrame(images[(k + 3 * i) % 8], stamp_ns, r) for i, r in enumerate(gates)}
        marks = [time.process_time()]
        for role, gate in gates.items():
            gate.process(raws[role])
        marks.append(time.process_time())
        corrected = {
            role: field.process(raws[role].image, 290.0 + 0.01 * k, stamp_ns)
            for role, field in fields.items()
        }
        marks.append(time.process_time())
        gain.process(
            RigFrame(stamp_ns, {role: CameraView(corrected[role], camera) for role in gates})
        )
        marks.append(time.process_time())
        for name, seconds in zip(spent, np.diff(marks), strict=True):
            spent[name].append(1e3 * seconds)
    parts = ", ".join(f"{name} {np.median(values):.2f}" for name, values in spent.items())
    total = np.sum(list(spent.values()), axis=0)
    yield (
        f"{np.median(total):.2f} ms (median), {np.percentile(total, 95):.2f} ms (95 %), of which "
        f"{parts}"
    )
