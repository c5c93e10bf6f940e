"""Settings of all direct methods: how brightness is compared."""

from __future__ import annotations

from dataclasses import dataclass

from thermal_stereo_vo.core.config import setting


@dataclass(frozen=True)
class PhotometricConfig:
    """How brightness is compared.  Units: a scene has a standard deviation of 60."""

    smoothing_px: float = setting(
        0.8, "Sigma of the Gaussian before all else.", unit="px", minimum=0.0, maximum=5.0
    )
    huber: float = setting(
        9.0, "Residuals beyond this weigh less (DSO).", minimum=0.1, maximum=1000.0
    )
    gate: float = setting(
        14.0,
        "A patch whose residuals are larger than this in root mean square is an outlier.",
        minimum=0.1,
        maximum=1000.0,
    )
    trust_gradient: float = setting(
        50.0, "Pixels as steep as this weigh half (DSO).", minimum=1.0, maximum=10000.0
    )
    iterations: int = setting(
        12, "Most iterations of the alignment on each pyramid level.", minimum=1, maximum=100
    )
    min_inliers: int = setting(
        40, "Fewer patches that fit are no measurement.", minimum=10, maximum=1000
    )
    min_inlier_share: float = setting(
        0.4, "Least share of patches in sight that fit.", minimum=0.0, maximum=1.0
    )
    min_explained: float = setting(
        0.5,
        "A patch fits when this much of its own variance is explained; a flat image explains none.",
        minimum=0.0,
        maximum=1.0,
    )
    marginal_weight: float = setting(
        0.0,
        "What the residuals of a keyframe that leaves the window count from then on (marginalised, "
        "with first-estimate Jacobians); 0 forgets them.",
        minimum=0.0,
        maximum=1.0,
    )
