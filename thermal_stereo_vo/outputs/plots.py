"""One picture of a run: the way from above, the errors, the height."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.evaluation.alignment import aligned, up_axis
from thermal_stereo_vo.evaluation.association import DEFAULT_TOLERANCE_NS, Comparison, compare
from thermal_stereo_vo.evaluation.metrics import Metrics, evaluate, position_errors
from thermal_stereo_vo.outputs.replacing import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, FigureBase

Array = NDArray[np.float64]

# M. Okabe and K. Ito, Color universal design (2008): told apart by all kinds of colour vision.
ESTIMATE_COLOUR = "#0072B2"
TRUTH_COLOUR = "#222222"
END_COLOUR = "#D55E00"
START_COLOUR = "#009E73"
WAY_COLOURS = ("#E69F00", "#56B4E9", "#0072B2", "#CC79A7", "#D55E00")
DPI = 130


class _Way(NamedTuple):
    """A line of (N, 3) positions."""

    name: str
    positions_m: Array
    colour: str
    width: float = 1.5


def plot_run(
    path: Path,
    estimate: Trajectory,
    truth: Trajectory | None = None,
    metrics: Metrics | None = None,
    title: str = "",
    *,
    left_image: NDArray[np.uint8] | None = None,
    matches_image: NDArray[np.uint8] | None = None,
    tolerance_ns: int = DEFAULT_TOLERANCE_NS,
) -> None:
    """Write the picture of a run (see ``run_figure``) as PNG."""
    figure = run_figure(
        estimate,
        truth,
        metrics,
        title,
        left_image=left_image,
        matches_image=matches_image,
        tolerance_ns=tolerance_ns,
    )
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=DPI, format="png")


def run_figure(
    estimate: Trajectory,
    truth: Trajectory | None = None,
    metrics: Metrics | None = None,
    title: str = "",
    *,
    left_image: NDArray[np.uint8] | None = None,
    matches_image: NDArray[np.uint8] | None = None,
    tolerance_ns: int = DEFAULT_TOLERANCE_NS,
) -> Figure:
    """The picture of a run, with errors where the truth is known.

    ``metrics`` are those of ``estimate`` against ``truth`` (computed when missing); the estimate is
    drawn in the alignment they name.  ``left_image`` (H, W) uint8 and ``matches_image`` (H, W, 3)
    uint8 BGR are shown above.  Raises EvaluationError when nothing can be compared.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    images = [image for image in (left_image, matches_image) if image is not None]
    width_in, body_in = (12.0, 8.0) if truth is not None else (7.5, 7.5)
    layout = ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.08)
    image_in = _images_height_in(images, width_in)
    figure = Figure(figsize=(width_in, body_in + image_in), layout=layout)
    FigureCanvasAgg(figure)
    body: FigureBase = figure
    if images:
        heights = [image_in, body_in]
        top, body = cast("Iterable[FigureBase]", figure.subfigures(2, 1, height_ratios=heights))
        _draw_images(top, images)
    if truth is None:
        _draw_alone(body, estimate)
        way_m = float(estimate.path_lengths_m[-1]) if len(estimate) else 0.0
        summary = f"{len(estimate)} poses, {way_m:.1f} m"
    else:
        if metrics is None:
            metrics = evaluate(estimate, truth, tolerance_ns=tolerance_ns)
        comparison = compare(estimate, truth, tolerance_ns=tolerance_ns)
        _draw_comparison(body, aligned(comparison, metrics.alignment), metrics)
        summary = _summary(metrics)
    figure.suptitle(f"{title}\n{summary}" if title else summary, fontsize=12)
    return figure


def plot_ways(path: Path, truth_m: Array, ways: Mapping[str, Array], title: str) -> None:
    """Write several ways (N, 3) m beside the true one from above, y pointing down, as PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    drawn = [_Way("ground truth", truth_m, TRUTH_COLOUR, width=2.6)]
    drawn += [
        _Way(name, positions_m, colour)
        for (name, positions_m), colour in zip(ways.items(), cycle(WAY_COLOURS), strict=False)
    ]
    _draw_from_above(figure.add_subplot(), drawn, np.array([0.0, -1.0, 0.0]))
    figure.suptitle(title)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=DPI, format="png")


def view_from_above(up: Array) -> tuple[Array, Array]:
    """(3,) axes that point right and up on the page when looking down along ``up``.

    >>> view_from_above(np.array([0.0, 0.0, 1.0]))
    (array([1., 0., 0.]), array([0., 1., 0.]))
    >>> view_from_above(np.array([0.0, -1.0, 0.0]))
    (array([1., 0., 0.]), array([0., 0., 1.]))
    """
    right = np.eye(3)[1] if abs(up[0]) > 0.5 else np.eye(3)[0]
    return right, np.cross(up, right) + 0.0


def _images_height_in(images: list[NDArray[np.uint8]], width_in: float) -> float:
    if not images:
        return 0.0
    # Side by side at a common height.
    ratio = float(sum(image.shape[1] / image.shape[0] for image in images))
    return min(width_in / ratio + 0.2, 4.5)


def _draw_images(figure: FigureBase, images: list[NDArray[np.uint8]]) -> None:
    ratios = [image.shape[1] / image.shape[0] for image in images]
    axes = figure.subplots(1, len(images), width_ratios=ratios, squeeze=False)[0]
    for place, image in zip(axes, images, strict=True):
        if image.ndim == 3:
            place.imshow(image[:, :, ::-1])
        else:
            place.imshow(image, cmap="gray", vmin=0, vmax=255)
        place.set_axis_off()


def _draw_comparison(figure: FigureBase, comparison: Comparison, metrics: Metrics) -> None:
    grid = cast("Figure", figure).add_gridspec(3, 2, width_ratios=[1.25, 1.0])
    up = up_axis(comparison)
    ways = [
        _Way("ground truth", comparison.true_positions_m, TRUTH_COLOUR, width=2.6),
        _Way("estimate", comparison.estimated_positions_m, ESTIMATE_COLOUR),
    ]
    _draw_from_above(figure.add_subplot(grid[:2, 0]), ways, up)
    height = figure.add_subplot(grid[2, 0])
    if metrics.per_length:
        _draw_height(height, comparison.distances_m, "distance travelled (m)", ways, up)
        _draw_curve(figure.add_subplot(grid[0, 1]), metrics)
        lengths_m = [error.length_m for error in metrics.per_length]
        translation = figure.add_subplot(grid[1, 1], title="translation error over segments")
        errors = [error.translation_percent for error in metrics.per_length]
        _draw_lengths(translation, lengths_m, errors, metrics.avg_translation_error_percent, "%")
        rotation = figure.add_subplot(grid[2, 1], title="rotation error over segments")
        errors = [error.rotation_deg_per_m for error in metrics.per_length]
        _draw_lengths(rotation, lengths_m, errors, metrics.avg_rotation_error_deg_per_m, "deg/m")
    else:
        seconds = (comparison.stamps_ns - comparison.stamps_ns[0]) / 1e9
        _draw_height(height, seconds, "time (s)", ways, up)
        _draw_drift(figure.add_subplot(grid[:, 1]), seconds, comparison)


def _draw_alone(figure: FigureBase, estimate: Trajectory) -> None:
    grid = cast("Figure", figure).add_gridspec(3, 1)
    up = np.array([0.0, -1.0, 0.0])  # the world is the rig at its first pose, y down
    ways = [_Way("estimate", estimate.positions_m, ESTIMATE_COLOUR)]
    above, height = figure.add_subplot(grid[:2, 0]), figure.add_subplot(grid[2, 0])
    if len(estimate) == 0:
        above.set_title("tracking was lost from the first frame on")
        return
    _draw_from_above(above, ways, up)
    _draw_height(height, estimate.path_lengths_m, "distance travelled (m)", ways, up)


def _draw_from_above(axes: Axes, ways: Sequence[_Way], up: Array) -> None:
    right, ahead = view_from_above(up)
    for way in ways:
        x, y = way.positions_m @ right, way.positions_m @ ahead
        axes.plot(x, y, color=way.colour, lw=way.width, label=way.name)
    # The first way has its ends filled; where another one ends is a hollow mark.
    mark: dict[str, Any] = {"linestyle": "none", "zorder": 3}
    filled = {**mark, "markeredgecolor": "white"}
    hollow = {**mark, "markerfacecolor": "none"}
    for i, way in enumerate(ways):
        posed = way.positions_m[np.isfinite(way.positions_m[:, 0])]
        (x0, x1), (y0, y1) = posed[[0, -1]] @ right, posed[[0, -1]] @ ahead
        if i == 0:
            axes.plot(x0, y0, "o", color=START_COLOUR, label="start", ms=12, **filled)
            axes.plot(x1, y1, "s", color=END_COLOUR, label="end", ms=8, **filled)
        else:
            axes.plot(x1, y1, "s", ms=8, markeredgecolor=way.colour, **hollow)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.08)
    xlabel, ylabel = (f"{_axis_name(axis)} (m)" for axis in (right, ahead))
    axes.set(title="from above", xlabel=xlabel, ylabel=ylabel)
    axes.legend(loc="best", framealpha=0.9)
    _grid(axes)


def _draw_height(axes: Axes, along: Array, label: str, ways: Sequence[_Way], up: Array) -> None:
    start = ways[0].positions_m[0]
    for way in ways:
        axes.plot(along, (way.positions_m - start) @ up, color=way.colour, lw=way.width)
    axes.set(title="height over the start", xlabel=label, ylabel="m")
    _grid(axes)


def _draw_curve(axes: Axes, metrics: Metrics) -> None:
    curve = metrics.curve
    axes.plot(curve.distance_m, curve.error_percent, color=ESTIMATE_COLOUR, lw=1.5)
    axes.set_ylim(bottom=0)
    axes.set_xlim(0, 1.02 * metrics.path_length_m)
    axes.set(
        title=f"travelled error, from {curve.start_m:.0f} m on",
        xlabel="distance travelled (m)",
        ylabel="% of the distance",
    )
    _grid(axes)


def _draw_lengths(
    axes: Axes, lengths_m: Sequence[float], errors: Sequence[float], mean: float | None, unit: str
) -> None:
    if mean is not None:
        axes.axhline(mean, color="#777777", lw=1, ls="--")
    axes.plot(lengths_m, errors, "o-", color=ESTIMATE_COLOUR, lw=1.5, markersize=5)
    axes.set_ylim(bottom=0, top=1.15 * max(*errors, 1e-9))
    axes.set_xlim(0, 1.04 * lengths_m[-1])
    axes.set(xlabel="segment length (m)", ylabel=unit)
    _grid(axes)


def _draw_drift(axes: Axes, seconds: Array, comparison: Comparison) -> None:
    axes.plot(seconds, 1e3 * position_errors(comparison), color=ESTIMATE_COLOUR, lw=1.5)
    axes.set_ylim(bottom=0)
    axes.set(title="drift", xlabel="time (s)", ylabel="mm")
    _grid(axes)


def _summary(metrics: Metrics) -> str:
    parts = [f"{metrics.path_length_m:.1f} m"]
    if metrics.avg_translation_error_percent is not None:
        parts.append(f"average error {metrics.avg_translation_error_percent:.2f} %")
    if metrics.final_error_percent is not None:
        parts.append(
            f"final error {metrics.final_error_percent:.2f} % ({metrics.final_error_m:.2f} m)"
        )
    else:
        parts.append(f"final error {1e3 * metrics.final_error_m:.1f} mm")
    parts.append(f"ATE {metrics.ate_rmse_m:.3f} m")
    parts.append(f"coverage {metrics.coverage_percent:.1f} %")
    return " · ".join(parts)


def _axis_name(axis: Array) -> str:
    largest = int(np.argmax(np.abs(axis)))
    return f"{'-' if axis[largest] < 0 else ''}{'xyz'[largest]}"


def _grid(axes: Axes) -> None:
    axes.grid(color="#dddddd", lw=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
