"""A real drive with holes in it: what is left of the accuracy when pairs show nothing new.

Pairs are replaced (a) by copies of the pair before, as a frozen stream shows them, and (b) by an
even grey with noise, as a closed shutter shows them; in both eyes or in one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from thermal_stereo_vo.benchmarks.recorded import Recorded
from thermal_stereo_vo.core.cameras import RigCalibration
from thermal_stereo_vo.core.errors import ConfigError
from thermal_stereo_vo.core.frames import Image, RawFrame
from thermal_stereo_vo.core.results import OdometryResult, TrackingStatus
from thermal_stereo_vo.core.trajectory import Trajectory, estimated_trajectory
from thermal_stereo_vo.evaluation.metrics import Metrics, evaluate
from thermal_stereo_vo.evaluation.report import format_table
from thermal_stereo_vo.observers import Observer
from thermal_stereo_vo.pipeline import Config
from thermal_stereo_vo.radiometry.gate import GateEvent
from thermal_stereo_vo.replay import replay

COPY, GREY = "copies", "grey"
GREY_LEVEL, GREY_NOISE = 128.0, 1.5
LONG_GAP_S = 5.0
PAIRS_AFTER = 12
LETTERS = {status: status.value[0] for status in TrackingStatus}
NO_ANSWER = "-"
BLIND = (LETTERS[TrackingStatus.GAP], LETTERS[TrackingStatus.LOST], NO_ANSWER)


@dataclass(frozen=True)
class Hole:
    """Pairs ``first`` to ``last`` (both gone) of these ``eyes``, filled with ``kind``."""

    kind: str
    eyes: tuple[str, ...]
    first: int
    last: int


@dataclass(frozen=True)
class HoleRun:
    """What came of a drive with a hole; ``hole`` is None for a drive without one.

    ``letters`` holds the initial of each pair's status, ``-`` where a pair got no answer because it
    passed for a repetition.  ``metrics`` are of the whole drive; ``after`` of what came after the
    hole alone, laid over the truth at its first pose.  ``jump_m`` is how far the first pose after
    LOST lies from the last one before it; None where the rig was never lost.
    """

    hole: Hole | None
    letters: str
    events: tuple[GateEvent, ...]
    metrics: Metrics | None
    after: Metrics | None
    jump_m: float | None

    @property
    def statuses(self) -> str:
        """The letters with runs of equal ones shortened: ``I T18 G10 T22``."""
        letters, runs = self.letters, []
        while letters:
            rest = letters.lstrip(letters[0])
            count = len(letters) - len(rest)
            runs.append(letters[0] + (str(count) if count > 1 else ""))
            letters = rest
        return " ".join(runs)

    @property
    def blind_pairs(self) -> list[int]:
        """Pairs whose pose was predicted or unknown, or got no answer."""
        return [i for i, letter in enumerate(self.letters) if letter in BLIND]


class HoledDataset:
    """A recording in memory with a hole."""

    def __init__(self, recorded: Recorded, hole: Hole | None, seed: int = 0) -> None:
        self.name = recorded.name
        self.cameras = recorded.cameras
        self._recorded = recorded
        self._hole = hole
        self._seed = seed

    def calibration(self) -> RigCalibration:
        return self._recorded.calibration

    def ground_truth(self) -> Trajectory | None:
        return self._recorded.truth

    def instants(self) -> int:
        return self._recorded.pairs

    def frames(self) -> Iterator[RawFrame]:
        rng = np.random.default_rng(self._seed)
        count = dict.fromkeys(self.cameras, -1)
        before: dict[str, Image] = {}
        for raw in self._recorded.frames:
            count[raw.camera] += 1
            hole = self._hole
            gone = (
                hole is not None
                and raw.camera in hole.eyes
                and hole.first <= count[raw.camera] <= hole.last
            )
            if not gone:
                before[raw.camera] = raw.image
                yield raw
            elif hole is not None and hole.kind == COPY:
                yield replace(raw, image=before[raw.camera].copy())
            else:
                yield replace(raw, image=even_grey(before[raw.camera], rng))


def even_grey(like: Image, rng: np.random.Generator) -> Image:
    """A shutter: 128 with a noise of 1.5 levels; of linear counts the median of ``like``."""
    level = GREY_LEVEL if like.dtype == np.uint8 else float(np.median(like))
    noisy = level + GREY_NOISE * rng.standard_normal(like.shape)
    return np.clip(np.rint(noisy), 0, np.iinfo(like.dtype).max).astype(like.dtype)


def holes(recorded: Recorded, first: int, last: int) -> list[Hole]:
    """Both kinds in both eyes and in each, then 5 s in both eyes (less when the drive ends).

    Raises ConfigError for pairs that are not there, or too few around them.
    """
    if not 1 <= first <= last < recorded.pairs - 1:
        raise ConfigError(
            f"pairs {first} to {last} cannot be replaced in a drive of {recorded.pairs} pairs: "
            f"give 1 <= --first <= --last <= {recorded.pairs - 2}"
        )
    both = recorded.cameras
    choices = (both, *((camera,) for camera in both))
    found = [Hole(kind, eyes, first, last) for eyes in choices for kind in (COPY, GREY)]
    stamps = np.array(recorded.stamps_ns)
    end = int(np.searchsorted(stamps, stamps[first] + LONG_GAP_S * 1e9))
    end = min(end, recorded.pairs - 1 - PAIRS_AFTER)
    if end > last:
        found += [Hole(kind, both, first, end) for kind in (COPY, GREY)]
    return found


def run_hole(
    recorded: Recorded,
    config: Config,
    hole: Hole | None,
    *,
    on_progress: Callable[[], None] = lambda: None,
) -> HoleRun:
    """Replay the drive with this hole."""
    listener = _GateListener()
    dataset = HoledDataset(recorded, hole)
    results = replay(
        dataset, recorded.calibration, config, [listener], on_progress=on_progress
    ).results
    after = None
    if hole is not None and recorded.truth is not None:
        rest = estimated_trajectory(results[hole.last + 1 :])
        if len(rest) >= 2:
            after = evaluate(rest, recorded.truth)
    return HoleRun(
        hole,
        status_letters(recorded, results),
        tuple(listener.events),
        recorded.metrics(results),
        after,
        jump_after_loss_m(results),
    )


def status_letters(recorded: Recorded, results: Sequence[OdometryResult]) -> str:
    """The initial of each pair's status, ``-`` where there is no result."""
    stamps = np.array(recorded.stamps_ns)
    letters = [NO_ANSWER] * len(stamps)
    for result in results:
        letters[int(np.argmin(np.abs(stamps - result.stamp_ns)))] = LETTERS[result.status]
    return "".join(letters)


def jump_after_loss_m(results: Sequence[OdometryResult]) -> float | None:
    """Distance (m) between the poses around the longest time in LOST; None without one."""
    jumps = []
    last: OdometryResult | None = None
    lost = False
    for result in results:
        if result.T_world_rig is None:
            lost = last is not None
            continue
        if lost and last is not None and last.T_world_rig is not None:
            jump = np.linalg.norm(result.T_world_rig[:3, 3] - last.T_world_rig[:3, 3])
            jumps.append(float(jump))
        last, lost = result, False
    return max(jumps) if jumps else None


class _GateListener(Observer):
    def __init__(self) -> None:
        self.events: list[GateEvent] = []

    def on_gate_event(self, event: GateEvent) -> None:
        self.events.append(event)


def gap_report(recorded: Recorded, runs: Sequence[HoleRun]) -> str:
    """A row for each drive, then what the gates said."""
    header = ["replaced", "average (%)", "final (%)", "after (%)", "jump (m)", "blind", "statuses"]
    rows = [
        [
            _name(recorded, run.hole),
            _percent(run.metrics, "avg_translation_error_percent"),
            _percent(run.metrics, "final_error_percent"),
            _percent(run.after, "final_error_percent"),
            "-" if run.jump_m is None else f"{run.jump_m:.2f}",
            _blind(recorded, run),
            run.statuses,
        ]
        for run in runs
    ]
    lines = [
        format_table(header, rows),
        "",
        "after: final error of what came after the hole, laid over the truth at its first pose",
        f"jump: from the last pose before LOST to the first one after{_step(recorded)}",
        "blind: pairs that are GAP, LOST or without answer beyond those without a good eye, or "
        "fewer",
    ]
    for run in runs:
        if run.events:
            lines += ["", f"gate, {_name(recorded, run.hole)}:"]
            lines += [f"  {event}" for event in run.events]
    return "\n".join(lines)


def gap_record(recorded: Recorded, runs: Sequence[HoleRun]) -> list[dict[str, Any]]:
    """The same figures for a file."""
    return [
        {
            "replaced": _name(recorded, run.hole),
            "metrics": None if run.metrics is None else run.metrics.as_dict(),
            "final_after_percent": None if run.after is None else run.after.final_error_percent,
            "jump_m": run.jump_m,
            "statuses": run.statuses,
            "blind_pairs": run.blind_pairs,
            "events": [str(event) for event in run.events],
        }
        for run in runs
    ]


def _name(recorded: Recorded, hole: Hole | None) -> str:
    if hole is None:
        return "nothing"
    eyes = "both eyes" if len(hole.eyes) == len(recorded.cameras) else f"{hole.eyes[0]} eye"
    stamps = recorded.stamps_ns
    seconds = (stamps[hole.last + 1] - stamps[hole.first]) * 1e-9
    return f"{hole.first}-{hole.last}, {seconds:.1f} s, {eyes}, {hole.kind}"


def _blind(recorded: Recorded, run: HoleRun) -> str:
    expected: set[int] = set()
    if run.hole is not None and len(run.hole.eyes) == len(recorded.cameras):
        expected = set(range(run.hole.first, run.hole.last + 1))
    more, fewer = set(run.blind_pairs) - expected, expected - set(run.blind_pairs)
    parts = [f"+{len(more)}"] * bool(more) + [f"-{len(fewer)}"] * bool(fewer)
    return " ".join(parts) or "exactly"


def _step(recorded: Recorded) -> str:
    if recorded.truth is None:
        return ""
    steps_m = np.linalg.norm(np.diff(recorded.truth.positions_m, axis=0), axis=1)
    return f" (the rig moves {np.median(steps_m):.2f} m from pair to pair)"


def _percent(metrics: Metrics | None, name: str) -> str:
    value = None if metrics is None else getattr(metrics, name)
    return "-" if value is None else f"{value:.2f}"
