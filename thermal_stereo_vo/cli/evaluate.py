"""``evaluate EST GT``: a trajectory against the truth, as a table, JSON and a picture."""

from __future__ import annotations

import argparse
from pathlib import Path

SOURCE_HELP = "TUM, KITTI or EuRoC file, ROS bag with odometry or poses, "


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``evaluate``."""
    parser.add_argument("estimate", metavar="EST", help=f"{SOURCE_HELP}or the folder of a run")
    parser.add_argument("truth", metavar="GT", help=f"{SOURCE_HELP}or a recording with its truth")
    parser.add_argument(
        "--align",
        choices=("origin", "yaw", "se3", "sim3"),
        default="origin",
        help="how the estimate is laid over the truth for the travelled and final error and the "
        "picture: first poses made equal (default), or fitted with 4, 6 or 7 degrees of freedom; "
        "sim3 scales the estimate in all figures",
    )
    parser.add_argument("--estimate-topic", metavar="TOPIC", help="pose topic when EST is a bag")
    parser.add_argument("--ground-truth-topic", metavar="TOPIC", help="pose topic when GT is a bag")
    parser.add_argument(
        "--tolerance",
        type=float,
        default=10.0,
        metavar="MS",
        help="largest difference of stamps that belong together (default 10)",
    )
    parser.add_argument(
        "--rate",
        type=float,
        default=10.0,
        metavar="HZ",
        help="frame rate of two KITTI files, which have no stamps (default 10)",
    )
    parser.add_argument(
        "--output", type=Path, metavar="DIR", help="folder for metrics.json and trajectory.png"
    )
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")


def run(args: argparse.Namespace) -> int:
    """Evaluate and report; returns the exit code.

    Raises ThermalStereoError for input that cannot be used.
    """
    from thermal_stereo_vo.core.errors import ConfigError
    from thermal_stereo_vo.datasets.trajectories import load_pair
    from thermal_stereo_vo.evaluation.alignment import Alignment
    from thermal_stereo_vo.evaluation.metrics import evaluate
    from thermal_stereo_vo.evaluation.report import metrics_report

    for name in ("tolerance", "rate"):
        value = getattr(args, name)
        if not 0.0 < value < float("inf"):
            raise ConfigError(f"--{name} must be a positive number, not {value}")
    estimate, truth = load_pair(
        args.estimate,
        args.truth,
        estimate_topic=args.estimate_topic,
        truth_topic=args.ground_truth_topic,
        rate_hz=args.rate,
    )
    tolerance_ns = round(args.tolerance * 1e6)
    metrics = evaluate(
        estimate.trajectory,
        truth.trajectory,
        frame_stamps_ns=estimate.frame_stamps_ns,
        tolerance_ns=tolerance_ns,
        alignment=Alignment(args.align),
    )
    if not args.quiet:
        print(f"estimate: {args.estimate} ({estimate.reason})")
        print(f"ground truth: {args.truth} ({truth.reason})\n")
        print(metrics_report(metrics))
    if args.output is not None:
        from thermal_stereo_vo.outputs.plots import plot_run
        from thermal_stereo_vo.outputs.replacing import write_text
        from thermal_stereo_vo.outputs.run_folder import to_json

        try:
            args.output.mkdir(parents=True, exist_ok=True)
            write_text(args.output / "metrics.json", to_json(metrics.as_dict()))
            plot_run(
                args.output / "trajectory.png",
                estimate.trajectory,
                truth.trajectory,
                metrics,
                title=f"{Path(args.estimate).name} against {Path(args.truth).name}",
                tolerance_ns=tolerance_ns,
            )
        except OSError as error:
            raise ConfigError(f"{args.output} cannot be written: {error.strerror}") from None
        if not args.quiet:
            print(f"\nmetrics.json and trajectory.png are in {args.output}")
    return 0
