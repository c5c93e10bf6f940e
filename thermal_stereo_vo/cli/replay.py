"""``replay SOURCE --output DIR``: the odometry over a recording, with all its figures."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from thermal_stereo_vo.cli.config_arguments import (
    add_config_arguments,
    load_config,
    simulation_overrides,
)
from thermal_stereo_vo.cli.progress import progress
from thermal_stereo_vo.cli.source_arguments import add_source_arguments, source_options


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``replay``."""
    add_source_arguments(parser)
    add_config_arguments(parser)
    parser.add_argument(
        "--ground-truth", metavar="F", help="true trajectory, when the source has none"
    )
    parser.add_argument(
        "--output", type=Path, required=True, metavar="DIR", help="folder for the results"
    )
    parser.add_argument("--no-plot", action="store_true", help="write no picture")
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")


def run(args: argparse.Namespace) -> int:
    """Replay, write DIR, print the table."""
    from thermal_stereo_vo.core.cameras import default_T_base_rig
    from thermal_stereo_vo.core.trajectory import Trajectory
    from thermal_stereo_vo.datasets.registry import open_dataset, require_calibration
    from thermal_stereo_vo.datasets.trajectories import find_ground_truth
    from thermal_stereo_vo.evaluation.alignment import Alignment
    from thermal_stereo_vo.evaluation.metrics import evaluate
    from thermal_stereo_vo.evaluation.report import metrics_report, timing_report, trajectory_report
    from thermal_stereo_vo.evaluation.scale import scale_report
    from thermal_stereo_vo.odometry.factory import describe
    from thermal_stereo_vo.outputs.bag_writer import ResultBag
    from thermal_stereo_vo.outputs.gate_events import GateEvents
    from thermal_stereo_vo.outputs.map_file import MapFile
    from thermal_stereo_vo.outputs.run_folder import RunFolder, run_record
    from thermal_stereo_vo.outputs.snapshot import Snapshot
    from thermal_stereo_vo.outputs.trajectory_file import TrajectoryFiles
    from thermal_stereo_vo.pipeline import rig_rectifier
    from thermal_stereo_vo.replay import replay

    config = load_config(args)
    dataset, reason = open_dataset(args.source, source_options(args, simulation_overrides(args)))
    calibration = require_calibration(dataset)
    rectifier = rig_rectifier(config, calibration)
    T_base_rig = rectifier.rectified_calibration.T_base_rig
    given = None
    if args.ground_truth is not None:
        given = find_ground_truth(args.ground_truth, topic=args.ground_truth_topic)
    say = _silent if args.quiet else print
    say(f"{args.source}: {reason}")

    with RunFolder(args.output) as folder:
        files = TrajectoryFiles(folder.path)
        bag = ResultBag(
            folder.path / "result.mcap", default_T_base_rig() if T_base_rig is None else T_base_rig
        )
        snapshot = Snapshot((dataset.instants() or 20) // 2)
        events = GateEvents()
        points = MapFile(folder.path / "map.ply")
        with progress(dataset.instants(), "pair", quiet=args.quiet) as step:
            replayed = replay(
                dataset,
                calibration,
                config,
                [files, bag, points, snapshot, events],
                on_progress=step,
            )
        folder.write_json("timing.json", replayed.timing.as_dict())
        truth = dataset.ground_truth()
        if given is not None:
            truth = given.for_frames(files.frame_stamps_ns).trajectory
        if truth is not None:
            # Results speak of the rectified rig; so must be what they are compared with.
            truth = Trajectory(truth.stamps_ns, truth.T_world_rig @ rectifier.T_rig_rectified)
        scale = scale_report(replayed.results, truth)
        if truth is not None:
            unknown = scale is not None and scale.converged_after_s is None
            metrics = evaluate(
                files.trajectory,
                truth,
                frame_stamps_ns=files.frame_stamps_ns,
                alignment=Alignment.SIM3 if unknown else Alignment.ORIGIN,
            )
            folder.write_json(
                "metrics.json", metrics.as_dict() | ({} if scale is None else scale.as_dict())
            )
            say(metrics_report(metrics))
        else:
            metrics = None
            say("no ground truth to compare with")
            say(trajectory_report(files.trajectory, len(files.frame_stamps_ns)))
        if scale is not None:
            say(str(scale))
        if not args.no_plot:
            from thermal_stereo_vo.outputs.plots import plot_run

            plot_run(
                folder.path / "trajectory.png",
                files.trajectory,
                truth,
                metrics,
                title=f"{dataset.name}: {describe(config.odometry)}",
                left_image=snapshot.first_image,
                matches_image=snapshot.second_image,
            )
        for role, picture in snapshot.depth_maps.items():
            folder.write_png(f"depth_{role}.png", picture)
        for sentence in events.sentences:
            say(f"gate: {sentence}")
        say(timing_report(replayed.timing))
        folder.write_json(
            "run.json",
            run_record(
                settings=config,
                calibration=calibration,
                source=args.source,
                source_reason=reason,
                command_line=sys.argv,
                T_rig_rectified=rectifier.T_rig_rectified,
                gate_events=events.sentences,
                statuses={status.value: count for status, count in files.status_counts.items()},
            ),
        )
    say(f"results are in {args.output}")
    return 0


def _silent(_: str) -> None:
    """Say nothing."""
