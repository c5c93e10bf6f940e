"""Simulated frames beside recorded ones: pictures, histograms, spectra, figures.

The report says where the simulation lies within the spread of the recordings and where it does not.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.config import with_overrides
from thermal_stereo_vo.core.errors import DatasetError
from thermal_stereo_vo.evaluation.report import format_table
from thermal_stereo_vo.odometry.feature_count import fast_hessian_counter
from thermal_stereo_vo.outputs.replacing import replacing, write_text
from thermal_stereo_vo.radiometry.agc import AgcConfig
from thermal_stereo_vo.simulation.image_statistics import (
    ImageStatistics,
    gradient_magnitude,
    names,
    power_spectrum,
    statistics_of,
)
from thermal_stereo_vo.simulation.presets import find_preset
from thermal_stereo_vo.simulation.preview import display, sample_frames
from thermal_stereo_vo.simulation.settings import ThermalCameraConfig

Image = NDArray[np.uint8]

SAME_AGC = AgcConfig(mode="plateau", max_gain=255.0)
"""The gain control that every frame goes through, also those of 8 bits."""

THRESHOLD = 5.0
_FRACTIONS = tuple(float(f) for f in np.linspace(0.12, 0.95, 12))
_REFERENCE = "tau2_stills"
_COMPARED = "sunny day"
_SHARPENED = "sunny day, sharpened"
"""The stills went through the camera's detail enhancement, the simulated counts did not; this row
shows what a mild one (0.8 of what a Gaussian of 1.5 px takes away) does to the same frames."""


@dataclass(frozen=True)
class Sample:
    """Frames of one kind behind the same gain control."""

    name: str
    recorded: bool
    views: tuple[Image, ...]
    statistics: tuple[ImageStatistics, ...]

    def values(self, name: str) -> NDArray[np.float64]:
        """(N,) of one figure."""
        return np.array([getattr(s, name) for s in self.statistics])


def write_realism_report(data: Path, output: Path, overrides: Sequence[str] = ()) -> str:
    """Write ``realism.md``, ``realism.json`` and two pictures; returns the table.

    ``overrides`` change settings of every simulated run.  ``data`` holds any of ``tau2_stills``,
    ``lwir_drive``, ``optris_sweep`` and ``flat_fields_fpa``.  Raises DatasetError when it holds
    none of them.
    """
    count = fast_hessian_counter(THRESHOLD)
    samples = [*recorded_samples(data, count), *simulated_samples(count, overrides)]
    output.mkdir(parents=True, exist_ok=True)
    table = statistics_table(samples)
    verdict = spread_verdict(samples)
    pattern = pattern_table(data)
    for name, draw in (
        ("side_by_side.png", _draw_side_by_side),
        ("histograms.png", _draw_histograms),
    ):
        with replacing(output / name) as path:
            draw(samples, path.with_suffix(".png"))
            path.with_suffix(".png").replace(path)
    sections = [
        "# Simulated and recorded frames",
        "Every frame, also those of 8 bits, went through the same plateau gain control. "
        "Medians, with the 10th and 90th percentile over the frames.",
        f"```\n{table}\n```",
        f"## Does the {_COMPARED} lie within the spread of {_REFERENCE}?",
        f"```\n{verdict}\n```",
        "The stills show the halos of the camera's detail enhancement; counts have none.",
        "## Fixed pattern against temperature of the array",
        pattern,
        "![side by side](side_by_side.png)",
        "![histograms](histograms.png)",
    ]
    write_text(output / "realism.md", "\n\n".join(sections) + "\n")
    figures = {s.name: [dataclasses.asdict(one) for one in s.statistics] for s in samples}
    write_text(output / "realism.json", json.dumps(figures, indent=1) + "\n")
    return f"{table}\n\n{verdict}\n\n{pattern}"


def recorded_samples(data: Path, count: Callable[[Image], int]) -> list[Sample]:
    """The recordings there are.  Raises DatasetError when there is none."""
    found = []
    stills = sorted((data / _REFERENCE).glob("*.png"))
    if stills:
        frames = [_read(path)[:480] for path in stills]
        found.append(_sample(_REFERENCE, True, frames, count))
    video = data / "lwir_drive" / "car_cal_2_scene_2.avi"
    if video.exists():
        found.append(_sample("lwir_drive", True, _video_frames(video, 12), count))
    sweep = sorted((data / "optris_sweep").glob("*.png"))[::8]
    if sweep:
        found.append(_sample("optris_sweep", True, [_read(path) for path in sweep], count))
    if not found:
        raise DatasetError(
            f"{data} holds no recording to compare with: it should have folders such as "
            f"{_REFERENCE}, lwir_drive or optris_sweep"
        )
    return found


def simulated_samples(count: Callable[[Image], int], overrides: Sequence[str] = ()) -> list[Sample]:
    """A flight in every weather, and an office."""
    kinds = (
        (_COMPARED, "seq4", ("world.weather=sunny_day", "world.air_celsius=20")),
        ("cloudy day", "seq4", ()),
        ("foggy day", "seq2", ()),
        ("cloudy night", "seq7", ()),
        ("clear cold night", "seq6", ()),
        ("office", "ms-02", ()),
    )
    samples = []
    for name, preset, own in kinds:
        config = with_overrides(find_preset(preset).config, (*own, *overrides))
        frames = sample_frames(preset, config, _FRACTIONS)
        if preset.startswith("ms"):
            frames = frames[1::2]  # the thermal ones
        samples.append(_sample(name, False, frames, count))
        if name == _COMPARED:
            samples.append(_sample(_SHARPENED, False, [_sharpened(f) for f in frames], count))
    return samples


def statistics_table(samples: Sequence[Sample]) -> str:
    """A row for each sample: median (10 % .. 90 %)."""
    rows = []
    for sample in samples:
        cells = [("real: " if sample.recorded else "simulated: ") + sample.name]
        for name in names():
            low, middle, high = np.percentile(sample.values(name), [10, 50, 90])
            cells.append(f"{middle:.2f} ({low:.2f}..{high:.2f})")
        rows.append(cells)
    return format_table(["frames", *names()], rows)


def spread_verdict(samples: Sequence[Sample]) -> str:
    """For each figure, whether the median of the simulated day lies within the recorded spread."""
    by_name = {sample.name: sample for sample in samples}
    if _REFERENCE not in by_name:
        return f"{_REFERENCE} is not there to compare with."
    rows = []
    for name in names():
        low, high = np.percentile(by_name[_REFERENCE].values(name), [5, 95])
        cells = [name, f"{low:.2f} .. {high:.2f}"]
        for kind in (_COMPARED, _SHARPENED):
            middle = float(np.median(by_name[kind].values(name)))
            place = "within" if low <= middle <= high else "OUTSIDE"
            cells.append(f"{middle:.2f} {place}")
        rows.append(cells)
    return format_table(["median of", _REFERENCE, _COMPARED, _SHARPENED], rows)


def pattern_table(data: Path) -> str:
    """Growth of the fixed pattern per kelvin: a real core, and the settings of the simulation."""
    files = sorted((data / "flat_fields_fpa").glob("*.raw"))
    config = ThermalCameraConfig()
    simulated = (
        config.drift_shading_mk, config.drift_column_mk, config.drift_row_mk, config.drift_pixel_mk,
    )  # fmt: skip
    rows = [["simulated", *(f"{value / simulated[3]:.2f}" for value in simulated)]]
    if files:
        found = np.array(_pattern_growth(files))
        real = np.median(found / found[:, 3:], axis=0)
        rows.insert(0, ["real core", *(f"{value:.2f}" for value in real)])
    table = format_table(["relative to the pixel part", "shading", "column", "row", "pixel"], rows)
    return f"```\n{table}\n```"


def _pattern_growth(files: Sequence[Path]) -> list[list[float]]:
    """Shading, column, row and pixel parts (counts per kelvin) of neighbouring flat fields."""
    fields = []
    for path in files:
        found = re.search(r"_(-?\d+\.?\d*)_", path.name)
        if found:
            raw = np.frombuffer(path.read_bytes()[24:], "<u2")[: 480 * 640]
            fields.append((float(found.group(1)), raw.reshape(480, 640).astype(np.float32)))
    fields.sort(key=lambda item: item[0])
    growth = []
    for (t0, a), (t1, b) in itertools.pairwise(fields):
        step = b - a
        step = np.clip(step - np.median(step), -200.0, 200.0)
        shading = cv2.GaussianBlur(step, (0, 0), 25.0)
        rest = step - shading
        columns = rest.mean(axis=0)
        rest = rest - columns
        rows = rest.mean(axis=1)
        pixels = rest - rows[:, None]
        parts = (shading.std(), columns.std(), rows.std(), pixels.std())
        growth.append([float(part) / (t1 - t0) for part in parts])
    return growth


def _sample(
    name: str,
    recorded: bool,
    frames: Sequence[NDArray[np.uint8] | NDArray[np.uint16]],
    count: Callable[[Image], int],
) -> Sample:
    views = tuple(display(frame, SAME_AGC) for frame in frames)
    return Sample(name, recorded, views, tuple(statistics_of(view, count) for view in views))


def _sharpened(
    frame: NDArray[np.uint8] | NDArray[np.uint16],
) -> NDArray[np.uint16]:
    counts = frame.astype(np.float32)
    counts += 0.8 * (counts - cv2.GaussianBlur(counts, (0, 0), 1.5))
    return np.asarray(np.clip(np.rint(counts), 0, 65535).astype(np.uint16))


def _read(path: Path) -> NDArray[np.uint8] | NDArray[np.uint16]:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise DatasetError(f"cannot read the image {path}: copy it again")
    return np.ascontiguousarray(image if image.ndim == 2 else image[..., 0])


def _video_frames(path: Path, count: int) -> list[NDArray[np.uint8]]:
    video = cv2.VideoCapture(str(path))
    total = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
    wanted = set(np.linspace(5, total - 5, count).astype(int).tolist())
    frames = []
    for index in range(total):
        if not video.grab():
            break
        if index in wanted:
            frames.append(np.ascontiguousarray(video.retrieve()[1][..., 0]))
    video.release()
    return frames


def _draw_side_by_side(samples: Sequence[Sample], path: Path) -> None:
    size = (256, 192)
    rows = []
    for sample in samples:
        chosen = [sample.views[i] for i in np.linspace(0, len(sample.views) - 1, 5).astype(int)]
        row = np.hstack([cv2.resize(v, size, interpolation=cv2.INTER_AREA) for v in chosen])
        label = ("real: " if sample.recorded else "simulated: ") + sample.name
        cv2.rectangle(row, (0, 0), (9 * len(label) + 8, 20), 0, -1)
        cv2.putText(row, label, (4, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.48, 255, 1, cv2.LINE_AA)
        rows.append(row)
    cv2.imwrite(str(path), np.vstack(rows))


def _draw_histograms(samples: Sequence[Sample], path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 7.0), dpi=90, layout="constrained")
    FigureCanvasAgg(figure)
    grey, gradient, spectrum, features = figure.subplots(2, 2).ravel()
    for number, sample in enumerate(samples):
        style = {
            "label": ("real: " if sample.recorded else "") + sample.name,
            "color": f"C{number}",
            "linestyle": "-" if sample.recorded else "--",
            "linewidth": 1.4,
        }
        values = np.concatenate([view[::2, ::2].ravel() for view in sample.views])
        density, edges = np.histogram(values, 64, (0, 256), density=True)
        grey.plot(edges[:-1], density, **style)
        values = np.concatenate([gradient_magnitude(v)[::2, ::2].ravel() for v in sample.views])
        density, edges = np.histogram(values, np.linspace(0, 60, 61), density=True)
        gradient.semilogy(edges[:-1], density + 1e-7, **style)
        spectra = [power_spectrum(view) for view in sample.views]
        frequency = spectra[0][0]
        power = np.exp(np.mean([np.log(p + 1e-9) for _, p in spectra], axis=0))
        spectrum.loglog(frequency, power, **style)
        counts = np.sort(sample.values("features"))
        features.plot(counts, np.linspace(0, 1, len(counts)), **style)
    for axes, title, label in (
        (grey, "grey levels behind the gain control", "grey level"),
        (gradient, "gradients", "grey levels a pixel"),
        (spectrum, "power spectra", "cycles a pixel"),
        (features, "Fast-Hessian points (distribution over frames)", "per 10 000 pixels"),
    ):
        axes.set_title(title, fontsize=9)
        axes.set_xlabel(label, fontsize=8)
        axes.tick_params(labelsize=7)
        axes.grid(alpha=0.3)
    grey.legend(fontsize=7)
    figure.savefig(path)
