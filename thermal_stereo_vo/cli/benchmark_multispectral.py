"""``benchmark multispectral``: visible + thermal runs by both cameras and by each alone."""

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
    from thermal_stereo_vo.benchmarks.multispectral import BandJob, BandSweep
    from thermal_stereo_vo.evaluation.band_cell import BandCell


def add_multispectral_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what ``run_multispectral`` reads."""
    parser.description = (
        "Carry the simulated visible + thermal rig along the paths of Dai et al. (2019) with "
        "several sets of sensors, by both cameras together and by each alone; the same with a "
        "correction each 10 s (+nuc), 10 s of darkness (+dark) and neither (+calm); straight ahead "
        "and on the spot; and round a block at dusk.  Writes multispectral.md, .json and a picture "
        "of each run.  What is finished is not flown again."
    )
    add_output_argument(parser)
    parser.add_argument(
        "--source",
        metavar="SOURCE",
        help="a recording with true poses in place of the simulated runs; of a stereo recording "
        "the first eye is taken as the visible camera",
    )
    parser.add_argument(
        "--flights",
        nargs="+",
        metavar="NAME",
        help="presets, with a case after + if wanted, e.g. ms-02+nuc (default all)",
    )
    parser.add_argument(
        "--contenders",
        nargs="+",
        metavar="NAME",
        help="of both, visible, thermal (default) and feature, which carries the thermal stereo "
        "rig along the same path",
    )
    add_sampling_arguments(parser)
    parser.add_argument(
        "--duration", type=float, metavar="S", help="time of each run (default the preset's)"
    )
    parser.add_argument(
        "--length", type=float, metavar="M", help="length of the flight at dusk (default 320)"
    )
    add_work_arguments(parser, "preset")
    add_config_arguments(parser)
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")


def run_multispectral(args: argparse.Namespace) -> int:
    """Fly what is missing and write the report; returns the exit code."""
    from thermal_stereo_vo.benchmarks.multispectral import open_band_jobs
    from thermal_stereo_vo.benchmarks.sweep import claim_folder, run_here

    check_sweep_arguments(args)
    sweep = _sweep(args)
    cells = claim_folder(args.output, sweep.settings())
    pictures = args.pictures or args.output / PICTURES_FOLDER
    jobs = open_band_jobs(sweep, cells, pictures, forget=args.forget_pictures)
    say = say_nothing if args.quiet else _print_cell
    with progress(sum(job.frames() for job in jobs), "pair", quiet=args.quiet) as step:
        run_here(jobs, cells, args.processes, on_frame=step, on_cell=say)
    _write_report(args, sweep, cells, jobs)
    return 0


def _sweep(args: argparse.Namespace) -> BandSweep:
    from thermal_stereo_vo.benchmarks.multispectral import BOTH, FLIGHTS, BandSweep

    one_eye = ("visible",) if args.source is not None else (BOTH, "visible", "thermal")
    return BandSweep(
        tuple(args.flights or FLIGHTS),
        tuple(args.contenders or one_eye),
        tuple(range(args.seeds)),
        args.rate,
        args.length,
        args.duration,
        load_config(args),
        simulation_overrides(args),
        args.source,
    )


def _write_report(
    args: argparse.Namespace, sweep: BandSweep, cells: Path, jobs: list[BandJob]
) -> None:
    from thermal_stereo_vo.benchmarks.machine import machine, machine_line
    from thermal_stereo_vo.evaluation.band_cell import load_band_cells
    from thermal_stereo_vo.evaluation.band_table import BandTable, to_markdown
    from thermal_stereo_vo.evaluation.report import format_table
    from thermal_stereo_vo.outputs.band_figures import plot_bands
    from thermal_stereo_vo.outputs.replacing import write_text
    from thermal_stereo_vo.outputs.run_folder import to_json

    wanted = [
        cell
        for cell in load_band_cells(cells)
        if (sweep.source is not None or cell.flight in sweep.flights)
        and cell.contender in sweep.contenders
        and cell.seed in sweep.seeds
    ]
    table = BandTable(wanted)
    pictures = [f"{flight}.png" for flight in table.flights]
    for flight, picture in zip(table.flights, pictures, strict=True):
        plot_bands(args.output / picture, flight, wanted)
    about = [f"{len(wanted)} runs. Machine: {machine_line()}."]
    write_text(args.output / "multispectral.md", to_markdown(table, about, pictures))
    figures = {
        "settings": sweep.settings(),
        "machine": machine(),
        "header": table.header(),
        "rows": table.rows(),
        "findings": table.findings(),
    }
    write_text(args.output / "multispectral.json", to_json(figures))
    if not args.quiet:
        flown = sum(len(run.contenders) for job in jobs for run in job.runs)
        print(f"\n{flown} runs now, {len(wanted) - flown} before; ATE and steps in metres\n")
        print(format_table(table.header(), table.rows()))
        print("\n".join(["", *table.findings()]))
        print(f"\nmultispectral.md, .json and a picture of each run are in {args.output}")


def _print_cell(cell: BandCell) -> None:
    scale = (
        "scale never known"
        if cell.converged_after_s is None
        else f"scale known after {cell.converged_after_s:.1f} s"
    )
    ate = "-" if cell.sim3_ate_m is None else f"{cell.sim3_ate_m:.3f}"
    print(
        f"{cell.flight} by {cell.contender}, seed {cell.seed}: {scale}, Sim(3) ATE {ate} m, "
        f"coverage {cell.coverage_percent:.0f} %",
        flush=True,
    )
