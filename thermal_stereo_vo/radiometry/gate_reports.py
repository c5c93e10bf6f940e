"""Images and what the gate said of them, brought together where they came by different ways.

The gate holds images back without a trace in the stream of images; its reports tell of every one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

from thermal_stereo_vo.core.frames import Gap, GapReason, RadiometricFrame

MOST_WAITING = 4
"""Images or reports that may wait for each other before they are taken for lost."""


@dataclass(frozen=True)
class GateReport:
    """What the gate said of one image; ``blind`` is None for an image that it let through."""

    stamp_ns: int
    epoch: int
    gap: Gap | None
    blind: GapReason | None


class GatedFrames:
    """The frames of one camera as they left the gate, in order, from its images and its reports.

    A frame that the gate let through waits for both; one that it held back comes with the report
    alone.  An image whose report is lost goes on with the epoch before it; a report whose image is
    lost is forgotten, but for its gap, which the next image carries.

    Args:
        camera: role of the camera.
        tolerance_ns: largest difference of the stamps of an image and its report.
        most_waiting: images or reports that may wait.
    """

    def __init__(
        self, camera: str, tolerance_ns: int = 0, most_waiting: int = MOST_WAITING
    ) -> None:
        self._camera = camera
        self._tolerance_ns = tolerance_ns
        self._most_waiting = most_waiting
        self._images: deque[RadiometricFrame] = deque()
        self._reports: deque[GateReport] = deque()
        self._epoch = 0
        self._gap: Gap | None = None
        self._sequence = 0

    def seen(self, frame: RadiometricFrame) -> Iterator[RadiometricFrame]:
        """An image has come; yields what is complete now."""
        self._images.append(frame)
        return self._complete()

    def told(self, report: GateReport) -> Iterator[RadiometricFrame]:
        """A report has come; yields what is complete now."""
        self._reports.append(report)
        return self._complete()

    def _complete(self) -> Iterator[RadiometricFrame]:
        images, reports = self._images, self._reports
        while images or reports:
            if not reports:
                if len(images) <= self._most_waiting:
                    return
                yield self._frame(images.popleft(), None)
                continue
            report = reports[0]
            if images and images[0].stamp_ns < report.stamp_ns - self._tolerance_ns:
                yield self._frame(images.popleft(), None)
            elif report.blind is not None:
                reports.popleft()
                yield self._frame(RadiometricFrame(None, report.stamp_ns, self._camera), report)
            elif images and images[0].stamp_ns <= report.stamp_ns + self._tolerance_ns:
                reports.popleft()
                yield self._frame(images.popleft(), report)
            elif images or len(reports) > self._most_waiting:
                reports.popleft()
                self._remember(report)
            else:
                return

    def _frame(self, frame: RadiometricFrame, report: GateReport | None) -> RadiometricFrame:
        if report is not None:
            self._remember(report)
        gap = None
        if frame.image is not None:
            gap, self._gap = self._gap, None
        self._sequence += 1
        return replace(
            frame,
            sequence=self._sequence - 1,
            epoch=self._epoch,
            gap=gap,
            blind=None if report is None else report.blind,
        )

    def _remember(self, report: GateReport) -> None:
        self._epoch = report.epoch
        if report.gap is not None:
            self._gap = report.gap
