"""Which topics of a bag are the eyes, their calibration and the truth."""

from __future__ import annotations

from collections.abc import Sequence

from thermal_stereo_vo.core.cameras import LEFT, RIGHT, THERMAL, VISIBLE
from thermal_stereo_vo.core.errors import DatasetError

_DEFAULTS = ((LEFT, RIGHT), (VISIBLE, THERMAL))
_EYE_WORDS = (
    (LEFT, RIGHT),
    ("cam0", "cam1"),
    ("cam_0", "cam_1"),
    ("camera0", "camera1"),
    ("camera_0", "camera_1"),
    ("infra1", "infra2"),
)
_COMPRESSED = "/compressed"
_TRUTH_WORDS = ("ground_truth", "groundtruth")


def choose_image_topics(
    topics: Sequence[str],
    left: str | None = None,
    right: str | None = None,
    visible: str | None = None,
    thermal: str | None = None,
) -> tuple[dict[str, str], str]:
    """Role -> topic among the image ``topics``, and why.

    Named topics win; then ``/left/image_raw`` with ``/right/image_raw``, or ``/visible/image_raw``
    with ``/thermal/image_raw``; then the pair of names that differ only in an eye word, raw before
    rectified before compressed.

    >>> choose_image_topics(["/cam1/image_raw", "/cam0/image_raw"])[0]
    {'left': '/cam0/image_raw', 'right': '/cam1/image_raw'}

    Raises DatasetError that lists the image topics there are.
    """
    if visible is not None or thermal is not None:
        if left is not None or right is not None:
            raise DatasetError(
                "a rig has either left and right or visible and thermal cameras: name the topics "
                "of one such pair"
            )
        return _two_bands(topics, visible, thermal)
    if left is not None or right is not None:
        return _named(topics, left, right)
    for first, second in _DEFAULTS:
        pair = {first: f"/{first}/image_raw", second: f"/{second}/image_raw"}
        if set(pair.values()) <= set(topics):
            return pair, f"{pair[first]} and {pair[second]} are the default topics"
    candidates = sorted(_pairs(topics), key=lambda pair: (_rank(pair[0]), pair))
    if not candidates:
        _refuse_one_band(topics)
        raise DatasetError(
            f"the bag has no pair of image topics that looks like left and right {_list(topics)}: "
            "name them with --left-topic and --right-topic"
        )
    first, second = candidates[0]
    others = f", chosen among {len(candidates)} pairs" if len(candidates) > 1 else ""
    return {LEFT: first, RIGHT: second}, f"{first} and {second} look like left and right{others}"


def camera_info_topic(image_topic: str) -> str:
    """The ``camera_info`` beside an image topic.

    >>> camera_info_topic("/left/image_raw/compressed")
    '/left/camera_info'
    """
    return f"{_plain(image_topic).rpartition('/')[0]}/camera_info"


def is_rectified_name(image_topic: str) -> bool:
    """Whether the name says that the images are rectified, as ``image_proc`` names them."""
    return "rect" in _plain(image_topic).rpartition("/")[2]


def choose_truth_topic(topics: Sequence[str], wanted: str | None = None) -> str | None:
    """The topic of true poses among ``topics``: the wanted one, or one named ground truth.

    Raises DatasetError when the wanted one is not there.
    """
    if wanted is not None:
        found = _find(topics, wanted)
        if found is None:
            raise DatasetError(
                f"the bag has no pose topic '{wanted}' (pose topics there: "
                f"{', '.join(sorted(topics)) or 'none'}): correct the name"
            )
        return found
    named = [topic for topic in sorted(topics) if any(word in topic for word in _TRUTH_WORDS)]
    return named[0] if named else None


def choose_imu_topic(topics: Sequence[str], wanted: str | None = None) -> str | None:
    """The inertial topic among ``topics``: the wanted one, else the one with the shortest name.

    >>> choose_imu_topic(["/mavros/imu/data_raw", "/mavros/imu/data"])
    '/mavros/imu/data'

    Raises DatasetError when the wanted one is not there.
    """
    if wanted is None:
        return min(topics, key=lambda topic: (len(topic), topic), default=None)
    found = _find(topics, wanted)
    if found is None:
        raise DatasetError(
            f"the bag has no inertial topic '{wanted}' (inertial topics there: "
            f"{', '.join(sorted(topics)) or 'none'}): correct --imu-topic"
        )
    return found


def _named(
    topics: Sequence[str], left: str | None, right: str | None
) -> tuple[dict[str, str], str]:
    found: dict[str, str] = {}
    for role, wanted in ((LEFT, left), (RIGHT, right)):
        if wanted is None:
            continue
        topic = _find(topics, wanted)
        if topic is None:
            raise DatasetError(
                f"the bag has no image topic '{wanted}' {_list(topics)}: correct --{role}-topic"
            )
        found[role] = topic
    for role, other in ((LEFT, RIGHT), (RIGHT, LEFT)):
        if role not in found:
            given = found[other]
            partners = [
                pair[0] if role == LEFT else pair[1] for pair in _pairs(topics) if given in pair
            ]
            if not partners:
                raise DatasetError(
                    f"no image topic matches '{given}' as its {role} eye {_list(topics)}: name it "
                    f"with --{role}-topic"
                )
            found[role] = partners[0]
    if found[LEFT] == found[RIGHT]:
        raise DatasetError(f"both eyes are '{found[LEFT]}': name two different topics")
    reason = f"{found[LEFT]} and {found[RIGHT]} were asked for"
    return {LEFT: found[LEFT], RIGHT: found[RIGHT]}, reason


def _two_bands(
    topics: Sequence[str], visible: str | None, thermal: str | None
) -> tuple[dict[str, str], str]:
    found: dict[str, str] = {}
    for role, wanted in ((VISIBLE, visible), (THERMAL, thermal)):
        name = f"/{role}/image_raw" if wanted is None else wanted
        topic = _find(topics, name)
        if topic is None:
            raise DatasetError(
                f"the bag has no image topic '{name}' {_list(topics)}: correct --{role}-topic"
            )
        found[role] = topic
    if found[VISIBLE] == found[THERMAL]:
        raise DatasetError(f"both cameras are '{found[VISIBLE]}': name two different topics")
    return found, f"{found[VISIBLE]} and {found[THERMAL]} were asked for"


def _refuse_one_band(topics: Sequence[str]) -> None:
    for role, other in ((VISIBLE, THERMAL), (THERMAL, VISIBLE)):
        if f"/{role}/image_raw" in topics:
            raise DatasetError(
                f"the bag has /{role}/image_raw but no /{other}/image_raw {_list(topics)}: name "
                f"the images of the {other} camera with --{other}-topic"
            )


def _pairs(topics: Sequence[str]) -> list[tuple[str, str]]:
    present = set(topics)
    return [
        (topic, topic.replace(first, second))
        for topic in topics
        for first, second in _EYE_WORDS
        if first in topic and topic.replace(first, second) in present
    ]


def _rank(topic: str) -> tuple[bool, int]:
    name = _plain(topic).rpartition("/")[2]
    order = 0 if name == "image_raw" else 2 if "rect" in name else 1
    return topic.endswith(_COMPRESSED), order


def _plain(topic: str) -> str:
    return topic.removesuffix(_COMPRESSED)


def _find(topics: Sequence[str], wanted: str) -> str | None:
    name = f"/{wanted.lstrip('/')}"
    return next((t for t in topics if f"/{t.lstrip('/')}" == name), None)


def _list(topics: Sequence[str]) -> str:
    return f"(image topics there: {', '.join(sorted(topics)) or 'none'})"
