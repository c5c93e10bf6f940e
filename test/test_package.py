"""The package as colcon builds and installs it."""

from __future__ import annotations

import ast
import configparser
import os
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

import thermal_stereo_vo

REPOSITORY = Path(__file__).resolve().parent.parent
NAME = "thermal_stereo_vo"
SOURCES = ["package.xml", "setup.py", "setup.cfg", "LICENSE", "resource", "config", "launch", NAME]


def manifest() -> ElementTree.Element:
    return ElementTree.parse(REPOSITORY / "package.xml").getroot()


def nodes() -> list[str]:
    """The list NODES in setup.py."""
    for node in ast.parse((REPOSITORY / "setup.py").read_text()).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "NODES":
            return ast.literal_eval(node.value)
    raise AssertionError("setup.py lists no NODES")


def modules() -> set[Path]:
    return {path.relative_to(REPOSITORY) for path in (REPOSITORY / NAME).rglob("*.py")}


def test_manifest_and_package_agree() -> None:
    package = manifest()
    assert package.get("format") == "3"
    assert package.findtext("name") == NAME
    assert package.findtext("version") == thermal_stereo_vo.__version__
    assert package.findtext("license") == "Apache-2.0"
    assert package.findtext("export/build_type") == "ament_python"
    assert (REPOSITORY / "resource" / NAME).is_file()


def test_every_ros_package_in_use_is_declared() -> None:
    """A message package that is imported but not declared is missing on a fresh robot."""
    declared = {item.text for item in manifest().iter("exec_depend")}
    used = set()
    for path in [
        *(REPOSITORY / NAME / "nodes").glob("*.py"),
        *(REPOSITORY / "launch").glob("*.py"),
    ]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module:
                used.add(node.module.split(".")[0])
            elif isinstance(node, ast.Import):
                used.update(alias.name.split(".")[0] for alias in node.names)
    ros = {name for name in used if name.endswith(("_msgs", "_srvs", "_interfaces"))}
    ros |= used & {"rclpy", "launch", "launch_ros"}
    assert "rclpy" in ros
    assert ros - declared == set()


def test_every_node_has_a_main() -> None:
    for name in nodes():
        tree = ast.parse((REPOSITORY / NAME / "nodes" / f"{name}.py").read_text())
        assert "main" in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}, (
            name
        )
    written = {path.stem for path in (REPOSITORY / NAME / "nodes").glob("*_node.py")}
    assert written == set(nodes())


def test_scripts_go_where_ros2_run_looks() -> None:
    config = configparser.ConfigParser()
    config.read(REPOSITORY / "setup.cfg")
    assert config["develop"]["script_dir"] == f"$base/lib/{NAME}"
    assert config["install"]["install_scripts"] == f"$base/lib/{NAME}"


def test_pyproject_holds_tool_tables_only() -> None:
    """A [project] table would take the metadata over, and colcon would lose the entry points."""
    tables = re.findall(r"^\[+([a-z-]+)", (REPOSITORY / "pyproject.toml").read_text(), re.MULTILINE)
    assert set(tables) == {"tool"}


def test_every_folder_with_code_is_a_package() -> None:
    """find_packages passes over a folder without __init__.py, and the robot lacks its modules."""
    folders = {path.parent for path in modules()}
    assert [
        folder for folder in folders if not (REPOSITORY / folder / "__init__.py").exists()
    ] == []


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The install folder of ``colcon build`` in a fresh workspace."""
    colcon = shutil.which("colcon", path=f"{Path(sys.executable).parent}{os.pathsep}{os.defpath}")
    if colcon is None:
        pytest.skip("colcon is not installed: pip install colcon-common-extensions")
    workspace = tmp_path_factory.mktemp("workspace")
    source = workspace / "src" / NAME
    source.mkdir(parents=True)
    for name in SOURCES:
        path = REPOSITORY / name
        if path.is_dir():
            shutil.copytree(path, source / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy2(path, source / name)
    run = subprocess.run(
        [colcon, "build", "--event-handlers", "console_direct+"],
        cwd=workspace,
        env={
            **os.environ,
            "COLCON_HOME": str(workspace),
            "COLCON_PYTHON_EXECUTABLE": sys.executable,
        },
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    assert "1 package finished" in run.stdout
    return workspace / "install" / NAME


def site_packages(installed: Path) -> Path:
    (package,) = installed.glob(f"lib/python*/site-packages/{NAME}")
    return package.parent


def test_installed_tree_is_complete(installed: Path) -> None:
    root = site_packages(installed)
    there = {path.relative_to(root) for path in (root / NAME).rglob("*.py")}
    assert modules() - there == set()
    share = installed / "share" / NAME
    assert (share / "package.xml").is_file()
    assert (installed / "share" / "ament_index" / "resource_index" / "packages" / NAME).is_file()
    profile = Path("nodes", "fastdds.xml")
    assert (root / NAME / profile).read_bytes() == (REPOSITORY / NAME / profile).read_bytes()
    for folder, pattern, more in (
        ("config", "*.yaml", {profile.name}),
        ("launch", "*.launch.py", set()),
    ):
        wanted = {path.name for path in (REPOSITORY / folder).glob(pattern)}
        assert wanted
        wanted |= more
        assert {path.name for path in (share / folder).iterdir()} == wanted


def test_installed_executables_start(installed: Path) -> None:
    """Each one prints what it is for, from the installed files and not from this checkout."""
    pytest.importorskip("rclpy", reason="rclpy is not installed")
    executables = {path.name for path in (installed / "lib" / NAME).iterdir()}
    assert executables == set(nodes())
    environment = {**os.environ, "PYTHONPATH": str(site_packages(installed))}
    for name in sorted(executables):
        run = subprocess.run(
            [installed / "lib" / NAME / name, "--help"],
            cwd=installed,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
            timeout=600,
        )
        assert run.returncode == 0, run.stderr
        assert f"ros2 run {NAME} {name}" in run.stdout
        assert "Parameters" in run.stdout
