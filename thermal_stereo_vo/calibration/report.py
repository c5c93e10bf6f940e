"""A calibration as one HTML page that holds its pictures, and as JSON."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence

from thermal_stereo_vo.calibration.comparison import Column, tables
from thermal_stereo_vo.calibration.result import CalibrationResult, ViewRecord

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2em auto; max-width: 72em; padding: 0 1em; }
table { border-collapse: collapse; margin: 0.6em 0 1.4em; }
th, td { border-bottom: 1px solid #ddd; padding: 0.25em 0.8em; text-align: right; }
th:first-child, td:first-child, td.text { text-align: left; }
.warning { background: #fff3cd; padding: 0.4em 0.8em; margin: 0.3em 0; }
img { max-width: 100%; }
.refused td, .split td { color: #8a3b00; }
"""


def html_report(
    title: str,
    result: CalibrationResult,
    columns: Sequence[Column],
    pictures: Mapping[str, tuple[str, bytes]],
    *,
    board_note: str = "",
    command: str = "",
) -> str:
    """The page.  ``pictures`` maps a heading to a sentence and PNG bytes."""
    parts = [
        "<!DOCTYPE html><html lang='en'><head><meta charset='utf-8'>",
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head><body>",
        f"<h1>{html.escape(title)}</h1>",
        f"<p>Board {html.escape(result.board)}. {html.escape(board_note)}</p>",
    ]
    parts += [f"<p class='warning'>{html.escape(text)}</p>" for text in result.warnings]
    if not result.warnings:
        parts.append("<p>Nothing to object to: enough views, well spread, lenses well known.</p>")
    parts.append(_figures(result))
    for heading, head, rows in tables(columns):
        parts.append(f"<h2>{html.escape(heading)}</h2>{_table(head, rows)}")
    for heading, (sentence, png) in pictures.items():
        data = base64.b64encode(png).decode("ascii")
        parts.append(
            f"<h2>{html.escape(heading)}</h2><p>{html.escape(sentence)}</p>"
            f"<img alt='{html.escape(heading)}' src='data:image/png;base64,{data}'>"
        )
    parts.append(f"<h2>Views</h2>{_views(result)}")
    if command:
        parts.append(f"<p><code>{html.escape(command)}</code></p>")
    parts.append("</body></html>\n")
    return "\n".join(parts)


def figure_lines(result: CalibrationResult) -> list[str]:
    """The figures in sentences, for a terminal and for the page."""
    lines = []
    for role, camera in result.cameras.items():
        text = (
            f"{role}: lens {camera.lens.value}, MRE {camera.training.mean_px:.3f} px, RMS "
            f"{camera.training.rms_px:.3f} px on {camera.training.points} points of "
            f"{camera.training.views} views"
        )
        if camera.held_out is not None:
            text += f"; held out: MRE {camera.held_out.mean_px:.3f} px"
        lines.append(text)
    pair = result.pair
    if pair is not None:
        lines.append(
            f"baseline {1e3 * pair.baseline_m:.3f} +- {1e3 * pair.baseline_sigma_m:.3f} mm, stereo "
            f"RMS {result.stereo_rms_px:.3f} px"
        )
        errors = pair.held_out or pair.training
        how = f"held out ({pair.held_out_how})" if pair.held_out is not None else "training views"
        lines.append(
            f"epipolar error 1-2 {errors.epipolar_12_px:.3f} px, 2-1 {errors.epipolar_21_px:.3f} "
            f"px; corner spacing {errors.spacing_error_percent:+.3f} %, board distance "
            f"{errors.distance_error_percent:+.3f} %, relative yaw "
            f"{1e3 * errors.yaw_error_rad:+.3f} mrad; {how}"
        )
    return lines


def _figures(result: CalibrationResult) -> str:
    items = "".join(f"<li>{html.escape(line)}</li>" for line in figure_lines(result))
    return f"<ul>{items}</ul>"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    top = "".join(f"<th>{html.escape(cell)}</th>" for cell in head)
    body = "".join(
        "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows
    )
    return f"<table><tr>{top}</tr>{body}</table>"


def _views(result: CalibrationResult) -> str:
    roles = list(result.cameras)
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in ["view", "state", *roles, "reason"])
    rows = "".join(_view_row(view, roles) for view in result.views)
    return f"<table><tr>{head}</tr>{rows}</table>"


def _view_row(view: ViewRecord, roles: Sequence[str]) -> str:
    cells = [f"<td>{html.escape(view.name)}</td>", f"<td>{view.state}</td>"]
    for role in roles:
        link = f"overlays/{html.escape(view.name)}_{html.escape(role)}.jpg"
        error = f"{view.rms_px[role]:.3f} px" if role in view.rms_px else "picture"
        cells.append(f"<td><a href='{link}'>{error}</a></td>")
    cells.append(f"<td class='text'>{html.escape(view.reason)}</td>")
    return f"<tr class='{view.state.split()[0]}'>{''.join(cells)}</tr>"
