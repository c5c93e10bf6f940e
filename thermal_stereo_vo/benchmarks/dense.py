"""Dense stereo against the simulator's truth, beside OpenCV's as it comes out of the box."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.benchmarks.dense_views import TrueView
from thermal_stereo_vo.core.cameras import LEFT, RIGHT
from thermal_stereo_vo.evaluation.report import format_table
from thermal_stereo_vo.radiometry.agc import AgcConfig, AutomaticGain
from thermal_stereo_vo.stereo.dense import DenseConfig, DenseStereo

Map = NDArray[np.float32]

WEATHERS = {"day": "seq4", "cloudy night": "seq7", "clear cold night": "seq6"}
"""Name -> flight of Mouats et al. 2015, Table IV."""

NEAR_M = 30.0
PLAIN, OURS = "OpenCV, defaults", "this package, defaults"
USUAL = "OpenCV, usual penalties"
PLAIN_THINNED, OURS_FILLED = "OpenCV, uniqueness as needed", "this package, surest first"
_UNIQUENESS = (0, 5, 10, 15, 20, 30, 40, 50, 60, 70, 80, 90)
_USUAL = {"blockSize": 5, "P1": 8 * 25, "P2": 32 * 25}
"""As OpenCV's documentation proposes; by default there is no penalty at all."""
_STEPS = 16


@dataclass(frozen=True)
class DenseScore:
    """Of one disparity map: shares 0..1 of judged pixels, and of those with a disparity.

    ``off_1`` and ``off_3`` are off by more than 1 and 3 px; sky has the true disparity 0.
    ``depth_error`` is the median relative error of depth where the truth is nearer than 30 m.
    """

    density: float
    off_1: float
    off_3: float
    depth_error: float
    wall_ms: float = float("nan")


@dataclass(frozen=True)
class DenseCell:
    """Mean score of one matcher in one weather."""

    weather: str
    matcher: str
    score: DenseScore


def measure(
    weather: str,
    views: Iterable[TrueView],
    config: DenseConfig,
    on_progress: Callable[[], None] = lambda: None,
) -> list[DenseCell]:
    """Both matchers at their own density, and each at that of the other."""
    scores: dict[str, list[DenseScore]] = {}
    for view in views:
        for name, score in _of_view(view, config):
            scores.setdefault(name, []).append(score)
        on_progress()
    return [DenseCell(weather, name, _mean(values)) for name, values in scores.items()]


def _of_view(view: TrueView, config: DenseConfig) -> Iterator[tuple[str, DenseScore]]:
    stereo = DenseStereo(config)
    stereo.process(view.frame)  # scratch memory
    start_s = time.perf_counter()
    result = stereo.process(view.frame)
    wall_ms = (time.perf_counter() - start_s) * 1e3
    assert result is not None
    ours = result.disparity_px
    everything = DenseStereo(_without_rejection(config)).process(view.frame)
    assert everything is not None
    start_s = time.perf_counter()
    plain = plain_disparity(view, config.disparities)
    plain_ms = (time.perf_counter() - start_s) * 1e3
    thinned = [plain_disparity(view, config.disparities, uniquenessRatio=u) for u in _UNIQUENESS]
    wanted = score(view, ours).density
    nearest = min(thinned, key=lambda disparity: abs(score(view, disparity).density - wanted))
    filled = surest(
        ours,
        everything.disparity_px,
        everything.sigma_px,
        view.judged,
        score(view, plain).density,
    )
    yield PLAIN, replace(score(view, plain), wall_ms=plain_ms)
    yield USUAL, score(view, plain_disparity(view, config.disparities, **_USUAL))
    yield OURS_FILLED, score(view, filled)
    yield OURS, replace(score(view, ours), wall_ms=wall_ms)
    yield PLAIN_THINNED, score(view, nearest)


def score(view: TrueView, disparity_px: Map) -> DenseScore:
    """Compare one map with the truth."""
    truth = view.disparity_px
    given = view.judged & np.isfinite(disparity_px)
    if not given.any():
        return DenseScore(0.0, float("nan"), float("nan"), float("nan"))
    error = np.abs(disparity_px - truth)[given]
    focal_px = view.frame.views[LEFT].camera.fx
    near = given & (truth > focal_px * view.baseline_m / NEAR_M)
    with np.errstate(divide="ignore"):
        relative = np.abs(truth[near] / disparity_px[near] - 1.0)
    return DenseScore(
        density=float(given.sum() / view.judged.sum()),
        off_1=float((error > 1.0).mean()),
        off_3=float((error > 3.0).mean()),
        depth_error=float(np.median(relative)),
    )


def plain_disparity(view: TrueView, disparities: int, **settings: int) -> Map:
    """(H, W) float32 of OpenCV's matcher on the 8-bit view for people."""
    shown = AutomaticGain(AgcConfig()).process(view.frame)
    matcher = cv2.StereoSGBM.create(0, disparities, **settings)
    steps = matcher.compute(shown.views[LEFT].display, shown.views[RIGHT].display)
    return np.where(steps < 0, np.float32(np.nan), steps.astype(np.float32) / _STEPS)


def surest(
    kept: Map, everything: Map, sigma_px: Map, judged: NDArray[np.bool_], share: float
) -> Map:
    """So many of the judged pixels (0..1): those kept first, then the others, the surest first."""
    penalty = np.where(np.isfinite(kept), 0.0, 1e3)
    order = np.where(judged & np.isfinite(everything), sigma_px + penalty, np.inf)
    wanted = min(round(share * judged.sum()), int(np.isfinite(order).sum()))
    limit = np.partition(order.ravel(), wanted - 1)[wanted - 1]
    values = np.where(np.isfinite(kept), kept, everything)
    return np.where(order <= limit, values, np.float32(np.nan))


def _without_rejection(config: DenseConfig) -> DenseConfig:
    return replace(
        config,
        uniqueness_percent=0,
        left_right_px=-1,
        max_sigma_px=100.0,
        speckle_px=0,
        sky_contrast=0.0,
        min_disparity_px=0.0,
    )


def _mean(scores: Sequence[DenseScore]) -> DenseScore:
    def of(name: str) -> float:
        return float(np.mean([getattr(value, name) for value in scores]))

    return DenseScore(
        of("density"),
        of("off_1"),
        of("off_3"),
        of("depth_error"),
        float(np.median([value.wall_ms for value in scores])),
    )


def dense_report(cells: Sequence[DenseCell]) -> str:
    """A row for each weather and matcher, then what is gained at equal density."""
    rows = []
    for cell in cells:
        s = cell.score
        rows.append(
            [
                f"{cell.weather}: {cell.matcher}",
                f"{100 * s.density:.1f}",
                f"{100 * s.off_1:.1f}",
                f"{100 * s.off_3:.1f}",
                f"{100 * s.depth_error:.1f}",
                "-" if np.isnan(s.wall_ms) else f"{s.wall_ms:.0f}",
            ]
        )
    header = ["", "density (%)", "> 1 px (%)", "> 3 px (%)", "depth to 30 m (%)", "ms"]
    lines = [format_table(header, rows), ""]
    for weather in dict.fromkeys(cell.weather for cell in cells):
        mine = {cell.matcher: cell.score for cell in cells if cell.weather == weather}
        for better, worse, at in ((OURS_FILLED, PLAIN, "OpenCV's"), (OURS, PLAIN_THINNED, "our")):
            a, b = mine[better], mine[worse]
            lines.append(
                f"{weather}: at {at} density ({100 * a.density:.0f} %) "
                f"{100 * (1 - a.off_1 / b.off_1):.0f} % fewer pixels off by more than 1 px, "
                f"{100 * (1 - a.off_3 / b.off_3):.0f} % by more than 3 px"
            )
    return "\n".join(lines)
