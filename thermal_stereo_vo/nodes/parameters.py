"""A node's settings as ROS parameters: declared, described and checked from one dataclass."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from thermal_stereo_vo.core.config import (
    SettingInfo,
    describe,
    flatten,
    from_mapping,
    settings_of,
)
from thermal_stereo_vo.core.errors import ConfigError

Config = TypeVar("Config")

_OF_ROS = ("qos_overrides.", "use_sim_time", "start_type_description_service")


class Parameters(Generic[Config]):
    """The settings of a node, always valid.

    A file of settings may serve several nodes and the replay: keys in ``shared`` that this node
    does not have are passed over.  Only the settings in ``live`` can be changed while the node
    runs; ``on_change`` is told.

    Raises ConfigError that lists every override that is unknown or out of range.
    """

    def __init__(
        self,
        node: Node,
        config_type: type[Config],
        *,
        live: Collection[str] = (),
        shared: Collection[str] = (),
        on_change: Callable[[Config], None] = lambda config: None,
    ) -> None:
        infos = {info.path: info for info in settings_of(config_type)}
        self._infos = infos
        self._on_change = on_change
        foreign = set(shared) - set(infos)
        # rclpy has no public way to see overrides that nobody declared, so misspelt ones; letting
        # it declare them all fails on a null.
        given = {
            name: _plain(parameter.value, infos.get(name))
            for name, parameter in node._parameter_overrides.items()
            if not name.startswith(_OF_ROS) and name not in foreign
        }
        try:
            self.config: Config = from_mapping(config_type, given)
        except ConfigError as error:
            raise ConfigError(f"parameters of {node.get_fully_qualified_name()}: {error}") from None
        for path, value in flatten(self.config).items():
            node.declare_parameter(
                path,
                list(value) if isinstance(value, tuple) else value,
                descriptor(infos[path], read_only=path not in live),
                ignore_override=True,
            )
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._take_over)

    def _changed(self, parameters: list[Parameter]) -> Config:
        mine = {
            parameter.name: _plain(parameter.value, self._infos[parameter.name])
            for parameter in parameters
            if parameter.name in self._infos
        }
        return from_mapping(type(self.config), mine, base=self.config)

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            self._changed(parameters)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _take_over(self, parameters: list[Parameter]) -> None:
        config = self._changed(parameters)
        if config != self.config:
            self.config = config
            self._on_change(config)


def descriptor(info: SettingInfo, *, read_only: bool) -> ParameterDescriptor:
    """Text, range and kind of a setting as ROS shows them."""
    result = ParameterDescriptor(
        name=info.path,
        description=describe(info),
        additional_constraints=f"one of {', '.join(info.choices)}" if info.choices else "",
        read_only=read_only,
        # An optional setting has no type while it is empty, and an empty list has none either.
        dynamic_typing=info.optional or info.kind is tuple,
    )
    if info.minimum is None and info.maximum is None:
        return result
    if info.kind is int:
        low = -(2**63) if info.minimum is None else int(info.minimum)
        high = 2**63 - 1 if info.maximum is None else int(info.maximum)
        result.integer_range = [IntegerRange(from_value=low, to_value=high)]
    elif info.kind is float:
        low_ = -sys.float_info.max if info.minimum is None else float(info.minimum)
        high_ = sys.float_info.max if info.maximum is None else float(info.maximum)
        result.floating_point_range = [FloatingPointRange(from_value=low_, to_value=high_)]
    return result


def _plain(value: Any, info: SettingInfo | None) -> Any:
    """A parameter's value as a YAML file of settings would give it."""
    if info is not None and info.kind is tuple and value is None:
        return []  # rcl reads an empty list as nothing
    if info is not None and info.optional and value in ("null", "~", ""):
        return None  # rcl knows no null
    return value if value is None or isinstance(value, (bool, int, float, str)) else list(value)
