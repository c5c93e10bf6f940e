"""Records views of a uniform source for ``calibrate flat-field``."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermal_stereo_vo.core.errors import CalibrationError
from thermal_stereo_vo.core.frames import RawFrame

FRAMES_PER_VIEW = 32


class FlatFieldRecorder:
    """Averages the frames it is given and writes the mean with the FPA temperature.

    Args:
        folder: where to write; made when absent.
        camera: role of the camera.
        serial: serial number of the camera, if known.
        frames: how many frames make one view.
    """

    def __init__(
        self, folder: str | Path, camera: str, serial: str = "", frames: int = FRAMES_PER_VIEW
    ) -> None:
        self._folder = Path(folder)
        self._camera = camera
        self._serial = serial
        self._frames = frames
        self._sum: NDArray[np.float64] | None = None
        self._kelvin: list[float] = []

    @property
    def missing(self) -> int:
        """How many frames the view still needs."""
        return self._frames - len(self._kelvin)

    def add(self, raw: RawFrame) -> Path | None:
        """Take one more frame; returns the file once the view is complete.

        Raises:
            CalibrationError: when the camera tells no FPA temperature, the image size changes or
                the file cannot be written.
        """
        kelvin = None if raw.telemetry is None else raw.telemetry.fpa_temperature_kelvin
        if kelvin is None or not np.isfinite(kelvin):
            raise CalibrationError(
                f"camera '{self._camera}' tells no FPA temperature: a flat field needs it; connect "
                "the camera's serial line"
            )
        if self._sum is None:
            self._sum = np.zeros(raw.image.shape)
        if self._sum.shape != raw.image.shape:
            raise CalibrationError(
                f"camera '{self._camera}' changed its image size while a flat field was recorded: "
                "begin again"
            )
        self._sum += raw.image
        self._kelvin.append(kelvin)
        return self._write(raw.stamp_ns) if self.missing == 0 else None

    def _write(self, stamp_ns: int) -> Path:
        assert self._sum is not None
        kelvin = float(np.mean(self._kelvin))
        path = self._folder / f"flat_{self._camera}_{kelvin:.2f}K_{stamp_ns}.npz"
        temporary = path.with_name(f".{path.name}.partial")
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            with temporary.open("wb") as file:
                np.savez(
                    file,
                    frames=(self._sum / len(self._kelvin)).astype(np.float32)[None],
                    fpa_kelvin=np.array([kelvin]),
                    serial=self._serial,
                    camera=self._camera,
                )
            temporary.replace(path)
        except OSError as error:
            with suppress(OSError):
                temporary.unlink()
            raise CalibrationError(
                f"cannot write the flat field {path}: {error.strerror}"
            ) from None
        self._sum, self._kelvin = None, []
        return path
