"""What colcon and make build."""

from __future__ import annotations

import importlib
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

import mems6dof_ros
from mems6dof_ros.nodes.system import SYSTEMS

ROOT = Path(__file__).resolve().parents[2]
NODES = {
    "frame_source",
    "localizer",
    "pose_estimator",
    "pipeline",
    "recorder",
    "calibrator",
    "controller",
    "monitor",
    "foxglove_bridge",
}


def _package(path: Path) -> ElementTree.Element:
    return ElementTree.parse(path / "package.xml").getroot()


def test_versions_agree() -> None:
    for folder in (ROOT, ROOT / "mems6dof_msgs"):
        assert _package(folder).findtext("version") == mems6dof_ros.__version__
    changelog = (ROOT / "CHANGELOG.rst").read_text()
    assert re.search(rf"^{re.escape(mems6dof_ros.__version__)} \(|^Forthcoming$", changelog, re.MULTILINE)


def test_every_ros_package_in_use_is_declared() -> None:
    declared = {element.text for element in _package(ROOT).iter() if element.tag.endswith("depend")}
    used = set()
    for path in (ROOT / "mems6dof_ros").rglob("*.py"):
        imports = re.findall(r"^\s*(?:from|import) (\w+)", path.read_text(), re.MULTILINE)
        used |= {
            name for name in imports if name.endswith(("_msgs", "_srvs", "_interfaces")) or name == "rclpy"
        }
    assert used <= declared


@pytest.fixture(scope="module")
def install(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both packages, built by colcon over the wheels as in a workspace over /opt/ros."""
    workspace = tmp_path_factory.mktemp("colcon")
    prefix = Path(sys.prefix)
    environment = {
        **os.environ,
        "AMENT_PREFIX_PATH": str(prefix),
        "CMAKE_PREFIX_PATH": str(prefix),
        "PATH": os.pathsep.join([str(prefix / "bin"), os.environ["PATH"]]),
        "COLCON_EXTENSION_BLOCKLIST": "colcon_core.event_handler.desktop_notification",
    }
    command = [
        "colcon", "--log-base", workspace / "log", "build", "--base-paths", ROOT, ROOT / "mems6dof_msgs",
        "--build-base", workspace / "build", "--install-base", workspace / "install",
        "--cmake-args", "-G", "Ninja", "-DBUILD_TESTING=OFF", f"-DPython3_EXECUTABLE={sys.executable}",
        f"-DPYTHON_EXECUTABLE={sys.executable}",
    ]  # fmt: skip
    result = subprocess.run(
        list(map(str, command)), env=environment, capture_output=True, text=True, cwd=workspace, timeout=500
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return workspace / "install"


def test_colcon_installs_what_ros2_run_and_launch_look_for(install: Path) -> None:
    prefix = install / "mems6dof_ros"
    scripts = {path.name for path in (prefix / "lib" / "mems6dof_ros").iterdir()}
    assert scripts == NODES | {"mems6dof"}
    share = prefix / "share" / "mems6dof_ros"
    assert (prefix / "share" / "ament_index" / "resource_index" / "packages" / "mems6dof_ros").is_file()
    assert (share / "package.xml").is_file()
    assert {path.name for path in (share / "launch").iterdir()} == {f"{name}.launch.py" for name in SYSTEMS}
    assert {path.stem for path in (share / "config").glob("*.yaml")} == NODES
    assert (install / "mems6dof_msgs" / "share" / "mems6dof_msgs" / "msg" / "Pose6DOF.msg").is_file()


def test_the_installed_nodes_run(install: Path, tmp_path: Path) -> None:
    """From what colcon installed alone: neither the checkout nor the environment's own messages."""
    scripts = install / "mems6dof_ros" / "lib" / "mems6dof_ros"
    command = (
        f". {install / 'setup.sh'} && exec {scripts / 'localizer'} --ros-args -p calibration:=absent.yaml"
    )
    result = subprocess.run(["sh", "-c", command], capture_output=True, text=True, cwd=tmp_path, timeout=60)
    assert result.returncode == 1
    assert "\nerror: absent.yaml" in result.stderr
    where = "import mems6dof_ros, mems6dof_msgs.msg as m; print(mems6dof_ros.__file__, m.__file__)"
    command = f". {install / 'setup.sh'} && exec {sys.executable} -c '{where}'"
    result = subprocess.run(["sh", "-c", command], capture_output=True, text=True, cwd=tmp_path, timeout=60)
    assert all(path.startswith(str(install)) for path in result.stdout.split()), result


def test_make_installs_where_ros2_looks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`ros2 launch` walks through share/<package> and does not follow linked folders."""
    monkeypatch.syspath_prepend(str(ROOT / "requirements"))
    install = importlib.import_module("install")
    monkeypatch.setattr(install, "VENV", tmp_path)
    monkeypatch.setattr(install, "run", lambda *command: None)
    install.install_package()
    install.install_package()  # again, as after a change of setup.py
    share = tmp_path / "share" / "mems6dof_ros"
    walked = [Path(folder, name) for folder, _, names in os.walk(share) for name in names]
    found = {path.name for path in walked if path.is_file()}
    assert {f"{name}.launch.py" for name in SYSTEMS} < found
    assert {"package.xml", "localizer.yaml", "sample_0.mcap"} < found
    assert {path.name for path in (tmp_path / "lib" / "mems6dof_ros").iterdir()} == NODES


@pytest.mark.parametrize(
    ("variables", "reason"),
    [
        ({"ROS_DISTRO": "jazzy"}, "A ROS environment is sourced (jazzy)"),
        ({"AMENT_PREFIX_PATH": "/opt/ros/jazzy"}, "A ROS environment is sourced"),
    ],
)
def test_make_refuses_to_mix_two_ros_installations(variables: dict[str, str], reason: str) -> None:
    environment = {**os.environ, **variables}
    result = subprocess.run(
        [sys.executable, ROOT / "requirements" / "install.py"],
        env=environment,
        capture_output=True,
        text=True,
    )
    assert result.returncode == 1
    assert reason in result.stderr
    assert "colcon build" in result.stderr
