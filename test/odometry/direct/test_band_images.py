"""Images of two bands in one measure of contrast."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermal_stereo_vo.core.cameras import THERMAL, VISIBLE
from thermal_stereo_vo.odometry.direct.band_images import BandImages
from thermal_stereo_vo.odometry.direct.gradient_pyramid import (
    BrightnessUnit,
    build_gradient_pyramid,
)
from thermal_stereo_vo.odometry.direct.multispectral_config import BandPhotometricConfig

from .two_band_room import Room


@pytest.mark.parametrize("roles", [(VISIBLE, THERMAL), (VISIBLE,), (THERMAL,)])
def test_each_band_is_smoothed_as_its_own_noise_asks_for(rng, roles):
    frame = Room(0).frame(0, np.eye(4), rng)
    config = BandPhotometricConfig(smoothing_px=0.6, thermal_smoothing_px=1.7)
    images = BandImages.of(frame, roles, config, 0.0)
    for camera, role in enumerate(roles):
        view = frame.views[role]
        pyramid = images.pyramid(frame, camera, None, 1.0, images.rig)
        sigma_px = 1.7 if role == THERMAL else 0.6
        unit = BrightnessUnit.of(view.image, view.mask)
        expected = build_gradient_pyramid(view.image, sigma_px, unit)
        for level, plain in zip(pyramid, expected, strict=True):
            np.testing.assert_array_equal(level, plain)


def test_a_flat_band_is_no_start(rng):
    frame = Room(0).frame(0, np.eye(4), rng)
    view = frame.views[THERMAL]
    flat = replace(view, image=np.full_like(view.image, 7000))
    frame = replace(frame, views={VISIBLE: frame.views[VISIBLE], THERMAL: flat})
    assert BandImages.of(frame, (VISIBLE, THERMAL), BandPhotometricConfig(), 0.0) is None
    assert BandImages.of(frame, (VISIBLE,), BandPhotometricConfig(), 0.0) is not None
