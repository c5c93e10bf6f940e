"""What a bag holds, in words."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import LEFT, RIGHT
from thermal_stereo_vo.core.errors import DatasetError, ThermalStereoError
from thermal_stereo_vo.datasets.bag_messages import COMPRESSED_IMAGE, RAW_IMAGE
from thermal_stereo_vo.datasets.options import SourceOptions
from thermal_stereo_vo.datasets.rosbag import (
    RosbagDataset,
    bag_files,
    open_bag_reader,
    read_messages,
)

GAP_PERIODS = 1.5
"""A step longer than this many median periods is a gap."""


@dataclass
class TopicSummary:
    """Stamps (header, else time of recording) and formats seen on a topic."""

    kind: str
    stamps_ns: list[int] = field(default_factory=list)
    formats: set[str] = field(default_factory=set)


@dataclass(frozen=True)
class Timing:
    """Regularity of a topic.  ``gaps`` counts steps above ``GAP_PERIODS`` median periods."""

    rate_hz: float
    gaps: int
    longest_step_ms: float
    backward: int


@dataclass(frozen=True)
class Skew:
    """Stamp differences right minus left of images taken together."""

    pairs: int
    unpaired: int
    median_ms: float
    largest_ms: float


def count_messages(path: Path) -> int:
    """Messages in a bag.  Raises DatasetError for a bag that is empty or cannot be read."""
    if not path.exists():
        raise DatasetError(f"there is no bag {path}: correct the path")
    with open_bag_reader(path) as reader:
        count = int(reader.message_count)
    if count == 0:
        raise DatasetError(f"the bag {path} holds no messages: record again")
    return count


def inspect_bag(
    path: Path, options: SourceOptions, on_message: Callable[[], object] = lambda: None
) -> str:
    """A report of several lines; ``on_message`` is called after each message that was read.

    Raises DatasetError for a bag that is empty or cannot be read.
    """
    count_messages(path)
    topics, first_ns, last_ns = _summarise(path, on_message)
    total = sum(len(topic.stamps_ns) for topic in topics.values())
    size_mb = sum(file.stat().st_size for file in _files(path)) / 1e6
    lines = [
        f"{path}: {total} messages, {(last_ns - first_ns) / 1e9:.3f} s, {size_mb:.1f} MB",
        "",
        f"{'topic':<32} {'count':>7} {'Hz':>8} {'gaps':>5} {'longest ms':>11}  type, format",
    ]
    for name, topic in sorted(topics.items()):
        timing = timing_of(topic.stamps_ns)
        formats = f", {', '.join(sorted(topic.formats))}" if topic.formats else ""
        lines.append(
            f"{name:<32} {len(topic.stamps_ns):>7} {timing.rate_hz:>8.2f} {timing.gaps:>5} "
            f"{timing.longest_step_ms:>11.1f}  {topic.kind.replace('/msg/', '/')}{formats}"
        )
        if timing.backward:
            lines.append(f"  {timing.backward} stamps of {name} do not come after the one before")
    lines += ["", *_replay_lines(path, options, topics)]
    return "\n".join(lines)


def timing_of(stamps_ns: Sequence[int]) -> Timing:
    """Median rate and gaps of the stamps of one topic.

    >>> timing_of([0, 100_000_000, 200_000_000, 500_000_000])
    Timing(rate_hz=10.0, gaps=1, longest_step_ms=300.0, backward=0)
    """
    steps = np.diff(np.array(stamps_ns, dtype=np.int64)).astype(np.float64)
    forward = steps[steps > 0]
    if not len(forward):
        return Timing(0.0, 0, 0.0, int(np.count_nonzero(steps <= 0)))
    period_ns = float(np.median(forward))
    return Timing(
        rate_hz=1e9 / period_ns,
        gaps=int(np.count_nonzero(forward > GAP_PERIODS * period_ns)),
        longest_step_ms=float(forward.max()) / 1e6,
        backward=int(np.count_nonzero(steps <= 0)),
    )


def skew_of(left_ns: Sequence[int], right_ns: Sequence[int]) -> Skew:
    """Every left image with the nearest right one, at most half a period away.

    >>> skew_of([0, 100_000_000, 200_000_000], [1_000_000, 101_000_000])
    Skew(pairs=2, unpaired=1, median_ms=1.0, largest_ms=1.0)
    """
    left = np.unique(np.array(left_ns, dtype=np.int64))
    right = np.unique(np.array(right_ns, dtype=np.int64))
    rate_hz = timing_of([int(stamp) for stamp in left]).rate_hz
    limit_ns = 0.5e9 / rate_hz if rate_hz else 0.0
    differences = _nearest(right, left) - left
    paired = differences[np.abs(differences) <= limit_ns]
    return Skew(
        pairs=len(paired),
        unpaired=len(left) + len(right) - 2 * len(paired),
        median_ms=float(np.median(paired)) / 1e6 if len(paired) else 0.0,
        largest_ms=float(np.abs(paired).max()) / 1e6 if len(paired) else 0.0,
    )


def _nearest(sorted_values: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.int64]:
    after = np.clip(np.searchsorted(sorted_values, wanted), 0, len(sorted_values) - 1)
    before = np.maximum(after - 1, 0)
    is_before = wanted - sorted_values[before] <= np.abs(sorted_values[after] - wanted)
    nearest: NDArray[np.int64] = np.where(is_before, sorted_values[before], sorted_values[after])
    return nearest


def _summarise(
    path: Path, on_message: Callable[[], object]
) -> tuple[dict[str, TopicSummary], int, int]:
    with open_bag_reader(path) as reader:
        topics = {c.topic: TopicSummary(c.msgtype) for c in reader.connections}
        for name, topic in topics.items():
            for kind, log_ns, message in read_messages(reader, [name], path):
                topic.stamps_ns.append(_stamp(message, log_ns))
                topic.formats |= _formats(message, kind)
                on_message()
        return topics, reader.start_time, reader.end_time


def _stamp(message: Any, log_ns: int) -> int:
    header = getattr(message, "header", None)
    if header is None:
        return log_ns
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec) or log_ns


def _formats(message: Any, kind: str) -> set[str]:
    if kind == RAW_IMAGE:
        return {f"{message.width}x{message.height} {message.encoding}"}
    if kind == COMPRESSED_IMAGE:
        return {str(message.format)}
    return set()


def _replay_lines(path: Path, options: SourceOptions, topics: dict[str, TopicSummary]) -> list[str]:
    try:
        dataset = RosbagDataset(path, options)
    except ThermalStereoError as error:
        return [f"replay would refuse it: {error}"]
    lines = [f"replay would take {dataset.reason}"]
    first, second = (topics[dataset.topics[role]].stamps_ns for role in dataset.cameras)
    skew = skew_of(first, second)
    lines.append(
        f"pairing: {skew.pairs} pairs, {skew.unpaired} images alone, skew "
        f"({' to '.join(dataset.cameras)}) median {skew.median_ms:.3f} ms, largest "
        f"{skew.largest_ms:.3f} ms"
    )
    calibration = dataset.calibration()
    if calibration is None:
        lines.append("calibration: none in the bag; give one with --calibration")
    elif {LEFT, RIGHT} <= set(calibration.cameras):
        state = "already rectified" if calibration.rectified else "to be rectified"
        lines.append(
            f"calibration: {calibration.origin}, baseline {calibration.baseline_m:.4f} m, {state}"
        )
    else:
        lines.append(f"calibration: {calibration.origin}, {', '.join(calibration.cameras)}")
    return lines


def _files(path: Path) -> list[Path]:
    return [
        file
        for entry in bag_files(path)
        for file in (entry.iterdir() if entry.is_dir() else [entry])
        if file.is_file()
    ]
