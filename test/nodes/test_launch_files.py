"""Launch files name what exists: executables, settings, parameter files."""

from __future__ import annotations

import ast
import importlib.util
from pathlib import Path

import pytest

from thermal_stereo_vo.core.config import settings_of

REPOSITORY = Path(__file__).resolve().parent.parent.parent
LAUNCH_FILES = sorted((REPOSITORY / "launch").glob("*.launch.py"))


def texts(tree: ast.AST) -> set[str]:
    """Every string constant below."""
    return {
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }


def calls(tree: ast.AST, name: str) -> list[ast.Call]:
    return [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and ast.unparse(node.func) == name
    ]


def nodes_of_package() -> set[str]:
    tree = ast.parse((REPOSITORY / "setup.py").read_text())
    for node in tree.body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "NODES":
            return set(ast.literal_eval(node.value))
    raise AssertionError("setup.py lists no NODES")


def test_there_are_launch_files() -> None:
    assert {path.name for path in LAUNCH_FILES} >= {"odometry.launch.py", "replay.launch.py"}


@pytest.mark.parametrize("path", LAUNCH_FILES, ids=lambda path: path.name)
def test_executables_and_files_exist(path: Path) -> None:
    tree = ast.parse(path.read_text())
    functions = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    assert "generate_launch_description" in functions
    named = texts(tree)
    executables = {text for text in named if text.endswith("_node")}
    assert executables
    assert executables <= nodes_of_package()
    for text in named:
        if text.endswith(".yaml"):
            assert (REPOSITORY / "config" / text).is_file(), text


@pytest.mark.parametrize("path", LAUNCH_FILES, ids=lambda path: path.name)
def test_every_argument_used_is_declared(path: Path) -> None:
    """LaunchConfiguration of a name that nobody declares fails only when somebody launches."""
    tree = ast.parse(path.read_text())
    declared = {ast.literal_eval(call.args[0]) for call in calls(tree, "DeclareLaunchArgument")}
    used = {ast.literal_eval(call.args[0]) for call in calls(tree, "LaunchConfiguration")}
    assert used == declared


def test_parameters_given_are_parameters_of_the_nodes() -> None:
    pytest.importorskip("rclpy", reason="rclpy is not installed")
    from thermal_stereo_vo.nodes.rectification_node import RectificationNodeConfig
    from thermal_stereo_vo.nodes.replay_node import ReplayNodeConfig
    from thermal_stereo_vo.nodes.stereo_odometry_config import StereoOdometryNodeConfig

    known = {info.path for info in settings_of(ReplayNodeConfig)} | {"use_sim_time"}
    followers = (RectificationNodeConfig, StereoOdometryNodeConfig)
    known |= set.intersection(*({info.path for info in settings_of(c)} for c in followers))
    for path in LAUNCH_FILES:
        for call in calls(ast.parse(path.read_text()), "Node"):
            for keyword in call.keywords:
                if keyword.arg == "parameters":
                    for node in ast.walk(keyword.value):
                        if isinstance(node, ast.Dict):
                            assert {ast.literal_eval(k) for k in node.keys if k} <= known


@pytest.mark.parametrize("path", LAUNCH_FILES, ids=lambda path: path.name)
def test_launch_reads_the_file(path: Path) -> None:
    pytest.importorskip("launch_ros", reason="launch_ros is not installed (it comes with ROS)")
    index = pytest.importorskip("ament_index_python.packages")
    try:
        index.get_package_share_directory("thermal_stereo_vo")
    except index.PackageNotFoundError:
        pytest.skip("the package is not installed in a sourced workspace")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.generate_launch_description().entities
