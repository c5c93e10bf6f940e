"""Every settings file in config/ is accepted by those it is meant for."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest
import yaml

from thermal_stereo_vo.core.config import from_mapping, load_yaml
from thermal_stereo_vo.core.errors import ConfigError
from thermal_stereo_vo.pipeline import Config

REPOSITORY = Path(__file__).resolve().parent.parent
FILES = sorted((REPOSITORY / "config").glob("*.yaml"))


def node_configs() -> dict[str, type]:
    """Name of the node -> its settings, for every node of the package."""
    pytest.importorskip("rclpy", reason="rclpy is not installed")
    from thermal_stereo_vo.nodes.runtime import BaseNode

    for path in (REPOSITORY / "thermal_stereo_vo" / "nodes").glob("*_node.py"):
        importlib.import_module(f"thermal_stereo_vo.nodes.{path.stem}")
    return {node.NAME: node.CONFIG for node in BaseNode.__subclasses__()}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_settings_file_is_accepted(path: Path) -> None:
    document = yaml.safe_load(path.read_text())
    sections = {
        name: value["ros__parameters"]
        for name, value in document.items()
        if isinstance(value, dict) and "ros__parameters" in value
    }
    if not sections or "/**" in sections:
        load_yaml(Config, path.read_text(), origin=path.name)
    for name, mapping in sections.items():
        if name != "/**":
            from_mapping(node_configs()[name.rpartition("/")[2]], mapping)


def test_a_misspelt_key_would_be_seen() -> None:
    with pytest.raises(ConfigError, match="did you mean 'process_all'"):
        from_mapping(node_configs()["stereo_odometry"], {"proces_all": True})


def test_files_for_flight_and_recordings_are_there() -> None:
    assert {path.name for path in FILES} >= {"flight.yaml", "recording.yaml", "multispectral.yaml"}
