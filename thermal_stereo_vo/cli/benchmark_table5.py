"""``benchmark table5``: the nine simulated flights by every method, as a report."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from thermal_stereo_vo.cli.benchmark_sweep_arguments import (
    PICTURES_FOLDER,
    add_output_argument,
    add_sampling_arguments,
    add_work_arguments,
    check_sweep_arguments,
    say_nothing,
)
from thermal_stereo_vo.cli.config_arguments import (
    add_config_arguments,
    load_config,
    simulation_overrides,
)
from thermal_stereo_vo.cli.progress import progress

if TYPE_CHECKING:
    from collections.abc import Callable

    from thermal_stereo_vo.benchmarks.sweep import FlightJob, Sweep
    from thermal_stereo_vo.evaluation.flight_cell import Cell


def add_table5_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what ``run_table5`` reads."""
    parser.description = (
        "Fly the simulated flights with several sets of sensors, by Gauss-Newton, "
        "Levenberg-Marquardt and Double Dogleg frame to frame, by the windowed and by the direct "
        "method; write table5.md, .csv, .json and a picture of each flight.  What is finished is "
        "not flown again."
    )
    add_output_argument(parser)
    parser.add_argument(
        "--flights",
        nargs="+",
        metavar="NAME",
        help="presets to fly (default seq1 to seq9)",
    )
    parser.add_argument(
        "--methods",
        nargs="+",
        metavar="NAME",
        help="of GN, LM, DDL, windowed, direct (default all)",
    )
    add_sampling_arguments(parser)
    parser.add_argument(
        "--length", type=float, metavar="M", help="length of each flight (default the preset's)"
    )
    add_work_arguments(parser, "flight", "; on a cluster, where it must be shared, none")
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="fly on the Dask cluster of this scheduler, e.g. tcp://host:8786",
    )
    add_config_arguments(parser)
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")


def run_table5(args: argparse.Namespace) -> int:
    """Fly what is missing and write the report; returns the exit code."""
    from thermal_stereo_vo.benchmarks.sweep import (
        claim_folder,
        open_jobs,
        run_here,
        run_on_cluster,
    )

    check_sweep_arguments(args)
    sweep = _sweep(args)
    pictures = args.pictures
    if pictures is None and args.scheduler is None:
        pictures = args.output / PICTURES_FOLDER
    cells = claim_folder(args.output, sweep.settings())
    jobs = open_jobs(sweep, cells, pictures, forget=args.forget_pictures)
    say = say_nothing if args.quiet else _print_cell
    if args.scheduler is not None:
        with progress(sum(job.cells for job in jobs), "cell", quiet=args.quiet) as step:
            run_on_cluster(jobs, cells, args.scheduler, on_cell=_both(say, step))
    else:
        with progress(sum(job.frames() for job in jobs), "pair", quiet=args.quiet) as step:
            run_here(jobs, cells, args.processes, on_frame=step, on_cell=say)
    _write_report(args, sweep, cells, jobs)
    return 0


def _sweep(args: argparse.Namespace) -> Sweep:
    from thermal_stereo_vo.benchmarks.sweep import FLIGHTS, Sweep
    from thermal_stereo_vo.evaluation.flight_cell import METHODS

    return Sweep(
        tuple(args.flights or FLIGHTS),
        tuple(args.methods or METHODS),
        tuple(range(args.seeds)),
        args.rate,
        args.length,
        load_config(args),
        simulation_overrides(args),
    )


def _write_report(
    args: argparse.Namespace, sweep: Sweep, cells: Path, jobs: list[FlightJob]
) -> None:
    from thermal_stereo_vo.benchmarks.machine import machine, machine_line
    from thermal_stereo_vo.evaluation.flight_cell import load_cells
    from thermal_stereo_vo.evaluation.report import format_table
    from thermal_stereo_vo.evaluation.table5 import Table5, to_csv, to_markdown
    from thermal_stereo_vo.outputs.flight_figures import plot_flight
    from thermal_stereo_vo.outputs.replacing import write_text
    from thermal_stereo_vo.outputs.run_folder import to_json

    wanted = [
        cell
        for cell in load_cells(cells)
        if cell.flight in sweep.flights
        and cell.method in sweep.methods
        and cell.seed in sweep.seeds
    ]
    table = Table5(wanted)
    pictures = []
    for flight in table.flights:
        plot_flight(args.output / f"{flight}.png", flight, wanted)
        pictures.append(f"{flight}.png")
    rate = "the presets' rate" if sweep.rate_hz is None else f"{sweep.rate_hz:g} Hz"
    length = "full length" if sweep.length_m is None else f"{sweep.length_m:g} m each"
    about = [f"Flights: {len(table.flights)}, {length}, {rate}. Machine: {machine_line()}."]
    write_text(args.output / "table5.md", to_markdown(table, about, pictures))
    write_text(args.output / "table5.csv", to_csv(table))
    figures = {"settings": sweep.settings(), "machine": machine(), **table.as_dict()}
    write_text(args.output / "table5.json", to_json(figures))
    if not args.quiet:
        flown = sum(job.cells for job in jobs)
        print(f"\n{flown} cells flown now, {len(wanted) - flown} before; errors in %\n")
        print(format_table(table.header(), table.rows()))
        print()
        print(format_table(table.consistency_header(), table.consistency_rows()))
        print("\n".join(["", *table.findings()]))
        print(f"\ntable5.md, .csv, .json and a picture of each flight are in {args.output}")


def _print_cell(cell: Cell) -> None:
    average = "-" if cell.average_percent is None else f"{cell.average_percent:.2f}"
    final = "-" if cell.final_percent is None else f"{cell.final_percent:.2f}"
    print(
        f"{cell.flight} by {cell.method}, seed {cell.seed}: average {average} %, final {final} %, "
        f"coverage {cell.coverage_percent:.0f} %",
        flush=True,
    )


def _both(say: Callable[[Cell], None], step: Callable[[], None]) -> Callable[[Cell], None]:
    def on_cell(cell: Cell) -> None:
        say(cell)
        step()

    return on_cell
