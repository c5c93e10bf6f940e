"""Settings as ROS parameters: described, ranged, refused with a reason."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

import rclpy
from rclpy.parameter import Parameter

from thermal_stereo_vo.core.config import group, setting, settings_of
from thermal_stereo_vo.core.errors import ConfigError
from thermal_stereo_vo.nodes.parameters import Parameters
from thermal_stereo_vo.nodes.rectification_node import RectificationNodeConfig
from thermal_stereo_vo.nodes.replay_node import ReplayNodeConfig
from thermal_stereo_vo.nodes.stereo_odometry_config import StereoOdometryNodeConfig


@dataclass(frozen=True)
class Inner:
    gain: float = setting(2.0, "Gain.", unit="counts", minimum=0.5, maximum=8.0)
    mode: str = setting("auto", "Mode.", choices=("auto", "manual"))


@dataclass(frozen=True)
class Example:
    inner: Inner = group(Inner, "A group.")
    count: int = setting(3, "Count.", minimum=1, maximum=10)
    fixed: int = setting(1, "Cannot change.", minimum=0)
    roi: tuple[float, ...] = setting((0.0, 1.0), "A list.")
    polygon: tuple[float, ...] = setting((), "An empty list.")
    tolerance: float | None = setting(None, "May be empty.")
    enabled: bool = setting(True, "A switch.")


LIVE = ("inner.gain", "inner.mode", "count", "roi", "enabled")


@pytest.fixture
def make_node(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Any]]:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    context = rclpy.Context()
    rclpy.init(args=[], context=context)
    nodes = []

    def make(**overrides: object) -> Any:
        parameters = [
            Parameter(name.replace("__", "."), value=value) for name, value in overrides.items()
        ]
        node = rclpy.create_node("example", context=context, parameter_overrides=parameters)
        nodes.append(node)
        return node

    yield make
    for node in nodes:
        node.destroy_node()
    rclpy.try_shutdown(context=context)


def test_defaults_are_declared_with_text_and_range(make_node) -> None:
    node = make_node()
    assert Parameters(node, Example, live=LIVE).config == Example()
    gain = node.describe_parameter("inner.gain")
    assert gain.description == "Gain. [counts, 0.5..8]"
    assert gain.floating_point_range[0].from_value == 0.5
    assert gain.floating_point_range[0].to_value == 8.0
    assert not gain.read_only
    fixed = node.describe_parameter("fixed")
    assert fixed.read_only
    assert fixed.integer_range[0].from_value == 0
    assert fixed.integer_range[0].to_value == 2**63 - 1
    assert node.describe_parameter("inner.mode").additional_constraints == "one of auto, manual"
    assert list(node.get_parameter("roi").value) == [0.0, 1.0]
    assert node.get_parameter("tolerance").value is None


def test_overrides_become_settings(make_node) -> None:
    node = make_node(inner__gain=3, roi=[1, 2, 3], tolerance=0.25, enabled=False)
    config = Parameters(node, Example).config
    assert config == Example(Inner(gain=3.0), roi=(1, 2, 3), tolerance=0.25, enabled=False)
    assert isinstance(config.inner.gain, float)
    assert node.get_parameter("inner.gain").value == 3.0


def test_a_file_may_say_null_and_empty_list(make_node) -> None:
    """rcl reads null as the text 'null' and an empty list as nothing."""
    node = make_node(tolerance="null", polygon=None)
    assert Parameters(node, Example).config == Example()


def test_every_wrong_override_is_named_at_once(make_node) -> None:
    node = make_node(inner__gian=3.0, count=11, fixed="two")
    with pytest.raises(ConfigError) as caught:
        Parameters(node, Example)
    text = str(caught.value)
    assert text.startswith("parameters of /example: ")
    assert "unknown setting 'inner.gian': did you mean 'inner.gain'?" in text
    assert "count = 11 is out of range: Count. [1..10]" in text
    assert "fixed takes a number, got 'two'" in text


def test_settings_of_other_nodes_may_share_the_file(make_node) -> None:
    node = make_node(count=4, rectification__alpha=0.5, use_sim_time=False)
    shared = {"rectification.alpha", "count"}
    assert Parameters(node, Example, shared=shared).config == Example(count=4)


def test_a_live_setting_changes_and_tells(make_node) -> None:
    told: list[Example] = []
    node = make_node()
    parameters = Parameters(node, Example, live=LIVE, on_change=told.append)
    (result,) = node.set_parameters([Parameter("inner.gain", value=4.0)])
    assert result.successful
    assert parameters.config == Example(Inner(gain=4.0))
    assert told == [Example(Inner(gain=4.0))]
    assert node.get_parameter("inner.gain").value == 4.0


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("inner.gain", 8.5, "inner.gain"),
        ("count", 0, "count"),
        ("inner.mode", "manuel", "inner.mode must be one of auto, manual, got 'manuel'"),
        ("fixed", 2, "read-only parameter: fixed"),
        ("count", "many", "Wrong parameter type"),
    ],
)
def test_a_wrong_value_is_refused_with_a_reason(
    make_node, name: str, value: object, reason: str
) -> None:
    told: list[Example] = []
    node = make_node()
    parameters = Parameters(node, Example, live=LIVE, on_change=told.append)
    before = node.get_parameter(name).value
    (result,) = node.set_parameters([Parameter(name, value=value)])
    assert not result.successful
    assert reason in result.reason
    assert parameters.config == Example()
    assert told == []
    assert node.get_parameter(name).value == before


@pytest.mark.parametrize(
    "config", [RectificationNodeConfig, StereoOdometryNodeConfig, ReplayNodeConfig]
)
def test_every_setting_of_a_node_can_be_declared(make_node, config: type) -> None:
    node = make_node()
    assert Parameters(node, config).config == config()
    for info in settings_of(config):
        assert node.describe_parameter(info.path).description.startswith(info.doc)


@pytest.mark.parametrize(
    ("overrides", "complaint"),
    [
        (
            {"mount__position_m": [0.0, 1.0]},
            r"mount.position_m takes 3 numbers .* got \[0.0, 1.0\]",
        ),
        ({"mount__quat_xyzw": [0.0, 0.0, 0.0, 0.0]}, r"mount.quat_xyzw: .*length zero"),
    ],
)
def test_a_mount_that_is_no_pose_is_refused(make_node, overrides: Any, complaint: str) -> None:
    config = Parameters(make_node(**overrides), StereoOdometryNodeConfig).config
    with pytest.raises(ConfigError, match=complaint):
        _ = config.mount.T_base_rig
