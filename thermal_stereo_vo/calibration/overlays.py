"""What the detector saw, drawn on the image: one picture a view."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.calibration.normalisation import local_normalisation, stretch
from thermal_stereo_vo.calibration.targets import Target
from thermal_stereo_vo.calibration.views import Detection

_FIRST, _X, _Y = (60, 60, 255), (60, 60, 255), (80, 220, 80)


def overlay(image: NDArray[Any], detection: Detection, target: Target) -> NDArray[np.uint8]:
    """(H, W, 3) BGR picture: corners coloured by row, axes of the board; or the reason for none."""
    view8 = stretch(image) if image.dtype == np.uint8 else local_normalisation(image, 24.0)
    picture = cv2.cvtColor(view8, cv2.COLOR_GRAY2BGR)
    view = detection.view
    if view is None:
        _write(picture, detection.reason)
        return np.asarray(picture)
    columns, rows = target.grid
    size = max(2, round(image.shape[1] / 320))
    colours = [_hue(row / max(rows - 1, 1)) for row in range(rows)]
    previous = None
    for point, (x, y) in zip(view.ids, view.pixels, strict=True):
        here = (round(float(x)), round(float(y)))
        colour = colours[int(point) // columns]
        if previous is not None:
            cv2.line(picture, previous, here, colour, 1, cv2.LINE_AA)
        previous = here
        cv2.circle(picture, here, size + 1, colour, 1, cv2.LINE_AA)
    where = dict(zip(view.ids.tolist(), view.pixels, strict=True))
    if 0 in where:
        start = where[0]
        for end, colour in ((columns - 1, _X), ((rows - 1) * columns, _Y)):
            if end in where:
                tip = start + 0.35 * (where[end] - start)
                cv2.arrowedLine(picture, _at(start), _at(tip), colour, 2, cv2.LINE_AA)
        cv2.circle(picture, _at(start), 3 * size, _FIRST, 2, cv2.LINE_AA)
    told = f"{len(view)} of {target.count} points, {detection.method}"
    _write(picture, told)
    return np.asarray(picture)


def _at(pixel: NDArray[np.float64]) -> tuple[int, int]:
    return round(float(pixel[0])), round(float(pixel[1]))


def _hue(fraction: float) -> tuple[int, int, int]:
    hsv = np.array([[[round(150 * fraction), 220, 255]]], dtype=np.uint8)
    b, g, r = cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)[0, 0]
    return int(b), int(g), int(r)


def _write(picture: NDArray[np.uint8], text: str) -> None:
    """Text in lines at the bottom, on a dark band."""
    width = picture.shape[1]
    per_line = max(20, width // 9)
    words, lines = text.split(), [""]
    for word in words:
        if len(lines[-1]) + len(word) + 1 > per_line:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    top = picture.shape[0] - 18 * len(lines) - 6
    picture[max(top, 0) :] //= 3
    for k, line in enumerate(lines):
        at = (6, top + 18 * (k + 1) - 2)
        cv2.putText(
            picture, line, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA
        )
