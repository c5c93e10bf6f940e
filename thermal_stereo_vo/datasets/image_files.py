"""Recordings that are image files on disk, whatever names their folders have."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.cameras import LEFT, RIGHT, RigCalibration
from thermal_stereo_vo.core.errors import DatasetError
from thermal_stereo_vo.core.frames import Image, RawFrame
from thermal_stereo_vo.core.trajectory import Trajectory

IMAGE_SUFFIXES = (".png", ".pgm", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp")


@dataclass(frozen=True)
class ImageFile:
    """One image of one camera."""

    stamp_ns: int
    path: Path
    sequence: int


class ImageFileDataset:
    """Cameras whose images are files with known stamps; decoded one at a time.

    ``cameras`` maps role to files; the order of roles is the order at equal stamps.

    Raises DatasetError when a camera has no images, stamps do not increase strictly, or left and
    right differ in image size.
    """

    def __init__(
        self,
        name: str,
        files: Mapping[str, Sequence[ImageFile]],
        calibration: RigCalibration | None = None,
        ground_truth: Trajectory | None = None,
    ) -> None:
        self.name = name
        self.cameras = tuple(files)
        self._files = {role: tuple(images) for role, images in files.items()}
        self._calibration = calibration
        self._ground_truth = ground_truth
        check_order(self._files)
        self._sizes = check_sizes(self._files)

    def calibration(self) -> RigCalibration | None:
        """The calibration that was found, or None."""
        return self._calibration

    def ground_truth(self) -> Trajectory | None:
        """True poses of the rig, or None."""
        return self._ground_truth

    def instants(self) -> int | None:
        """Number of images of the first camera."""
        return len(self._files[self.cameras[0]])

    def frames(self) -> Iterator[RawFrame]:
        """All frames in order of stamp, the first camera before the second at equal stamps."""
        streams = [[(image, role) for image in self._files[role]] for role in self.cameras]
        for image, role in heapq.merge(*streams, key=lambda entry: entry[0].stamp_ns):
            pixels = read_grey(image.path)
            size = (pixels.shape[1], pixels.shape[0])
            if size != self._sizes[role]:
                before = "x".join(str(side) for side in self._sizes[role])
                raise DatasetError(
                    f"{image.path} is {size[0]}x{size[1]} pixels, but the recording began with "
                    f"{before}: all images of a camera must have one size"
                )
            yield RawFrame(pixels, image.stamp_ns, role, image.sequence)


def list_images(folder: Path) -> list[Path]:
    """Image files of ``folder`` by name.  Raises DatasetError when there are none."""
    images = sorted(
        path
        for path in folder.iterdir()
        if path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")
    )
    if not images:
        raise DatasetError(
            f"{folder} holds no images: looked for files ending in {', '.join(IMAGE_SUFFIXES)}"
        )
    return images


def read_lines(path: Path) -> list[str]:
    """Lines of a text file beside the images.  Raises DatasetError when it is none."""
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"cannot read {path}: {error}") from None


def read_grey(path: Path) -> Image:
    """(H, W) uint8 or uint16 as stored; 8-bit colour becomes grey.

    Raises DatasetError for a file that is unreadable, 16-bit colour or of another type.
    """
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise DatasetError(f"cannot read the image {path}: {error.strerror or error}") from None
    return decode_grey(data, str(path))


def decode_grey(data: NDArray[np.uint8], origin: str) -> Image:
    """As ``read_grey``, from the (N,) bytes of an encoded image; ``origin`` is for messages."""
    image = None
    if len(data) and not _is_cut_short(data):  # OpenCV would grumble on stderr
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    if image is None:
        raise DatasetError(
            f"{origin} is no readable image ({len(data)} bytes): it is damaged or cut short; "
            "copy it again or remove it"
        )
    return to_grey(image, origin)


def to_grey(image: Image, origin: str, *, rgb: bool = False) -> Image:
    """One channel of an (H, W) or (H, W, C) image; colour order is BGR unless ``rgb``."""
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[:, :, 0]
    if image.dtype not in (np.uint8, np.uint16):
        raise DatasetError(
            f"{origin} holds {image.dtype} pixels: convert it to 8- or 16-bit grey images"
        )
    if image.ndim == 3:
        if image.dtype != np.uint8:
            raise DatasetError(
                f"{origin} has {image.shape[2]} channels of 16 bit: give single-channel images "
                "(the linear counts), as a colour picture of 16 bit has no defined grey value"
            )
        codes = {
            (3, False): cv2.COLOR_BGR2GRAY,
            (4, False): cv2.COLOR_BGRA2GRAY,
            (3, True): cv2.COLOR_RGB2GRAY,
            (4, True): cv2.COLOR_RGBA2GRAY,
        }
        image = cv2.cvtColor(image, codes[image.shape[2], rgb])
    return np.ascontiguousarray(image)


def check_sizes(files: Mapping[str, Sequence[ImageFile]]) -> dict[str, tuple[int, int]]:
    """The (width, height) of the first image of every camera; left and right must agree."""
    sizes = {}
    for role, images in files.items():
        height, width = read_grey(images[0].path).shape
        sizes[role] = (width, height)
    if set(sizes) == {LEFT, RIGHT} and sizes[LEFT] != sizes[RIGHT]:
        told = " and ".join(f"{role} is {w}x{h}" for role, (w, h) in sizes.items())
        raise DatasetError(f"the images differ in size: {told} pixels; both eyes must be alike")
    return sizes


def _is_cut_short(data: NDArray[np.uint8]) -> bool:
    """A PNG without its last chunk."""
    return data[:4].tobytes() == b"\x89PNG" and b"IEND" not in data[-16:].tobytes()


def check_order(files: Mapping[str, Sequence[ImageFile]]) -> None:
    """Raise DatasetError unless the stamps of every camera increase strictly."""
    for role, images in files.items():
        for before, after in pairwise(images):
            if after.stamp_ns <= before.stamp_ns:
                raise DatasetError(
                    f"stamps of camera '{role}' do not increase: {after.path.name} at "
                    f"{after.stamp_ns} ns comes after {before.path.name} at {before.stamp_ns} ns; "
                    "sort or correct the stamps"
                )
