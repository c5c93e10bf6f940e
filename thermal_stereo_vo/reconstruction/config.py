"""Settings of ``reconstruct``: those of the replay and those of the model."""

from __future__ import annotations

from dataclasses import dataclass

from thermal_stereo_vo.core.config import group
from thermal_stereo_vo.pipeline import Config
from thermal_stereo_vo.reconstruction.reconstructor import ModelConfig


@dataclass(frozen=True)
class ReconstructConfig(Config):
    """Every setting."""

    model: ModelConfig = group(ModelConfig, "The model made of dense clouds.")
