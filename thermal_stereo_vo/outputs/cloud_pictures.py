"""Pictures of clouds and disparity maps, for people."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.outputs.replacing import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 130
_EMPTY = np.nan
_PALETTE = "inferno"
_LARGEST_SPLAT_PX = 8


def colours_of(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """(N, 3) uint8 red, green, blue from dark to bright over the middle 96 % of the values."""
    from matplotlib import colormaps

    low, high = shown_range(values)
    part = np.clip((np.asarray(values, np.float64) - low) / max(high - low, 1e-9), 0.0, 1.0)
    rgba = colormaps[_PALETTE](np.nan_to_num(part))
    return np.asarray(np.rint(255 * rgba[:, :3]), np.uint8)


def shown_range(values: NDArray[np.floating]) -> tuple[float, float]:
    """The 2nd and the 98th percentile of what is finite."""
    finite = values[np.isfinite(values)]
    if len(finite) == 0:
        return 0.0, 1.0
    low, high = np.percentile(finite, [2.0, 98.0])
    return float(low), float(high)


def top_view(
    path: Path,
    xyz: NDArray[np.floating],
    values: NDArray[np.floating],
    way: NDArray[np.floating],
    *,
    label: str,
    title: str = "",
    point_m: float = 0.1,
) -> None:
    """Draw points (N, 3), z up, from above; the highest one covers those below it.

    ``values`` (N,) become colours; ``way`` (M, 3) is the path that was flown; ``point_m`` how far
    points are apart.
    """
    figure, axes = _figure((8.0, 6.5))
    if len(xyz):
        low = np.minimum(xyz.min(axis=0), way.min(axis=0) if len(way) else np.inf)[:2]
        high = np.maximum(xyz.max(axis=0), way.max(axis=0) if len(way) else -np.inf)[:2]
        pixel_m = max(float((high - low).max()) / 900.0, point_m)
        shape = tuple(int(n) + 1 for n in ((high - low) / pixel_m)[::-1])
        columns, rows = (((xyz[:, k] - low[k]) / pixel_m).astype(np.intp) for k in (0, 1))
        image = _nearest(shape, rows, columns, -xyz[:, 2], values)
        extent = (low[0], low[0] + shape[1] * pixel_m, low[1], low[1] + shape[0] * pixel_m)
        _show(figure, axes, image, label, shown_range(values), extent=extent)
    if len(way):
        axes.plot(way[:, 0], way[:, 1], color="#0072B2", lw=1.5)
    axes.set(xlabel="x (m)", ylabel="y (m)", title=title, aspect="equal")
    _save(figure, path)


def oblique_view(
    path: Path,
    xyz: NDArray[np.floating],
    values: NDArray[np.floating],
    *,
    label: str,
    title: str = "",
    eye_m: NDArray[np.floating],
    target_m: NDArray[np.floating],
    point_m: float = 0.1,
) -> None:
    """Draw points (N, 3), z up, as a camera at ``eye_m`` sees them that looks at ``target_m``."""
    width, height, focal_px = 1100, 700, 800.0
    ahead = np.asarray(target_m, np.float64) - eye_m
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= max(float(np.linalg.norm(right)), 1e-9)
    seen = (xyz - eye_m) @ np.stack([right, np.cross(ahead, right), ahead], axis=1)
    front = seen[:, 2] > 0.5
    depth_m = seen[front, 2]
    columns = np.rint(width / 2 + focal_px * seen[front, 0] / depth_m).astype(np.intp)
    rows = np.rint(height / 2 + focal_px * seen[front, 1] / depth_m).astype(np.intp)
    size_px = np.clip(np.rint(1.4 * point_m * focal_px / depth_m), 1, _LARGEST_SPLAT_PX)
    image = _splatted((height, width), rows, columns, depth_m, values[front], size_px)
    figure, axes = _figure((10.0, 6.0))
    _show(figure, axes, image, label, shown_range(values))
    axes.set(xticks=[], yticks=[], title=title)
    _save(figure, path)


def disparity_picture(
    path: Path,
    disparity_px: NDArray[np.floating],
    counts: NDArray[np.generic],
    *,
    title: str = "",
) -> None:
    """Draw a map (H, W; NaN is black) with a colour bar beside the image it is of."""
    from matplotlib.figure import Figure

    height, width = disparity_px.shape
    wide = width > 2 * height
    figure = Figure(figsize=(9.0, 6.0) if wide else (11.0, 4.2), layout="constrained")
    left, right = figure.subplots(2, 1) if wide else figure.subplots(1, 2)
    low, high = shown_range(counts.astype(np.float64).ravel())
    left.imshow(counts, cmap="gray", vmin=low, vmax=high)
    left.set(xticks=[], yticks=[], title="left image")
    _show(figure, right, disparity_px, "disparity (px)", shown_range(disparity_px), palette="turbo")
    right.set(xticks=[], yticks=[], title=title)
    _save(figure, path)


def _figure(size: tuple[float, float]) -> tuple[Figure, Axes]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots()


def _show(
    figure: Figure,
    axes: Axes,
    image: NDArray[np.floating],
    label: str,
    limits: tuple[float, float],
    *,
    extent: tuple[float, float, float, float] | None = None,
    palette: str = _PALETTE,
) -> None:
    axes.set_facecolor("black")
    drawn = axes.imshow(
        image,
        cmap=palette,
        vmin=limits[0],
        vmax=limits[1],
        origin="upper" if extent is None else "lower",
        extent=extent,
        interpolation="nearest",
    )
    figure.colorbar(drawn, ax=axes, label=label, shrink=0.85)


def _save(figure: Figure, path: Path) -> None:
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=DPI, format="png")


def _nearest(
    shape: tuple[int, ...],
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
    depth: NDArray[np.floating],
    values: NDArray[np.floating],
) -> NDArray[np.float64]:
    """(H, W): in each pixel the value of least depth, NaN where there is none."""
    image = np.full(shape, _EMPTY)
    order = np.argsort(-depth, kind="stable")  # the nearest is written last
    image[rows[order], columns[order]] = values[order]
    return image


def _splatted(
    shape: tuple[int, int],
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
    depth: NDArray[np.floating],
    values: NDArray[np.floating],
    size_px: NDArray[np.floating],
) -> NDArray[np.float64]:
    """As ``_nearest``, each point a square of its size."""
    parts = []
    for dy in range(_LARGEST_SPLAT_PX):
        for dx in range(_LARGEST_SPLAT_PX):
            fits = (size_px > max(dx, dy)) & (rows + dy >= 0) & (rows + dy < shape[0])
            fits &= (columns + dx >= 0) & (columns + dx < shape[1])
            parts.append((rows[fits] + dy, columns[fits] + dx, depth[fits], values[fits]))
    return _nearest(shape, *(np.concatenate(column) for column in zip(*parts, strict=True)))
