"""``benchmark gaps``: what is left of the accuracy when pairs show nothing new."""

from __future__ import annotations

import argparse

from thermal_stereo_vo.cli.benchmark_arguments import (
    add_recording_arguments,
    read_recording,
    report,
    title,
)
from thermal_stereo_vo.cli.progress import progress


def add_gaps_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what ``run_gaps`` reads."""
    parser.description = (
        "Replay a recording with pairs replaced by copies of the pair before them, as a frozen "
        "stream shows them, and by an even grey with noise, as a shutter shows them: both eyes, "
        "either eye, and both eyes for 5 s."
    )
    add_recording_arguments(parser, None)
    parser.add_argument("--first", type=int, metavar="N", help="first pair to replace (default 20)")
    parser.add_argument("--last", type=int, metavar="N", help="last pair to replace (default 29)")
    parser.set_defaults(first=20, last=29)


def run_gaps(args: argparse.Namespace) -> int:
    """Measure and print; returns the exit code."""
    from thermal_stereo_vo.benchmarks.gaps import gap_record, gap_report, holes, run_hole

    config, recorded = read_recording(args, None)
    wanted = [None, *holes(recorded, args.first, args.last)]
    with progress(recorded.pairs * len(wanted), "pair", quiet=args.quiet) as step:
        runs = [run_hole(recorded, config, hole, on_progress=step) for hole in wanted]
    text = f"{title(recorded)}\n\n{gap_report(recorded, runs)}"
    return report(args, text, gap_record(recorded, runs))
