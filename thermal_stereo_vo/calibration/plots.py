"""Pictures of a calibration report, as PNG bytes."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.calibration.normalisation import local_normalisation, stretch
from thermal_stereo_vo.calibration.result import CalibrationResult
from thermal_stereo_vo.core.cameras import RigCalibration

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_BLUE, _ORANGE = "#0072B2", "#D55E00"
_DPI = 110
_ARROW_PX = 30.0


def coverage_picture(result: CalibrationResult) -> bytes:
    """Where the board was seen: all points, and the cells that stayed empty."""
    figure = _figure(len(result.cameras), 3.6)
    for axes, (role, camera) in zip(
        _row(figure, len(result.cameras)), result.cameras.items(), strict=True
    ):
        width, height = camera.camera.size
        rows, columns = camera.coverage.shape
        for j, i in np.argwhere(~camera.coverage):
            x, y = i * width / columns, j * height / rows
            axes.fill(
                [x, x + width / columns, x + width / columns, x],
                [y, y, y + height / rows, y + height / rows],
                color=_ORANGE,
                alpha=0.25,
                linewidth=0,
            )
        points = result.residuals[role]
        axes.plot(points[:, 0], points[:, 1], ".", color=_BLUE, markersize=2)
        _as_image(axes, width, height)
        axes.set_title(f"{role}: {100 * camera.coverage.mean():.0f} % of the cells hold a point")
    return _png(figure)


def residual_picture(result: CalibrationResult) -> bytes:
    """Residuals as arrows in the image (a pattern there is a lens error), and as a cloud."""
    count = len(result.cameras)
    figure = _figure(2 * count, 3.4)
    cells = _row(figure, 2 * count)
    largest = max(float(np.percentile(np.abs(r[:, 2:]), 99)) for r in result.residuals.values())
    gain = _round_gain(_ARROW_PX / max(largest, 1e-6))
    for k, (role, camera) in enumerate(result.cameras.items()):
        x, y, dx, dy = result.residuals[role].T
        width, height = camera.camera.size
        axes = cells[2 * k]
        axes.quiver(
            x, y, gain * dx, gain * dy, angles="xy", scale_units="xy", scale=1.0,
            color=_BLUE, width=0.002,
        )  # fmt: skip
        _as_image(axes, width, height)
        axes.set_title(f"{role}: residuals x {gain:.0f}")
        axes = cells[2 * k + 1]
        axes.plot(dx, dy, ".", color=_BLUE, markersize=2)
        axes.axhline(0.0, color="0.7", linewidth=0.8)
        axes.axvline(0.0, color="0.7", linewidth=0.8)
        limit = max(1.3 * largest, 0.02)
        axes.set(xlim=(-limit, limit), ylim=(-limit, limit), xlabel="x [px]", ylabel="y [px]")
        axes.set_aspect("equal")
        axes.set_title(
            f"{role}: mean {camera.training.mean_px:.3f}, rms {camera.training.rms_px:.3f} px"
        )
    return _png(figure)


def _round_gain(gain: float) -> float:
    """The largest of 1, 2, 5, 10, 20, ... that is not above."""
    decade = 10.0 ** np.floor(np.log10(gain))
    return float(max(decade * step for step in (1.0, 2.0, 5.0) if decade * step <= gain))


def view_picture(result: CalibrationResult) -> bytes:
    """Reprojection error of each view that took part."""
    shown = [view for view in result.views if view.rms_px]
    roles = list(result.cameras)
    figure = _figure(1, 2.8, width=max(6.0, 0.28 * len(shown) + 2.0))
    (axes,) = _row(figure, 1)
    bar = 0.8 / len(roles)
    for k, (role, colour) in enumerate(zip(roles, (_BLUE, _ORANGE), strict=False)):
        heights = [view.rms_px.get(role, 0.0) for view in shown]
        at = np.arange(len(shown)) + (k - 0.5 * (len(roles) - 1)) * bar
        axes.bar(at, heights, bar, color=colour, label=role)
    axes.set_xticks(
        range(len(shown)), [_short(view.name) for view in shown], rotation=90, fontsize=7
    )
    axes.set_ylabel("rms [px]")
    axes.legend(frameon=False)
    axes.set_title("Reprojection error of each view")
    return _png(figure)


def rectified_picture(calibration: RigCalibration, images: dict[str, NDArray[Any]]) -> bytes:
    """Both eyes rectified, side by side with lines: the same point must lie on the same line."""
    from thermal_stereo_vo.core.cameras import LEFT, RIGHT
    from thermal_stereo_vo.core.frames import RadiometricFrame
    from thermal_stereo_vo.stereo.rectification import RectificationConfig, Rectifier

    rectifier = Rectifier(calibration, RectificationConfig())
    halves = []
    for role in (LEFT, RIGHT):
        view = rectifier.process(RadiometricFrame(images[role], 0, role), role)
        assert view is not None
        grey = _visible(view.image)
        halves.append(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR))
    picture = np.hstack(halves)
    step = max(20, picture.shape[0] // 20)
    for n, y in enumerate(range(step // 2, picture.shape[0], step)):
        colour = [(60, 200, 60), (60, 160, 255), (255, 160, 60)][n % 3]
        cv2.line(picture, (0, y), (picture.shape[1], y), colour, 1)
    return _encoded(picture)


def _visible(image: NDArray[Any]) -> NDArray[np.uint8]:
    return stretch(image) if image.dtype == np.uint8 else local_normalisation(image, 24.0)


def _encoded(picture: NDArray[np.uint8]) -> bytes:
    return bytes(cv2.imencode(".png", picture)[1].tobytes())


def _figure(columns: int, height: float, width: float | None = None) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width or min(4.6 * columns, 14.0), height), layout="constrained")


def _row(figure: Figure, count: int) -> list[Any]:
    return list(np.atleast_1d(np.asarray(figure.subplots(1, count))))


def _as_image(axes: Any, width: int, height: int) -> None:
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    axes.set_aspect("equal")


def _short(name: str) -> str:
    return name if len(name) <= 10 else f"..{name[-8:]}"


def _png(figure: Figure) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, dpi=_DPI, format="png")
    return stream.getvalue()
