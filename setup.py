"""ament_python package: colcon and pip both read this file."""

import re
from glob import glob
from pathlib import Path

from setuptools import find_packages, setup

NAME = "mems6dof_ros"
VERSION = re.search(r'__version__ = "(.+)"', Path(NAME, "__init__.py").read_text(encoding="utf-8"))[1]

setup(
    name=NAME,
    version=VERSION,
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: [f"**/*.{kind}" for kind in ("html", "xml", "css", "js", "svg", "json", "LICENSE")]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", sorted(glob("launch_scripts/*.launch.py"))),
        (f"share/{NAME}/config", sorted(glob("config/*"))),
        (f"share/{NAME}/bags", sorted(path for path in glob("bags/*") if Path(path).is_file())),
        (f"share/{NAME}/bags/sample", sorted(glob("bags/sample/*"))),
    ],
    install_requires=["setuptools"],  # the rest: package.xml for rosdep, requirements/ for pip
    extras_require={  # camera drivers, see docs/cameras.md (Aravis itself comes from the system); a cluster
        "basler": ["pypylon==26.9"],
        "genicam": ["harvesters==1.4.3", "genicam==1.6.0"],
        "dask": ["distributed==2026.8.0"],  # mems6dof analyze-many on several processes or machines
    },
    python_requires=">=3.10",
    zip_safe=False,
    author="mems6dof developers",
    maintainer="mems6dof developers",
    maintainer_email="maintainers@mems6dof.invalid",
    description="Particle tracking of a microsystem in three dimensions and six degrees of freedom on ROS 2",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "mems6dof = mems6dof_ros.cli.main:main",
            "frame_source = mems6dof_ros.nodes.frame_source:main",
            "localizer = mems6dof_ros.nodes.localizer:main",
            "pose_estimator = mems6dof_ros.nodes.pose_estimator:main",
            "pipeline = mems6dof_ros.nodes.pipeline:main",
            "recorder = mems6dof_ros.nodes.recorder:main",
            "calibrator = mems6dof_ros.nodes.calibrator:main",
            "controller = mems6dof_ros.nodes.controller:main",
            "monitor = mems6dof_ros.nodes.monitor:main",
            "foxglove_bridge = mems6dof_ros.nodes.foxglove_bridge:main",
        ],
    },
)
