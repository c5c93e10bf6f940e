"""Board images from folders, file patterns, bags and simulated runs, shot by shot.

From a moving recording the stillest instant of each stretch is taken: the board is blurred, and
seen by two cameras at two places, while it moves.
"""

from __future__ import annotations

import glob
import heapq
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from thermal_stereo_vo.core.cameras import RigCalibration
from thermal_stereo_vo.core.errors import DatasetError
from thermal_stereo_vo.core.frames import Image, RawFrame
from thermal_stereo_vo.datasets.image_files import list_images, read_grey
from thermal_stereo_vo.stereo.pairing import PairingConfig, StereoPairer

_DECIMATION = 8


@dataclass(frozen=True)
class ImageShot:
    """One instant: ``load[role]()`` gives the (H, W) image of that camera."""

    name: str
    load: Mapping[str, Callable[[], Image]]


@dataclass(frozen=True)
class Source:
    """Where images come from.

    ``paths`` is one bag, folder, pattern or ``sim:PRESET``, or one folder or pattern a role.
    ``topics`` names an image topic a role.  ``limit`` shots at most are taken; ``tolerance_ms`` is
    the largest stamp difference of a pair from a recording.  ``seed`` and ``settings``
    (``key=value``) shape a simulated run.

    Raises DatasetError for a ``limit`` below one.
    """

    paths: tuple[str, ...]
    topics: tuple[str, ...] = ()
    limit: int = 120
    tolerance_ms: float = 10.0
    seed: int = 0
    settings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.limit < 1:
            raise DatasetError(f"--max-images must be at least 1, got {self.limit}")


def image_shots(source: Source, roles: Sequence[str]) -> list[ImageShot]:
    """The shots of a source, in order of time or name.

    Raises DatasetError that says what is missing and what was looked for.
    """
    if len(source.paths) == len(roles) and len(roles) > 1:
        return _thinned(_paired_files(dict(zip(roles, source.paths, strict=True))), source.limit)
    if len(source.paths) != 1:
        raise DatasetError(
            f"{len(source.paths)} sources given for {len(roles)} cameras: give one recording, or "
            "one folder of images a camera"
        )
    (text,) = source.paths
    path = Path(text)
    if _is_pattern(text) or (path.is_dir() and _holds_images(path)):
        if len(roles) > 1:
            raise DatasetError(
                f"{text} holds the images of one camera only: give the folder of the other too, or "
                f"one folder with {' and '.join(roles)} in it"
            )
        return _thinned(_paired_files({roles[0]: text}), source.limit)
    if path.is_dir() and all((path / role).is_dir() for role in roles):
        return _thinned(_paired_files({role: str(path / role) for role in roles}), source.limit)
    if path.is_dir() and any((path / role).is_dir() for role in roles) and len(roles) > 1:
        missing = ", ".join(role for role in roles if not (path / role).is_dir())
        raise DatasetError(f"{path} has images of one camera only: {path / missing} is missing")
    return _recorded(source, roles)


def simulated_truth(source: Source) -> RigCalibration | None:
    """The true calibration of a simulated source, None for a real one."""
    from thermal_stereo_vo.datasets.options import SourceOptions
    from thermal_stereo_vo.datasets.registry import SIMULATED, open_dataset

    if len(source.paths) != 1 or not source.paths[0].startswith(SIMULATED):
        return None
    options = SourceOptions(seed=source.seed, overrides=source.settings)
    return open_dataset(source.paths[0], options)[0].calibration()


def _is_pattern(text: str) -> bool:
    return any(letter in text for letter in "*?[") and not Path(text).exists()


def _holds_images(folder: Path) -> bool:
    try:
        return bool(list_images(folder))
    except DatasetError:
        return False


def _files(text: str) -> list[Path]:
    if _is_pattern(text):
        files = [Path(name) for name in sorted(glob.glob(text))]  # noqa: PTH207
        if not files:
            raise DatasetError(f"no file matches {text}")
        return files
    path = Path(text)
    if not path.is_dir():
        raise DatasetError(f"there is no folder {path}: give a folder of images or a pattern")
    return list_images(path)


def _paired_files(places: Mapping[str, str]) -> list[ImageShot]:
    """Shots of files whose names hold the same digits, such as left07.png and right07.png."""
    by_key: dict[str, dict[str, Path]] = {}
    for role, text in places.items():
        for path in _files(text):
            key = "_".join(re.findall(r"\d+", path.stem)) or path.stem
            if role in by_key.setdefault(key, {}):
                raise DatasetError(
                    f"{by_key[key][role].name} and {path.name} have the same digits '{key}': files "
                    "pair by the digits in their names, which must differ within a folder"
                )
            by_key[key][role] = path
    if len(places) > 1 and not any(len(found) > 1 for found in by_key.values()):
        told = " and ".join(f"{text}" for text in places.values())
        raise DatasetError(
            f"no image of {told} belongs to another: files pair by the digits in their names, as "
            "in left07.png and right07.png"
        )
    return [
        ImageShot(key, {role: partial(read_grey, path) for role, path in found.items()})
        for key, found in sorted(by_key.items(), key=lambda item: _natural(item[0]))
    ]


def _natural(key: str) -> list[tuple[int, str]]:
    return [(len(part), part) for part in key.split("_")]


def _thinned(shots: list[ImageShot], limit: int) -> list[ImageShot]:
    """Evenly spread ``limit`` of the shots."""
    if len(shots) <= limit:
        return shots
    return [shots[int(i)] for i in np.linspace(0, len(shots) - 1, limit)]


def _recorded(source: Source, roles: Sequence[str]) -> list[ImageShot]:
    frames, count = _open(source, roles)
    shots: list[ImageShot] = []
    for stretch in _stretches(_instants(frames, roles, source.tolerance_ms), count, source.limit):
        stillest = _stillest(stretch)
        shots.append(
            ImageShot(
                f"{len(shots):03d}",
                {role: partial(_kept, frame.image) for role, frame in stillest.items()},
            )
        )
    if not shots:
        raise DatasetError(f"{source.paths[0]} holds no images of {' and '.join(roles)}")
    return shots


def _kept(image: Image) -> Image:
    return image


def _open(source: Source, roles: Sequence[str]) -> tuple[Iterator[RawFrame], int]:
    """Frames named by role, and how many instants there are."""
    text = source.paths[0]
    path = Path(text)
    from thermal_stereo_vo.datasets.options import SourceOptions
    from thermal_stereo_vo.datasets.registry import BAG_SUFFIXES, SIMULATED, open_dataset

    is_bag = path.suffix in BAG_SUFFIXES or (path / "metadata.yaml").is_file()
    is_bag |= path.is_dir() and any(p.suffix in BAG_SUFFIXES for p in path.iterdir())
    if is_bag and not text.startswith(SIMULATED):
        return _open_bag(path, source.topics, roles)
    options = SourceOptions(seed=source.seed, overrides=source.settings)
    dataset, _ = open_dataset(text, options)
    if not set(roles) <= set(dataset.cameras):
        raise DatasetError(
            f"{text} has the cameras {', '.join(dataset.cameras)}, not {' and '.join(roles)}: name "
            "them with --roles"
        )
    return (f for f in dataset.frames() if f.camera in roles), dataset.instants() or 1


def _open_bag(
    path: Path, topics: Sequence[str], roles: Sequence[str]
) -> tuple[Iterator[RawFrame], int]:
    """Images of any size, as a visible and a thermal camera seldom share one."""
    from thermal_stereo_vo.datasets.bag_messages import IMAGE_TYPES, image_of, stamp_of
    from thermal_stereo_vo.datasets.bag_topics import choose_image_topics
    from thermal_stereo_vo.datasets.rosbag import open_bag_reader, read_messages

    with open_bag_reader(path) as reader:
        counts = {
            c.topic: c.msgcount
            for c in reader.connections
            if c.msgtype in IMAGE_TYPES and c.msgcount > 0
        }
    if not counts:
        raise DatasetError(f"the bag {path} holds no images")
    if topics:
        chosen = dict(zip(roles, topics, strict=False))
    elif len(roles) == 1:
        named = [t for t in counts if roles[0] in t] or list(counts)
        if len(named) > 1:
            raise DatasetError(
                f"the bag {path} has several image topics ({', '.join(sorted(counts))}): choose "
                "one with --topics"
            )
        chosen = {roles[0]: named[0]}
    else:
        try:
            found, _ = choose_image_topics(list(counts))
        except DatasetError:
            raise DatasetError(
                f"the bag {path} has no two image topics that look like a pair (image topics "
                f"there: {', '.join(sorted(counts))}): name them with --topics"
            ) from None
        chosen = dict(zip(roles, found.values(), strict=True))
    for role, topic in chosen.items():
        if topic not in counts:
            raise DatasetError(
                f"the bag {path} has no image topic '{topic}' for {role} (image topics there: "
                f"{', '.join(sorted(counts))}): correct --topics"
            )
    if len(chosen) < len(roles):
        raise DatasetError(f"--topics names {len(chosen)} topics for {len(roles)} cameras")

    def stream(topic: str, role: str) -> Iterator[RawFrame]:
        last_ns = -1
        with open_bag_reader(path) as reader:
            for kind, log_ns, message in read_messages(reader, [topic], path):
                stamp_ns = stamp_of(message, log_ns)
                if stamp_ns > last_ns:
                    last_ns = stamp_ns
                    yield RawFrame(image_of(message, kind, topic), stamp_ns, role)

    streams = [stream(topic, role) for role, topic in chosen.items()]
    merged = heapq.merge(*streams, key=lambda frame: frame.stamp_ns)
    return merged, max(counts[topic] for topic in chosen.values())


def _instants(
    frames: Iterator[RawFrame], roles: Sequence[str], tolerance_ms: float
) -> Iterator[dict[str, RawFrame]]:
    """Role -> frame of one instant; one camera alone where the other has none."""
    if len(roles) == 1:
        for frame in frames:
            yield {roles[0]: frame}
        return
    pairer: StereoPairer[RawFrame] = StereoPairer(PairingConfig(tolerance_ms=tolerance_ms))
    for frame in frames:
        for pair in pairer.push(list(roles).index(frame.camera), frame):
            yield _named(roles, pair.first, pair.second)
    for pair in pairer.flush():
        yield _named(roles, pair.first, pair.second)


def _named(
    roles: Sequence[str], first: RawFrame | None, second: RawFrame | None
) -> dict[str, RawFrame]:
    both = zip(roles, (first, second), strict=True)
    return {role: frame for role, frame in both if frame is not None}


@dataclass(frozen=True)
class _Instant:
    """Frames of one instant and how much they differ from the ones before."""

    frames: dict[str, RawFrame]
    motion: float


def _stretches(
    instants: Iterator[dict[str, RawFrame]], count: int, parts: int
) -> Iterator[list[_Instant]]:
    """``count`` instants in ``parts`` even stretches; frames that repeat the one before drop out.

    A camera repeats its last image during a flat-field correction: it looks still and is not.
    """
    before: dict[str, Image] = {}
    stretch: list[_Instant] = []
    for taken, frames in enumerate(instants, 1):
        motion = 0.0
        frozen = False
        for role, frame in frames.items():
            small = frame.image[::_DECIMATION, ::_DECIMATION].astype(np.float32)
            if role in before and before[role].shape == small.shape:
                change = float(np.mean(np.abs(small - before[role])))
                spread = float(small.std())
                frozen |= change == 0.0 and spread > 0.0 and count > parts
                motion = max(motion, change / max(spread, 1e-6))
            before[role] = small
        if not frozen:
            stretch.append(_Instant(frames, motion))
        if taken * parts // count > (taken - 1) * parts // count and stretch:
            yield stretch
            stretch = []
    if stretch:
        yield stretch


def _stillest(stretch: list[_Instant]) -> dict[str, RawFrame]:
    """The instant with most cameras, and among those the least motion."""
    return min(stretch, key=lambda i: (-len(i.frames), i.motion)).frames
