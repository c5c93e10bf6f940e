"""``simulate PRESET --output BAG``: fly a simulated rig and write what its sensors say."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from thermal_stereo_vo.cli.config_arguments import SIMULATION_PREFIX
from thermal_stereo_vo.cli.progress import progress

if TYPE_CHECKING:
    from thermal_stereo_vo.simulation.simulation import Simulation


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``simulate``."""
    parser.add_argument("preset", nargs="?", metavar="PRESET", help="a name that --list shows")
    parser.add_argument("--list", action="store_true", help="show all presets")
    parser.add_argument("--settings", action="store_true", help="show the settings of PRESET")
    parser.add_argument("--output", type=Path, metavar="BAG", help="folder of the new bag")
    parser.add_argument("--rate", type=float, metavar="HZ", help="frames a second")
    parser.add_argument("--length", type=float, metavar="M", help="length of the flight")
    parser.add_argument("--seed", type=int, default=0, help="seed of the sensors (default 0)")
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change one setting, e.g. world.weather=sunny_day; may be repeated",
    )
    parser.add_argument(
        "--cache", metavar="DIR", help="same as --set render.cache=DIR: keep noise-free pictures"
    )
    parser.add_argument("--workers", type=int, metavar="N", help="same as --set render.workers=N")
    parser.add_argument(
        "--preview", type=Path, metavar="F", help="write a sheet of six frames (PNG) and no bag"
    )
    parser.add_argument(
        "--gallery", type=Path, metavar="DIR", help="write sheets with two frames of every preset"
    )
    parser.add_argument(
        "--compare-real",
        type=Path,
        metavar="DIR",
        help="compare simulated with recorded frames in DIR and write the report to --output",
    )
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")


def run(args: argparse.Namespace) -> int:
    """Simulate; nothing is left behind after an error or an interruption."""
    from thermal_stereo_vo.core.errors import SimulationError

    if args.list:
        return _list()
    if args.compare_real is not None:
        return _compare(args)
    if args.gallery is not None:
        return _gallery(args)
    if args.preset is None:
        raise SimulationError("name a preset; --list shows them all")
    simulation = _simulation(args)
    if args.settings:
        from thermal_stereo_vo.core.config import dump_yaml

        print(dump_yaml(simulation.config), end="")
        return 0
    if args.preview is not None:
        from thermal_stereo_vo.simulation.preview import write_preview

        write_preview(args.preset, simulation.config, args.preview, seed=args.seed)
        _say(args, f"{args.preview} shows {args.preset}")
        return 0
    if args.output is None:
        raise SimulationError("say where the bag shall go: --output BAG")
    return _write_bag(args, simulation)


def _simulation(args: argparse.Namespace) -> Simulation:
    from thermal_stereo_vo.core.config import with_overrides
    from thermal_stereo_vo.simulation.presets import find_preset
    from thermal_stereo_vo.simulation.simulation import Simulation

    overrides = _overrides(args)
    if args.cache is not None:
        overrides.append(f"render.cache={args.cache}")
    if args.workers is not None:
        overrides.append(f"render.workers={args.workers}")
    if args.rate is not None:
        overrides.append(f"rate_hz={args.rate}")
    if args.length is not None:
        overrides.append(f"flight.length_m={args.length}")
    config = with_overrides(find_preset(args.preset).config, overrides)
    return Simulation(args.preset, config, args.seed)


def _overrides(args: argparse.Namespace) -> list[str]:
    return [text.removeprefix(SIMULATION_PREFIX) for text in args.overrides]


def _write_bag(args: argparse.Namespace, simulation: Simulation) -> int:
    from thermal_stereo_vo.datasets.simulated import SimulatedDataset
    from thermal_stereo_vo.outputs.dataset_bag import write_dataset
    from thermal_stereo_vo.simulation.navigation_bag import NavigationFeed

    dataset = SimulatedDataset(simulation)
    total = simulation.instants * len(dataset.cameras)
    with progress(total, "image", quiet=args.quiet) as step:
        count = write_dataset(dataset, args.output, step, [NavigationFeed(simulation)])
    length_m = simulation.ground_truth().path_lengths_m[-1]
    _say(
        args,
        f"{count} images of {', '.join(dataset.cameras)} over {length_m:.1f} m and "
        f"{simulation.duration_s:.1f} s written to {args.output}",
    )
    return 0


def _compare(args: argparse.Namespace) -> int:
    from thermal_stereo_vo.core.errors import SimulationError
    from thermal_stereo_vo.simulation.realism import write_realism_report

    if args.output is None:
        raise SimulationError("say where the report shall go: --output DIR")
    text = write_realism_report(args.compare_real, args.output, _overrides(args))
    _say(args, text)
    return 0


def _gallery(args: argparse.Namespace) -> int:
    from thermal_stereo_vo.simulation.preview import GALLERY, write_gallery

    count = sum(len(presets) for presets in GALLERY.values())
    with progress(count, "preset", quiet=args.quiet) as step:
        write_gallery(args.gallery, step)
    _say(args, f"{', '.join(GALLERY)} written to {args.gallery}")
    return 0


def _list() -> int:
    from thermal_stereo_vo.simulation.presets import all_presets

    presets = all_presets()
    width = max(len(preset.name) for preset in presets)
    for preset in presets:
        print(f"{preset.name:{width}}  {preset.summary}")
    return 0


def _say(args: argparse.Namespace, text: str) -> None:
    if not args.quiet:
        print(text)
