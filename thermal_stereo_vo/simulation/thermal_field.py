"""Temperatures of the materials in a weather, and the radiance they give.

Radiance is written in counts by the camera makers' form of Planck's law over 8-14 um,
``S = R / (exp(B / T) - F)`` (FLIR A15 manual), with R chosen for the wanted counts per kelvin.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, auto

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermal_stereo_vo.simulation.materials import SUBSTANCES, Material, Texture
from thermal_stereo_vo.simulation.weather import Weather

PLANCK_B_KELVIN = 1428.0
PLANCK_F = 1.0
REFERENCE_KELVIN = 300.0


@dataclass(frozen=True)
class Responsivity:
    """Counts of a black body: ``planck_r / (exp(B / T) - F)``; no offset."""

    counts_per_kelvin: float = 30.0

    @property
    def planck_r(self) -> float:
        """R that gives ``counts_per_kelvin`` at 300 K."""
        e = np.exp(PLANCK_B_KELVIN / REFERENCE_KELVIN)
        slope = PLANCK_B_KELVIN / REFERENCE_KELVIN**2 * e / (e - PLANCK_F) ** 2
        return float(self.counts_per_kelvin / slope)

    def counts(self, temperature_kelvin: ArrayLike) -> NDArray[np.float64]:
        """Radiance of a black body, in counts."""
        T = np.asarray(temperature_kelvin, dtype=np.float64)
        return np.asarray(self.planck_r / (np.exp(PLANCK_B_KELVIN / T) - PLANCK_F))

    def kelvin(self, counts: ArrayLike) -> NDArray[np.float64]:
        """Temperature of the black body with this radiance, the inverse of ``counts``."""
        S = np.asarray(counts, dtype=np.float64)
        return np.asarray(PLANCK_B_KELVIN / np.log(self.planck_r / S + PLANCK_F))


class Column(IntEnum):
    """Columns of a material table."""

    EMISSIVITY = 0
    BASE = auto()
    SUN = auto()
    DAYLIGHT = auto()
    SKY = auto()
    OFFSET = auto()
    MIRROR = auto()
    AMPLITUDE = auto()
    SPACING = auto()
    OCTAVES = auto()
    PERSISTENCE = auto()
    CRACKS = auto()
    PATCHES = auto()
    CELL_ALONG = auto()
    CELL_UP = auto()
    CELLS = auto()
    JOINTS = auto()


def thermal_table(weather: Weather) -> NDArray[np.float64]:
    """(materials, columns) temperatures in K; texture amplitudes in K."""
    table = np.zeros((len(Material), len(Column)))
    for material, substance in SUBSTANCES.items():
        row = table[material]
        scale = weather.contrast if substance.passive else 1.0
        row[Column.EMISSIVITY] = substance.emissivity
        row[Column.BASE] = (
            weather.air_kelvin
            + substance.own_kelvin
            + substance.stored_kelvin * weather.heat_storage
        )
        row[Column.DAYLIGHT] = 0.25 * substance.solar_kelvin * weather.daylight
        row[Column.SUN] = substance.solar_kelvin * weather.sun
        row[Column.SKY] = substance.sky_loss_kelvin * weather.sky_cooling
        row[Column.OFFSET] = 1.0 if substance.heated else scale
        row[Column.MIRROR] = float(substance.mirror)
        _fill_texture(row, substance.heat, scale)
    return table


def visible_table() -> NDArray[np.float64]:
    """(materials, columns) reflectance in BASE; texture amplitudes relative to it."""
    table = np.zeros((len(Material), len(Column)))
    for material, substance in SUBSTANCES.items():
        row = table[material]
        row[Column.BASE] = substance.albedo
        row[Column.MIRROR] = float(substance.mirror)
        _fill_texture(row, substance.paint, 1.0)
    return table


def _fill_texture(row: NDArray[np.float64], texture: Texture, scale: float) -> None:
    # The octaves add up to the amplitude however many there are.
    octaves = texture.persistence ** np.arange(texture.octaves)
    row[Column.AMPLITUDE] = scale * texture.amplitude / np.sqrt(np.sum(octaves**2))
    row[Column.SPACING] = texture.spacing_m
    row[Column.OCTAVES] = texture.octaves
    row[Column.PERSISTENCE] = texture.persistence
    row[Column.CRACKS] = scale * texture.cracks
    row[Column.PATCHES] = scale * texture.patches
    row[Column.CELL_ALONG], row[Column.CELL_UP] = texture.cell_m
    row[Column.CELLS] = scale * texture.cells
    row[Column.JOINTS] = scale * texture.joints
