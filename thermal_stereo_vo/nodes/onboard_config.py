"""Settings of the onboard node: those of the cameras, of the pipeline and of the odometry."""

from __future__ import annotations

from dataclasses import dataclass

from thermal_stereo_vo.core.config import group, setting
from thermal_stereo_vo.nodes.stereo_odometry_config import StereoOdometryNodeConfig
from thermal_stereo_vo.pipeline import Config as PipelineConfig
from thermal_stereo_vo.radiometry.front_end import FrontEndConfig
from thermal_stereo_vo.stereo_capture import StereoCaptureConfig

TOPICS = "topics"


@dataclass(frozen=True)
class OnboardNodeConfig(StereoOdometryNodeConfig, StereoCaptureConfig):
    """Settings of the node."""

    source: str = setting(
        TOPICS,
        "topics: listen to left|right/image_raw; grabbers: capture from two V4L2 devices in this "
        "process; recording: a recording plays the cameras.",
        choices=(TOPICS, "grabbers", "recording"),
    )
    front_end: FrontEndConfig = group(FrontEndConfig, "From raw to linear counts.")
    latency_window: int = setting(
        300, "Latencies in diagnostics are those of so many last pairs.", minimum=1, maximum=100_000
    )

    @property
    def pipeline(self) -> PipelineConfig:
        """The part that the replay knows too."""
        return PipelineConfig(
            front_end=self.front_end,
            pairing=self.pairing,
            agc=self.agc,
            odometry=self.odometry,
            dense=self.dense,
            thermometer=self.thermometer,
        )
