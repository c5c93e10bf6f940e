"""``benchmark calibration``: simulated board views against the true rig, and a flight with it."""

from __future__ import annotations

import argparse

from thermal_stereo_vo.cli.progress import progress


def add_calibration_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what ``run_calibration`` reads."""
    parser.description = (
        "Calibrate simulated rigs from simulated boards, other poses and noise with every seed, "
        "and compare with the truth; with --flight also fly with what came out."
    )
    parser.add_argument("--boards", metavar="A,B", help="some of: board_aluminium, board_mask")
    parser.add_argument(
        "--views", type=int, default=22, metavar="N", help="views a calibration (22)"
    )
    parser.add_argument(
        "--seeds", type=int, default=5, metavar="N", help="calibrations a board (5)"
    )
    parser.add_argument("--flight", metavar="PRESET", help="simulated flight, such as seq1")
    parser.add_argument(
        "--length", type=float, default=100.0, metavar="M", help="length of the flight (100)"
    )
    parser.add_argument(
        "--rate", type=float, default=10.0, metavar="HZ", help="frame rate of the flight (10)"
    )
    parser.add_argument(
        "--flights", type=int, default=1, metavar="N", help="flights with other sensor noise (1)"
    )
    parser.add_argument(
        "--cache", metavar="DIR", help="folder that keeps the rendered pictures (none)"
    )
    parser.add_argument("--quiet", action="store_true", help="draw no progress bar")


def run_calibration(args: argparse.Namespace) -> int:
    """Measure and print; returns the exit code.

    Raises:
        ConfigError: for an unknown board, or less than one seed or flight.
        ThermalStereoError: for an unknown flight.
    """
    from thermal_stereo_vo.benchmarks.calibration import (
        BOARDS,
        calibrate_simulated,
        calibration_report,
        flight_report,
        measure_flights,
    )
    from thermal_stereo_vo.cli.benchmark_flight_arguments import picture_cache
    from thermal_stereo_vo.core.errors import ConfigError
    from thermal_stereo_vo.pipeline import Config

    boards = tuple(BOARDS) if args.boards is None else tuple(args.boards.split(","))
    if not set(boards) <= set(BOARDS) or min(args.seeds, args.flights) < 1:
        raise ConfigError(
            f"--boards takes some of {', '.join(BOARDS)}, --seeds and --flights at least 1, got "
            f"'{args.boards}', {args.seeds} and {args.flights}"
        )
    cells, calibrations = [], {}
    with picture_cache(args) as cache:
        with progress(len(boards) * args.seeds, "calibration", quiet=args.quiet) as step:
            for board in boards:
                for seed in range(args.seeds):
                    kept = f"render.cache={cache / f'{board}_{seed}'}"
                    cell, calibration = calibrate_simulated(board, seed, args.views, [kept])
                    cells.append(cell)
                    calibrations[f"{board} {seed}"] = calibration
                    step()
        print(calibration_report(cells), flush=True)
        if args.flight is None:
            return 0
        flights, total = range(args.flights), args.flights * (1 + len(calibrations))
        settings = (
            f"rate_hz={args.rate}",
            f"flight.length_m={args.length}",
            f"render.cache={cache / args.flight}",
        )
        with progress(total, "flight", quiet=args.quiet) as step:
            flown = measure_flights(calibrations, args.flight, settings, flights, Config(), step)
            told = flight_report(list(flown))
        print(told)
    return 0
