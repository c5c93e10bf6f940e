"""Build of the ament_python package; colcon reads the entry points from here."""

import re
from pathlib import Path

from setuptools import find_packages, setup

NAME = "thermal_stereo_vo"
VERSION = re.search(r'__version__ = "(.+)"', Path(NAME, "__init__.py").read_text()).group(1)

# Modules of thermal_stereo_vo.nodes with a main(); `ros2 run thermal_stereo_vo NAME` starts them.
NODES = [
    "thermal_correction_node",
    "rectification_node",
    "stereo_odometry_node",
    "replay_node",
    "stereo_capture_node",
    "onboard_node",
]


def files(pattern):
    return sorted(str(path) for path in Path().glob(pattern))


setup(
    name=NAME,
    version=VERSION,
    description="Visual odometry for a quadrotor with two long-wave infrared cameras",
    license="Apache-2.0",
    maintainer="thermal_stereo_vo maintainers",
    maintainer_email="maintainers@example.org",
    python_requires=">=3.11",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed", "nodes/fastdds.xml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/config", [*files("config/*.yaml"), f"{NAME}/nodes/fastdds.xml"]),
        (f"share/{NAME}/launch", files("launch/*.launch.py")),
    ],
    zip_safe=False,
    entry_points={
        "console_scripts": [f"{node} = {NAME}.nodes.{node}:main" for node in NODES],
    },
)
