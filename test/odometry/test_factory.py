"""The method that the settings name is the one that runs."""

from __future__ import annotations

import pytest

from thermal_stereo_vo.core.config import from_mapping, settings_of, with_overrides
from thermal_stereo_vo.core.errors import ConfigError
from thermal_stereo_vo.odometry.direct.stereo_method import StereoDirectOdometry
from thermal_stereo_vo.odometry.factory import (
    OdometryConfig,
    create_odometry,
    describe,
    methods_for,
    requirements_of,
)
from thermal_stereo_vo.odometry.feature_based.frame_to_frame import FrameToFrameOdometry
from thermal_stereo_vo.odometry.feature_based.windowed import WindowedOdometry


def config(*assignments: str) -> OdometryConfig:
    return with_overrides(OdometryConfig(), assignments)


@pytest.mark.parametrize(
    ("assignments", "kind", "words"),
    [
        (["window=0"], FrameToFrameOdometry, "feature, frame to frame, double dogleg"),
        (["window=0", "solver=gauss_newton"], FrameToFrameOdometry,
         "feature, frame to frame, gauss newton"),
        (["window=2"], WindowedOdometry, "feature, window of 2 keyframes"),
        ([], WindowedOdometry, "feature, window of 7 keyframes"),
        (["method=direct"], StereoDirectOdometry, "direct, window of 7 keyframes"),
    ],
)  # fmt: skip
def test_settings_choose_the_method(assignments, kind, words):
    odometry = create_odometry(config(*assignments))
    assert type(odometry) is kind
    assert odometry.requirements.roles == ("left", "right")
    assert odometry.requirements.rectified_pair
    assert describe(config(*assignments)) == words


def test_a_window_of_one_is_refused():
    with pytest.raises(
        ConfigError,
        match=r"odometry.window = 1 leaves nothing to optimise: give 0 \(frame to frame\) or 2 and "
        "more",
    ):
        create_odometry(config("window=1"))


@pytest.mark.parametrize("method", ["direct", "multispectral"])
@pytest.mark.parametrize("window", [0, 1])
def test_direct_methods_need_a_window(method, window):
    with pytest.raises(ConfigError, match=rf"window = {window} leaves the {method} method nothing"):
        create_odometry(config(f"method={method}", f"window={window}"))


def test_the_method_of_two_bands_asks_for_them():
    odometry = create_odometry(config("method=multispectral"))
    assert odometry.requirements == requirements_of(config("method=multispectral"))
    assert odometry.requirements.roles == ("visible", "thermal")
    assert not odometry.requirements.rectified_pair
    assert methods_for(("visible", "thermal")) == ("multispectral",)


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ({"method": "magic"}, "method must be one of .*feature.*, got 'magic'"),
        ({"solver": "gauss"}, "solver must be one of gauss_newton, levenberg_marquardt, "
         "double_dogleg, got 'gauss'"),
        ({"window": -1}, "window = -1 is out of range"),
        ({"seed": -1}, "seed = -1 is out of range"),
    ],
)  # fmt: skip
def test_unknown_choices_are_refused_by_the_settings(mapping, message):
    with pytest.raises(ConfigError, match=message):
        from_mapping(OdometryConfig, mapping)


def test_every_method_in_the_settings_can_be_built():
    choices = next(i for i in settings_of(OdometryConfig) if i.path == "method").choices
    for method in choices:
        assert create_odometry(config(f"method={method}")).requirements.roles
