"""From radiance to 14-bit counts: an uncooled core with all its habits.

The pattern of a microbolometer array is that of the 3-D noise model (D'Agostino & Webb 1991):
pixel, row and column parts, each fixed or changing from frame to frame.  A flat-field correction
leaves a small residue; from then on the pattern grows with the temperature of the array, in the
proportions measured on flat fields of a real core from -32 to +66 degC (column as pixel, row half
of that, smooth shading nine times as much), and with the square root of time.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from thermal_stereo_vo.core.frames import FfcState, Telemetry
from thermal_stereo_vo.simulation.settings import FfcConfig, ThermalCameraConfig
from thermal_stereo_vo.simulation.thermal_drift import FpaTemperature
from thermal_stereo_vo.simulation.thermal_field import Responsivity

Map = NDArray[np.float32]

HIGHEST_COUNT = 16383
SIGNAL_STEP = 0.125
"""Counts of one step of the stored noise-free signal."""

_SLOW_KNOT_S = 1.0
_PATTERN, _EPOCH, _FRAME, _SLOW, _DEAD = 40, 41, 42, 43, 44


@dataclass(frozen=True)
class Reading:
    """One frame as the core puts it out: (H, W) uint16 counts and what it says of itself."""

    counts: NDArray[np.uint16]
    telemetry: Telemetry
    correcting: bool


class ThermalCamera:
    """One microbolometer camera.  Times must not go back.

    ``seed`` is any tuple of integers; every random number follows from it, from the index of the
    frame and from the number of corrections, never from what was asked before.
    ``corrections_s`` are the start times of its flat-field corrections.
    """

    def __init__(
        self,
        config: ThermalCameraConfig,
        ffc: FfcConfig,
        shape: tuple[int, int],
        fpa: FpaTemperature,
        corrections_s: tuple[float, ...],
        seed: tuple[int, ...],
    ) -> None:
        self._config, self._ffc, self._shape, self._fpa = config, ffc, shape, fpa
        self._corrections_s = corrections_s
        self._seed = seed
        self._sigma = config.netd_mk * 1e-3 * config.counts_per_kelvin
        responsivity = Responsivity(config.counts_per_kelvin)
        self._shutter_counts = float(responsivity.counts(fpa.kelvin(0.0)))
        rng = self._rng(_PATTERN)
        height, width = shape
        self._gain = (config.gain_percent * 1e-2 * rng.standard_normal(shape)).astype(np.float32)
        milli = 1e-3 * config.counts_per_kelvin
        self._drift = (
            milli
            * (
                config.drift_pixel_mk * rng.standard_normal(shape)
                + config.drift_column_mk * rng.standard_normal((1, width))
                + config.drift_row_mk * rng.standard_normal((height, 1))
                + config.drift_shading_mk * smooth_field(shape, rng)
            )
        ).astype(np.float32)
        self._creep = (config.creep_pixel * self._sigma * rng.standard_normal(shape)).astype(
            np.float32
        )
        self._dome = (config.dome_kelvin * config.counts_per_kelvin * _dome(shape)).astype(
            np.float32
        )
        self._dead = _DeadPixels(config, shape, self._rng(_DEAD))
        self._epoch = -1
        self._fixed: Map = np.zeros(shape, np.float32)
        self._slow: tuple[int, Map, Map] | None = None
        self._last: NDArray[np.uint16] | None = None
        self._since = 0

    def is_correcting(self, time_s: float) -> bool:
        """Whether the shutter is closed: the picture then needs no rendering."""
        return any(start <= time_s < start + self._ffc.duration_s for start in self._corrections_s)

    def expose(
        self, signal: NDArray[np.uint16] | None, time_s: float, index: int
    ) -> Reading | None:
        """The frame at a time.

        ``signal`` (H, W) uint16 is the noise-free radiance in steps of ``SIGNAL_STEP`` counts; it
        may be None during a correction, which repeats the last frame bit by bit.  Returns None
        when there is no frame to repeat yet.
        """
        correcting = self.is_correcting(time_s)
        if correcting:
            if self._last is None:
                return None
            telemetry = self._telemetry(time_s, FfcState.IN_PROGRESS, None)
            return Reading(self._last, telemetry, True)
        assert signal is not None
        ended = [s for s in self._corrections_s if s + self._ffc.duration_s <= time_s]
        if len(ended) != self._epoch:
            self._epoch = len(ended)
            self._since = 0
            self._fixed = self._residue(len(ended))
        since_s = time_s - (ended[-1] + self._ffc.duration_s if ended else -5.0)
        counts = self._convert(signal, time_s, since_s, index)
        counts.flags.writeable = False
        self._last = counts
        self._since += 1
        state = FfcState.COMPLETE if ended else FfcState.NONE
        return Reading(counts, self._telemetry(time_s, state, since_s), False)

    def _rng(self, *key: int) -> np.random.Generator:
        return np.random.Generator(np.random.SFC64([*self._seed, *key]))

    def _residue(self, epoch: int) -> Map:
        """What a correction leaves: a fresh pattern and another mean."""
        config = self._config
        rng = self._rng(_EPOCH, epoch)
        height, width = self._shape
        pattern = self._sigma * (
            config.fixed_pixel * rng.standard_normal(self._shape)
            + config.fixed_column * rng.standard_normal((1, width))
            + config.fixed_row * rng.standard_normal((height, 1))
        )
        jump = self._ffc.jump_counts * rng.standard_normal() if epoch > 0 else 0.0
        return (pattern + jump + self._dome + config.offset_counts).astype(np.float32)

    def _slow_noise(self, time_s: float) -> tuple[Map, Map, float]:
        """Two noise pictures a second apart, and where between them the time lies."""
        knot = int(np.floor(time_s / _SLOW_KNOT_S))
        if self._slow is None or self._slow[0] != knot:
            sigma = self._config.slow_noise * self._sigma
            before, after = (
                self._rng(_SLOW, k + 1000).standard_normal(self._shape, np.float32)
                * np.float32(sigma)
                for k in (knot, knot + 1)
            )
            self._slow = (knot, before, after)
        return self._slow[1], self._slow[2], time_s / _SLOW_KNOT_S - knot

    def _convert(
        self, signal: NDArray[np.uint16], time_s: float, since_s: float, index: int
    ) -> NDArray[np.uint16]:
        config = self._config
        radiance = signal.astype(np.float32)
        if config.blur_px > 0.0:
            radiance = cv2.GaussianBlur(radiance, (0, 0), config.blur_px)
        rng = self._rng(_FRAME, index)
        noise = rng.standard_normal(self._shape, np.float32)
        rows = (config.row_noise * self._sigma * rng.standard_normal(self._shape[0])).astype(
            np.float32
        )
        columns = (config.column_noise * self._sigma * rng.standard_normal(self._shape[1])).astype(
            np.float32
        )
        warmer = self._fpa.kelvin(time_s) - self._fpa.kelvin(time_s - since_s)
        mean = config.drift_mean_mk * 1e-3 * config.counts_per_kelvin * warmer
        before, after, between = self._slow_noise(time_s)
        counts = np.empty(self._shape, np.uint16)
        read_out(
            radiance,
            SIGNAL_STEP,
            self._gain,
            self._shutter_counts,
            self._fixed,
            self._drift,
            warmer,
            mean,
            self._creep,
            float(np.sqrt(max(since_s, 0.0) / 60.0)),
            before,
            after,
            between,
            noise,
            self._sigma,
            rows,
            columns,
            counts,
        )
        self._dead.apply(counts, rng, self._sigma)
        return counts

    def _telemetry(self, time_s: float, state: FfcState, since_s: float | None) -> Telemetry:
        kelvin = self._fpa.kelvin(time_s)
        return Telemetry(
            fpa_temperature_kelvin=round(kelvin, 2),  # the core reports hundredths
            ffc_state=state,
            frames_since_ffc=None if since_s is None else self._since - 1,
            time_since_ffc_ns=None if since_s is None else round(since_s * 1e9),
        )


class _DeadPixels:
    """Pixels that do not measure: filled from the left, stuck, or jumping."""

    def __init__(
        self, config: ThermalCameraConfig, shape: tuple[int, int], rng: np.random.Generator
    ) -> None:
        size = shape[0] * shape[1]
        width = shape[1]
        filled = round(size * config.replaced_percent / 100.0)
        chosen = rng.permutation(size)[: filled + config.stuck_pixels + config.flickering_pixels]
        bad = np.zeros(size, bool)
        bad[chosen] = True
        self._filled = chosen[:filled]
        # Mean of the nearest measuring pixels on the row.
        column = self._filled % width
        self._left = self._filled - np.minimum(column, 1)
        self._right = self._filled + np.minimum(width - 1 - column, 1)
        self._left = np.where(bad[self._left], self._right, self._left)
        self._right = np.where(bad[self._right], self._left, self._right)
        self._stuck = chosen[filled : filled + config.stuck_pixels]
        self._stuck_counts = rng.choice([0, HIGHEST_COUNT], len(self._stuck)).astype(np.uint16)
        self._flickering = chosen[filled + config.stuck_pixels :]

    def apply(self, counts: NDArray[np.uint16], rng: np.random.Generator, sigma: float) -> None:
        flat = counts.reshape(-1)
        pair = flat[self._left].astype(np.uint32) + flat[self._right]
        flat[self._filled] = (pair + 1) // 2
        flat[self._stuck] = self._stuck_counts
        jumps = np.rint(rng.choice([-12.0, 0.0, 12.0], len(self._flickering)) * sigma)
        jumped = flat[self._flickering].astype(np.int64) + jumps.astype(np.int64)
        flat[self._flickering] = np.clip(jumped, 0, HIGHEST_COUNT)


def smooth_field(shape: tuple[int, int], rng: np.random.Generator) -> NDArray[np.float64]:
    """(H, W) smooth random shading of low order, mean 0 and standard deviation 1."""
    y, x = np.meshgrid(
        np.linspace(-1.0, 1.0, shape[0]), np.linspace(-1.0, 1.0, shape[1]), indexing="ij"
    )
    terms = [x, y, x * y, x * x, y * y, x * x + y * y, x**3, y**3]
    field = np.zeros(shape)
    for term in terms:
        field += rng.standard_normal() * (term - term.mean()) / term.std()
    return np.asarray((field - field.mean()) / field.std())


def _dome(shape: tuple[int, int]) -> NDArray[np.float64]:
    """(H, W) 0 in the centre, 1 in the corners: what the warm housing adds to slanting rays."""
    y, x = np.meshgrid(
        np.linspace(-1.0, 1.0, shape[0]), np.linspace(-1.0, 1.0, shape[1]), indexing="ij"
    )
    return np.asarray((x * x + y * y) / 2.0)


@njit(cache=True, nogil=True, error_model="numpy")
def read_out(
    signal: Map,
    signal_step: float,
    gain: Map,
    shutter: float,
    fixed: Map,
    drift: Map,
    warmer: float,
    mean: float,
    creep: Map,
    crept: float,
    slow_before: Map,
    slow_after: Map,
    between: float,
    noise: Map,
    sigma: float,
    rows: Map,
    columns: Map,
    counts: NDArray[np.uint16],
) -> None:
    """Counts (H, W) uint16 of a blurred signal: gain about the shutter, patterns, noise, rounding.

    ``signal`` in steps of ``signal_step`` counts; all patterns in counts.
    """
    height, width = signal.shape
    step, k0, w, m = (
        np.float32(signal_step),
        np.float32(shutter),
        np.float32(warmer),
        np.float32(mean),
    )
    c, f, s = np.float32(crept), np.float32(between), np.float32(sigma)
    one, half = np.float32(1.0), np.float32(0.5)
    for y in range(height):
        common = m + rows[y] + half
        for x in range(width):
            value = signal[y, x] * step
            value += gain[y, x] * (value - k0)
            value += fixed[y, x] + w * drift[y, x] + c * creep[y, x] + common + columns[x]
            value += (one - f) * slow_before[y, x] + f * slow_after[y, x] + s * noise[y, x]
            counts[y, x] = np.uint16(min(max(value, np.float32(0.0)), np.float32(16383.0)))


def read_out_reference(
    signal: Map,
    signal_step: float,
    gain: Map,
    shutter: float,
    fixed: Map,
    drift: Map,
    warmer: float,
    mean: float,
    creep: Map,
    crept: float,
    slow_before: Map,
    slow_after: Map,
    between: float,
    noise: Map,
    sigma: float,
    rows: Map,
    columns: Map,
) -> NDArray[np.uint16]:
    """``read_out`` in plain numpy."""
    value = signal.astype(np.float64) * signal_step
    value += gain * (value - shutter)
    value += fixed + warmer * drift + mean + crept * creep + rows[:, None] + columns
    value += (1.0 - between) * slow_before + between * slow_after + sigma * noise
    return np.clip(np.floor(value + 0.5), 0, HIGHEST_COUNT).astype(np.uint16)
