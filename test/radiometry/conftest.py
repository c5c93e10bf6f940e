"""A scene that a microbolometer looks at while it moves, and a camera that looks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from thermal_stereo_vo.core.frames import RawFrame

PERIOD_NS = 33_333_333


@dataclass
class MovingScene:
    """A textured wall of warm and cold spots seen through a sliding window; counts around 8000."""

    wall: NDArray[np.float64]
    shape: tuple[int, int]
    rng: np.random.Generator
    noise_counts: float = 1.5

    def clean(self, x_px: float, y_px: float = 0.0) -> NDArray[np.float64]:
        height, width = self.shape
        x = x_px % (self.wall.shape[1] - width - 1)
        left, top = int(x), int(y_px) % 40
        part = self.wall[top : top + height, left : left + width + 1]
        return part[:, :-1] + (x - left) * (part[:, 1:] - part[:, :-1])

    def noisy(self, counts: NDArray[np.float64]) -> NDArray[np.uint16]:
        noise = self.noise_counts * self.rng.standard_normal(self.shape)
        return np.clip(np.round(counts + noise), 0, 65535).astype(np.uint16)

    def view(self, x_px: float, y_px: float = 0.0) -> NDArray[np.uint16]:
        return self.noisy(self.clean(x_px, y_px))


@pytest.fixture
def scene(rng: np.random.Generator) -> MovingScene:
    return make_scene(rng, (240, 320))


@pytest.fixture
def small_scene(rng: np.random.Generator) -> MovingScene:
    return make_scene(rng, (96, 128))


@pytest.fixture
def rough_scene(rng: np.random.Generator) -> MovingScene:
    """Every block is full of structure."""
    wall = np.full((136, 1328), 8000.0)
    for sigma, contrast in ((8.0, 8.0), (2.0, 60.0)):
        octave = cv2.GaussianBlur(rng.standard_normal(wall.shape), (0, 0), sigma)
        wall += contrast * octave / octave.std()
    return MovingScene(wall, (96, 128), rng)


def make_scene(rng: np.random.Generator, shape: tuple[int, int]) -> MovingScene:
    size = (shape[0] + 40, shape[1] + 1200)
    wall = np.full(size, 8000.0)
    for sigma, contrast in ((24.0, 60.0), (6.0, 30.0), (1.5, 12.0)):
        octave = cv2.GaussianBlur(rng.standard_normal(size), (0, 0), sigma)
        wall += contrast * octave / octave.std()
    # Smooth surfaces between rough ones, as asphalt between trees.
    smooth = cv2.GaussianBlur(rng.standard_normal(size), (0, 0), 30.0) > 0
    wall = np.where(smooth, cv2.GaussianBlur(wall, (0, 0), 12.0), wall)
    return MovingScene(wall, shape, rng)


@pytest.fixture
def as_raw() -> Callable[..., RawFrame]:
    """``as_raw(image, k)``: the k-th frame of a 30 Hz camera."""

    def make(image: NDArray[np.generic], k: int, **more: object) -> RawFrame:
        more.setdefault("camera", "left")
        return RawFrame(np.array(image), 1_000_000_000 + k * PERIOD_NS, sequence=k, **more)

    return make


@dataclass
class Sensor:
    """A made-up microbolometer array: what each pixel answers to a level at an FPA temperature.

    ``y = level + offset(T) + response (level - 8000)``; ``dead`` pixels answer nothing.
    """

    shape: tuple[int, int]
    offsets: NDArray[np.float64]
    response: NDArray[np.float64]
    dead: NDArray[np.bool_]

    def offset(self, fpa_kelvin: float) -> NDArray[np.float64]:
        t = (fpa_kelvin - 300.0) / 20.0
        return np.tensordot(t ** np.arange(3), self.offsets, axes=1)

    def see(self, level: NDArray[np.float64] | float, fpa_kelvin: float) -> NDArray[np.float64]:
        counts = level + self.offset(fpa_kelvin) + self.response * (np.asarray(level) - 8000.0)
        return np.where(self.dead, 3000.0, counts)


@pytest.fixture
def sensor(rng: np.random.Generator) -> Sensor:
    shape = (96, 128)
    offsets = rng.normal(0, 1, (3, *shape)) * np.array([40.0, 15.0, 4.0])[:, None, None]
    offsets[0] += 20.0 * rng.standard_normal(shape[1])
    offsets -= offsets.mean(axis=(1, 2), keepdims=True)
    response = 0.03 * rng.standard_normal(shape)
    response -= response.mean()
    dead = np.zeros(shape, np.bool_)
    dead[10, 20] = dead[0, 0] = dead[50, 60] = dead[50, 61] = True
    return Sensor(shape, offsets, response, dead)
