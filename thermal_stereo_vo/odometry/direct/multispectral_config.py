"""Settings of the direct visible + thermal method."""

from __future__ import annotations

from dataclasses import dataclass

from thermal_stereo_vo.core.config import group, setting
from thermal_stereo_vo.odometry.direct.photometric_config import PhotometricConfig
from thermal_stereo_vo.odometry.direct.point_selection import SelectionConfig


@dataclass(frozen=True)
class BandPhotometricConfig(PhotometricConfig):
    """How brightness is compared within each of two bands."""

    thermal_smoothing_px: float = setting(
        1.4,
        "As smoothing_px for a thermal camera, whose noise and fixed pattern are most of what "
        "neighbouring pixels differ by.",
        unit="px",
        minimum=0.0,
        maximum=5.0,
    )
    patch_offset: float = setting(
        1.0,
        "How far the brightness of a thermal patch may be off as a whole (1 sigma), relative to "
        "the noise of a pixel: shading of the optics stays with the sensor while the scene moves "
        "on.",
        minimum=0.0,
        maximum=100.0,
    )
    marginal_weight: float = setting(
        0.5,
        "What the residuals of a keyframe that leaves the window count from then on (marginalised, "
        "with first-estimate Jacobians), once the scale is known; 0 forgets them.",
        minimum=0.0,
        maximum=1.0,
    )


@dataclass(frozen=True)
class BandSelectionConfig(SelectionConfig):
    """How many points there are and how they spread."""

    points: int = setting(
        375, "Points the keyframes of the first camera keep in sight.", minimum=100, maximum=5000
    )


@dataclass(frozen=True)
class BandKeyframeConfig:
    """When a frame becomes a keyframe, and how keyframes are adjusted."""

    inlier_share: float = setting(
        0.7,
        "A keyframe is due when fewer points fit than this share of what fitted at best since the "
        "newest.",
        minimum=0.0,
        maximum=1.0,
    )
    parallax_px: float = setting(
        6.0,
        "A keyframe is due when points have moved this far by translation.",
        unit="px",
        minimum=1.0,
        maximum=500.0,
    )
    flow_px: float = setting(
        60.0,
        "A keyframe is due when points have moved this far in all.",
        unit="px",
        minimum=1.0,
        maximum=1000.0,
    )
    bundle_iterations: int = setting(
        6, "Most iterations of a photometric adjustment (DSO).", minimum=1, maximum=100
    )
    first_iterations: int = setting(
        20,
        "Most iterations while the first keyframes find their depths.",
        minimum=1,
        maximum=200,
    )


@dataclass(frozen=True)
class ScaleConfig:
    """When the size of the map is known."""

    smallest_m: float = setting(
        0.25, "Least mean distance of the scene at the start.", unit="m", minimum=0.01, maximum=10.0
    )
    largest_m: float = setting(
        60.0,
        "Largest mean distance of the scene at the start.",
        unit="m",
        minimum=1.0,
        maximum=1000.0,
    )
    windows: int = setting(
        6, "Adjustments that must have told the scale before it is believed.", minimum=3, maximum=50
    )
    sigma: float = setting(
        0.025,
        "Relative standard deviation of the scale with which it is believed.",
        minimum=0.001,
        maximum=0.5,
    )
    drift: float = setting(
        0.0045,
        "Relative error of the size that grows from keyframe to keyframe (1 sigma): more "
        "follows drift faster, less averages over more windows.",
        minimum=1e-6,
        maximum=0.5,
    )
    first_drift: float = setting(
        0.05,
        "As drift, more of it in a young map; fades over a dozen keyframes.",
        minimum=0.0,
        maximum=0.5,
    )
    reopen: float = setting(
        0.2,
        "Relative error of the size, agreed by as many windows, that makes it unknown again.",
        minimum=0.02,
        maximum=1.0,
    )


@dataclass(frozen=True)
class MultispectralConfig:
    """Direct visible + thermal odometry."""

    photometric: BandPhotometricConfig = group(BandPhotometricConfig, "How brightness is compared.")
    selection: BandSelectionConfig = group(BandSelectionConfig, "Which pixels become points.")
    keyframes: BandKeyframeConfig = group(BandKeyframeConfig, "When a frame is kept.")
    scale: ScaleConfig = group(ScaleConfig, "When the size of the map is known.")
    second_share: float = setting(
        0.6,
        "Points in the second camera for one in the first.",
        minimum=0.1,
        maximum=1.0,
    )
    rig_check_deg: float = setting(
        0.5,
        "Error of the calibrated rotation between the cameras, as their images tell it, that makes "
        "the status DEGRADED and keeps the scale unknown.",
        unit="deg",
        minimum=0.1,
        maximum=180.0,
    )
    rig_check_ms: float = setting(
        2.5,
        "Change of the thermal camera's lag within ten windows that makes the status DEGRADED, and "
        "keeps the scale unknown where it is: the cameras' stamps come from two clocks.",
        unit="ms",
        minimum=0.1,
        maximum=1000.0,
    )
    exposure_lag_ms: float = setting(
        0.0,
        "How long before its stamp the visible camera saw what it shows: half the exposure where "
        "stamps mark its end.  Poses are moved on by this with the twist.",
        unit="ms",
        minimum=0.0,
        maximum=100.0,
    )
    exposure_lag_sigma_ms: float = setting(
        5.0,
        "How well that lag is known; adds to the covariance along the twist.",
        unit="ms",
        minimum=0.0,
        maximum=100.0,
    )
    covariance_scale: float = setting(
        8.0,
        "Factor on covariances for what the residuals do not show.",
        minimum=0.01,
        maximum=1000.0,
    )
