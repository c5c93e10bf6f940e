"""``calibrate stereo | mono | verify | loop | flat-field``: cameras, rigs and flat fields."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from thermal_stereo_vo.calibration.targets import Target

BOARD_HELP = (
    "chessboard:9x6:0.04 (inner corners, square in m), mask:6x4:0.04[:0.08] (square holes, side "
    "and pitch in m), circles:4x3:0.09 or acircles:4x11:0.02"
)
SOURCE_HELP = (
    "a rosbag, a folder with one subfolder a camera, sim:PRESET, or one folder (or quoted pattern "
    "such as 'left*.png') a camera; files pair by the digits in their names"
)
LENSES = ("auto", "none", "radtan2", "radtan4", "radtan5", "rational", "equidistant")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of all that can be calibrated."""
    kinds = parser.add_subparsers(dest="kind", metavar="WHAT", required=True)
    stereo = kinds.add_parser("stereo", help="two cameras on a rig, thermal or visible + thermal")
    _add_board(stereo)
    _add_estimation(stereo)
    stereo.add_argument(
        "--roles",
        nargs=2,
        default=("left", "right"),
        metavar=("FIRST", "SECOND"),
        help="the cameras (default: left right; for two bands: visible thermal)",
    )
    stereo.add_argument(
        "--topics", nargs=2, default=(), metavar="TOPIC", help="image topics of a bag"
    )
    stereo.add_argument(
        "--baseline",
        type=float,
        metavar="M",
        help="distance of the cameras measured otherwise: contradictions are refused",
    )
    stereo.add_argument(
        "--compare",
        metavar="FILE",
        type=Path,
        help="set another calibration beside this one and judge it by the same views",
    )
    mono = kinds.add_parser("mono", help="one camera")
    _add_board(mono)
    _add_estimation(mono)
    mono.add_argument("--role", default="camera", help="name of the camera (default: camera)")
    mono.add_argument("--topic", help="image topic of a bag")
    mono.add_argument("--compare", metavar="FILE", type=Path, help="another calibration")

    verify = kinds.add_parser("verify", help="judge an existing calibration by board images")
    verify.add_argument("calibration", type=Path, metavar="FILE", help="the calibration to judge")
    _add_board(verify)
    verify.add_argument("--roles", nargs=2, default=("left", "right"), metavar="ROLE")
    verify.add_argument("--topics", nargs=2, default=(), metavar="TOPIC")

    loop = kinds.add_parser("loop", help="check pairs that lead around a loop of cameras")
    loop.add_argument(
        "reports", nargs="+", type=Path, metavar="REPORT", help="folders that 'stereo' wrote"
    )
    field = kinds.add_parser("flat-field", help="flat field of one camera, from uniform sources")
    from thermal_stereo_vo.cli.calibrate_flat_field import add_flat_field_arguments

    add_flat_field_arguments(field)


def run(args: argparse.Namespace) -> int:
    """Calibrate; nothing is written when it fails."""
    if args.kind == "flat-field":
        from thermal_stereo_vo.cli.calibrate_flat_field import run_flat_field

        return run_flat_field(args)
    if args.kind == "loop":
        return _loop(args)
    if args.kind == "verify":
        return _verify(args)
    return _calibrate(args)


def _add_board(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("source", nargs="+", metavar="SOURCE", help=SOURCE_HELP)
    parser.add_argument("--board", required=True, metavar="KIND:NxM:SIZE", help=BOARD_HELP)
    parser.add_argument(
        "--max-images", type=int, default=120, metavar="N", help="images of each camera to look at"
    )
    parser.add_argument(
        "--tolerance-ms",
        type=float,
        default=10.0,
        metavar="MS",
        help="largest stamp difference of a pair from a recording (default 10)",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of a simulated source")
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")


def _add_estimation(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--output", required=True, type=Path, metavar="DIR", help="results folder")
    parser.add_argument(
        "--lens",
        choices=LENSES,
        default="auto",
        help="distortion model; auto: radtan4, without p1 and p2 where they are not significant",
    )
    parser.add_argument(
        "--lens-from",
        nargs="+",
        default=(),
        type=Path,
        metavar="DIR",
        help="lenses calibrated before, by role: they move within their own uncertainty only",
    )
    parser.add_argument(
        "--max-views",
        type=int,
        default=40,
        metavar="N",
        help="views that take part; the others test (default 40)",
    )


def _calibrate(args: argparse.Namespace) -> int:
    import sys

    from thermal_stereo_vo.calibration import session
    from thermal_stereo_vo.calibration.image_sources import Source
    from thermal_stereo_vo.cli.progress import progress

    if args.kind == "stereo":
        roles, topics, baseline_m = tuple(args.roles), tuple(args.topics), args.baseline
    else:
        roles, topics, baseline_m = (args.role,), (args.topic,) if args.topic else (), None
    request = session.Request(
        source=Source(tuple(args.source), topics, args.max_images, args.tolerance_ms, args.seed),
        target=_target(args.board),
        roles=roles,
        output=args.output,
        lens=args.lens,
        lens_from=tuple(args.lens_from),
        view_limit=args.max_views,
        baseline_m=baseline_m,
        compare=args.compare,
        command_line=("thermal_stereo_vo", *sys.argv[1:]),
    )
    say = (lambda _: None) if args.quiet else print
    images = session.open_images(request)
    with progress(len(images), "views", quiet=args.quiet, label="boards") as step:
        session.calibrate_and_report(request, images, step=step, say=say)
    return 0


def _verify(args: argparse.Namespace) -> int:
    from thermal_stereo_vo.calibration import session
    from thermal_stereo_vo.calibration.image_sources import Source
    from thermal_stereo_vo.cli.progress import progress

    roles = tuple(args.roles)
    source = Source(
        tuple(args.source), tuple(args.topics), args.max_images, args.tolerance_ms, args.seed
    )
    say = (lambda _: None) if args.quiet else print
    with progress(None, "views", quiet=args.quiet, label="boards") as step:
        session.verify_and_tell(
            args.calibration, source, _target(args.board), roles, step=step, say=say
        )
    return 0


def _loop(args: argparse.Namespace) -> int:
    import numpy as np

    from thermal_stereo_vo.calibration.loop import close_loop
    from thermal_stereo_vo.calibration.result import load_pair

    closure = close_loop([load_pair(path) for path in args.reports])
    print(" -> ".join(closure.cameras))
    for name, unit, factor, part in (
        ("translation", "mm", 1e3, slice(0, 3)),
        ("rotation", "deg", float(np.degrees(1.0)), slice(3, 6)),
    ):
        values = ", ".join(
            f"{factor * v:+.3f} +- {factor * s:.3f}"
            for v, s in zip(closure.twist[part], closure.sigma[part], strict=True)
        )
        print(f"{name} left over [{unit}]: {values}")
    verdict = "agrees within" if closure.agrees else "is BEYOND"
    print(f"chi2 {closure.chi2:.1f} with 6 degrees of freedom: the loop {verdict} its uncertainty")
    return 0


def _target(text: str) -> Target:
    from thermal_stereo_vo.calibration.targets import parse_target

    return parse_target(text)
