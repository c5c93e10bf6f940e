"""Look for the board in every image, keep what was found and why not, draw what was seen."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2

from thermal_stereo_vo.calibration.detection import detect
from thermal_stereo_vo.calibration.image_sources import ImageShot
from thermal_stereo_vo.calibration.overlays import overlay
from thermal_stereo_vo.calibration.result import ViewRecord
from thermal_stereo_vo.calibration.targets import Target
from thermal_stereo_vo.calibration.views import BoardShot, Detection, camera_called
from thermal_stereo_vo.core.errors import CalibrationError

Size = tuple[int, int]


@dataclass(frozen=True)
class Gathered:
    """Board views of a source.

    ``refused`` are shots that no camera could use; ``detections`` holds what the detector said of
    every image: (shot name, role) -> detection.
    """

    shots: tuple[BoardShot, ...]
    refused: tuple[ViewRecord, ...]
    sizes: dict[str, Size]
    detections: dict[tuple[str, str], Detection]

    def found(self, role: str) -> int:
        """How many images of a camera show the board."""
        return sum(d.found for (_, r), d in self.detections.items() if r == role)

    def seen(self, role: str) -> int:
        """How many images of a camera there were."""
        return sum(r == role for _, r in self.detections)


def gather(
    images: Sequence[ImageShot],
    target: Target,
    roles: Sequence[str],
    *,
    overlays: Path | None = None,
    step: Callable[[], None] = lambda: None,
) -> Gathered:
    """Detect the board in all images, two at a time; write an overlay of each into ``overlays``.

    Calls ``step`` after each shot.  Raises CalibrationError when images of one camera differ in
    size, or no image of a camera shows the board.
    """
    if overlays is not None:
        overlays.mkdir(parents=True, exist_ok=True)

    def look(shot: ImageShot) -> tuple[ImageShot, dict[str, Detection], dict[str, Size]]:
        found, sizes = {}, {}
        for role, load in shot.load.items():
            image = load()
            sizes[role] = (image.shape[1], image.shape[0])
            found[role] = detect(image, target)
            if overlays is not None:
                picture = overlay(image, found[role], target)
                path = overlays / f"{shot.name}_{role}.jpg"
                cv2.imwrite(str(path), picture, [cv2.IMWRITE_JPEG_QUALITY, 85])
        return shot, found, sizes

    shots, refused = [], []
    sizes: dict[str, Size] = {}
    detections: dict[tuple[str, str], Detection] = {}
    with ThreadPoolExecutor(min(2, os.cpu_count() or 1)) as pool:
        for shot, found, seen_sizes in pool.map(look, images):
            for role, size in seen_sizes.items():
                if sizes.setdefault(role, size) != size:
                    raise CalibrationError(
                        f"image {shot.name} of {camera_called(role)} is {size[0]}x{size[1]} px, "
                        f"the ones before {sizes[role][0]}x{sizes[role][1]}: all images of a "
                        "camera must have one size"
                    )
            for role, detection in found.items():
                detections[shot.name, role] = detection
            views = {role: d.view for role, d in found.items() if d.view is not None}
            if views:
                shots.append(BoardShot(shot.name, views))
            else:
                reason = "; ".join(f"{role}: {d.reason}" for role, d in found.items())
                refused.append(ViewRecord(shot.name, "refused", reason))
            step()
    gathered = Gathered(tuple(shots), tuple(refused), sizes, detections)
    boards = [d for d in detections.values() if d.found]
    if boards and sum(d.beyond for d in boards) > 0.5 * len(boards):
        raise CalibrationError(
            f"the board goes on beyond the {target.columns}x{target.rows} inner corners of --board "
            f"in {sum(d.beyond for d in boards)} of {len(boards)} views: count the inner corners "
            "(squares less one) along both sides again"
        )
    for role in roles:
        _check_found(gathered, role, target)
    return gathered


def _check_found(gathered: Gathered, role: str, target: Target) -> None:
    if gathered.seen(role) == 0:
        raise CalibrationError(f"there are no images of {camera_called(role)}")
    if gathered.found(role):
        return
    reasons = [d.reason for (_, r), d in gathered.detections.items() if r == role]
    commonest = max(set(reasons), key=reasons.count)
    raise CalibrationError(
        f"0 of {len(reasons)} images of {camera_called(role)} show the board {target}; most "
        f"often: {commonest}"
    )
