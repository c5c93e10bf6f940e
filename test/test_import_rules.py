"""The arrows between the rooms, read from the syntax trees."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
PACKAGE = "thermal_stereo_vo"
ROOT = REPOSITORY / PACKAGE

ROS = {
    "action_msgs",
    "ament_index_python",
    "builtin_interfaces",
    "cv_bridge",
    "diagnostic_msgs",
    "diagnostic_updater",
    "geometry_msgs",
    "launch",
    "launch_ros",
    "message_filters",
    "nav_msgs",
    "rcl_interfaces",
    "rclpy",
    "rosgraph_msgs",
    "sensor_msgs",
    "std_msgs",
    "std_srvs",
    "stereo_msgs",
    "tf2_msgs",
    "tf2_ros",
}
HEAVY = {"cv2", "embreex", "matplotlib", "numba", "rosbags", "scipy", "serial", "trimesh"}
STAGES = {"capture", "radiometry", "stereo", "odometry"}
PLUG = {
    f"{PACKAGE}.odometry",
    f"{PACKAGE}.odometry.interface",
    f"{PACKAGE}.odometry.factory",
    f"{PACKAGE}.odometry.solver_comparison",  # a measurement of the method itself
    f"{PACKAGE}.odometry.feature_count",  # a measurement of images
}

MODULES = sorted(ROOT.rglob("*.py"))


def imported(node: ast.stmt, module: Path) -> Iterator[str]:
    """Absolute names of the modules an import statement may load."""
    if isinstance(node, ast.Import):
        for alias in node.names:
            yield alias.name
    elif isinstance(node, ast.ImportFrom):
        base = node.module or ""
        if node.level:
            package = module.relative_to(REPOSITORY).parent.parts
            base = ".".join([*package[: len(package) - node.level + 1], *filter(None, [base])])
        yield base
        for alias in node.names:
            inner = f"{base}.{alias.name}"
            if REPOSITORY.joinpath(*inner.split(".")).with_suffix(".py").exists():
                yield inner


def all_imports(module: Path, source: str | None = None) -> set[str]:
    tree = ast.parse(module.read_text() if source is None else source)
    nodes = (node for node in ast.walk(tree) if isinstance(node, ast.stmt))
    return {name for node in nodes for name in imported(node, module)}


def imports_at_load(module: Path, source: str | None = None) -> set[str]:
    """Imports that run when the module is loaded: not those inside functions or type checks."""
    found: set[str] = set()

    def visit(body: list[ast.stmt]) -> None:
        for node in body:
            found.update(imported(node, module))
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                continue
            if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
                visit(node.orelse)
                continue
            for block in ("body", "orelse", "finalbody"):
                visit(getattr(node, block, []))
            for handler in getattr(node, "handlers", []):
                visit(handler.body)

    visit(ast.parse(module.read_text() if source is None else source).body)
    return found


def room_of(module: str) -> str:
    """``core`` of ``thermal_stereo_vo.core.frames``; '' for what is not of this package."""
    parts = module.split(".")
    return parts[1] if parts[0] == PACKAGE and len(parts) > 1 else ""


def violations(module: Path, source: str | None = None) -> list[str]:
    """Every sentence that says which arrow of this module points the wrong way."""
    room = module.relative_to(ROOT).parts[0].removesuffix(".py")
    names = all_imports(module, source)
    rooms = {room_of(name) for name in names} - {"", room}
    where = module.relative_to(REPOSITORY)
    wrong = []
    if room != "nodes":
        wrong += [
            f"{where} imports {name}: only nodes/ may speak ROS"
            for name in sorted(names)
            if name.split(".")[0] in ROS
        ]
        if "nodes" in rooms:
            wrong.append(f"{where} imports nodes/: nothing may lean on the nodes")
    if room not in ("cli", "__main__") and "cli" in rooms:
        wrong.append(f"{where} imports cli/: nothing may lean on the command line")
    if room == "core" and rooms:
        wrong.append(f"{where} imports {sorted(rooms)}: core/ knows no other room")
    if room in STAGES and rooms - {"core", "observers"}:
        wrong.append(f"{where} imports {sorted(rooms)}: a stage knows core/ only")
    if room in ("datasets", "evaluation", "outputs", "simulation") and "pipeline" in rooms:
        wrong.append(f"{where} imports pipeline: only those who drive it may")
    if room != "odometry":
        wrong += [
            f"{where} imports {name}: outside odometry/ nobody knows which method runs"
            for name in sorted(names)
            if room_of(name) == "odometry" and name not in PLUG
        ]
    return wrong


@pytest.mark.parametrize("module", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_arrows_point_towards_core(module: Path) -> None:
    assert violations(module) == []


@pytest.mark.parametrize(
    ("module", "source", "complaint"),
    [
        ("stereo/x.py", "def f():\n    import rclpy", "only nodes/ may speak ROS"),
        ("outputs/x.py", "from sensor_msgs.msg import Image", "only nodes/ may speak ROS"),
        ("core/x.py", "from ..stereo import pairing", "core/ knows no other room"),
        ("core/x.py", f"import {PACKAGE}.pipeline", "core/ knows no other room"),
        (
            "stereo/x.py",
            f"from {PACKAGE}.odometry.interface import Odometry",
            "a stage knows core/",
        ),
        ("evaluation/x.py", f"from {PACKAGE}.cli import main", "lean on the command line"),
        ("pipeline.py", f"from {PACKAGE}.nodes import runtime", "lean on the nodes"),
        ("pipeline.py", f"import {PACKAGE}.odometry.feature_based.method", "which method runs"),
    ],
)
def test_a_wrong_arrow_is_seen(module: str, source: str, complaint: str) -> None:
    found = violations(ROOT / module, source)
    assert len(found) == 1
    assert complaint in found[0]


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("nodes/x.py", "import rclpy\nfrom ..pipeline import Pipeline"),
        ("stereo/x.py", "from ..core import frames\nfrom ..observers import StageTimer"),
        ("pipeline.py", f"from {PACKAGE}.odometry.factory import make_odometry"),
    ],
)
def test_a_right_arrow_is_let_through(module: str, source: str) -> None:
    assert violations(ROOT / module, source) == []


@pytest.mark.parametrize(
    "module",
    [m for m in MODULES if m.name == "__init__.py" or m.relative_to(ROOT).parts[0] == "cli"],
    ids=lambda path: str(path.relative_to(ROOT)),
)
def test_command_line_and_init_load_nothing_heavy(module: Path) -> None:
    loaded = {name.split(".")[0] for name in imports_at_load(module)}
    assert loaded & (HEAVY | ROS) == set()


def test_imports_inside_functions_do_not_count_as_loading() -> None:
    source = "import os\ntry:\n    import cv2\nexcept ImportError:\n    cv2 = None\n"
    source += "def f():\n    import scipy\nif TYPE_CHECKING:\n    import numba\n"
    assert imports_at_load(ROOT / "cli" / "x.py", source) == {"os", "cv2"}


def test_only_gpl_free_code_is_imported() -> None:
    """evo is GPL: the tests may compare with it, the package may not use it."""
    users = [
        module for module in MODULES if any(n.split(".")[0] == "evo" for n in all_imports(module))
    ]
    assert users == []


def test_the_offline_half_runs_without_ros() -> None:
    """Every module but the nodes loads in an interpreter that cannot find any ROS package."""
    names = [
        ".".join(module.relative_to(REPOSITORY).with_suffix("").parts).removesuffix(".__init__")
        for module in MODULES
        if "nodes" not in module.relative_to(ROOT).parts and module.name != "__main__.py"
    ]
    program = f"""
import importlib, sys
class NoRos:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {sorted(ROS)!r}:
            raise ModuleNotFoundError("No module named " + name, name=name)
sys.meta_path.insert(0, NoRos())
for name in {names!r}:
    importlib.import_module(name)
print("loaded", len({names!r}))
"""
    run = subprocess.run(
        [sys.executable, "-c", program],
        cwd=REPOSITORY,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout.split() == ["loaded", str(len(names))]
