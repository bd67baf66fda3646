"""Make `.venv`: the locked requirements, mems6dof_msgs generated into it, and this package.

Standard library only, because it runs before anything is installed. Each step is skipped while the
content it was made from is unchanged.
"""

import hashlib
import os
import platform
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VENV = ROOT / ".venv"
PYTHON = VENV / "bin" / "python"
LOCKS = [ROOT / "requirements" / f"{name}.txt" for name in ("runtime", "ros", "dev")]
PACKAGE = "mems6dof_ros"
# Folder of share/mems6dof_ros to that of the checkout, as in setup.py.
SHARED = {"launch": "launch_scripts", "config": "config", "bags": "bags"}
# What a sourced ROS or another activated wheel environment would push into ours.
FOREIGN = ("AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH", "LD_LIBRARY_PATH", "PYTHONPATH", "PYTHONHOME")


def main() -> None:
    refuse_sourced_ros()
    environment = digest([*LOCKS, Path(__file__)], sys.version)
    step("environment", environment, install_requirements)
    step("messages", digest(files("mems6dof_msgs"), environment), build_messages)
    described = [ROOT / name for name in ("setup.py", "setup.cfg", "pyproject.toml")]
    shared = sorted(str(path) for folder in SHARED.values() for path in files(folder))
    step("package", digest(described, environment, str(ROOT), *shared), install_package)


def refuse_sourced_ros() -> None:
    distribution = os.environ.get("ROS_DISTRO")
    if distribution or "/opt/ros/" in os.environ.get("AMENT_PREFIX_PATH", ""):
        stop(
            f"A ROS environment is sourced ({distribution or 'AMENT_PREFIX_PATH'}), and two ROS installations"
            " do not mix. Either open a shell without it and run make again, or build here with\n"
            "  rosdep install --from-paths . --ignore-src -y\n"
            "  colcon build --base-paths . mems6dof_msgs && source install/setup.bash\n"
            "  ros2 launch mems6dof_ros demo.launch.py"
        )


def check_machine() -> None:
    if not (3, 10) <= sys.version_info[:2] <= (3, 13):
        stop(
            f"Python {platform.python_version()} is not supported: 3.10 to 3.13 (make PYTHON=python3.12 ...)"
        )
    if (sys.platform, platform.machine()) != ("linux", "x86_64"):
        stop(
            f"{sys.platform} {platform.machine()} is not supported by the ROS 2 wheels (x86-64 Linux only):"
            " install ROS 2 Jazzy and build with colcon, see docs/install.md"
        )
    if not shutil.which("g++"):
        stop("g++ is missing: install it (Debian and Ubuntu: apt install g++)")
    if not Path(sysconfig.get_paths()["include"], "Python.h").exists():
        stop("The headers of Python are missing (Debian and Ubuntu: apt install python3-dev)")
    try:
        import ensurepip  # noqa: F401
        import venv  # noqa: F401
    except ImportError:
        stop("The module venv is missing: install it (Debian and Ubuntu: apt install python3-venv)")


def install_requirements() -> None:
    check_machine()
    say("installing the locked requirements into .venv (once; one to five minutes)")
    run(sys.executable, "-m", "venv", *([] if same_python() else ["--clear"]), VENV)
    requirements = [argument for lock in LOCKS for argument in ("-r", lock)]
    run(PYTHON, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *requirements)


def same_python() -> bool:
    """True when .venv, if it works at all, was made from the Python that runs this."""
    try:
        found = subprocess.run(
            [PYTHON, "-c", "import sys; print(sys.version)"], capture_output=True, text=True
        )
    except OSError:
        return False
    return found.stdout.strip() == sys.version.strip()


def build_messages() -> None:
    say("generating mems6dof_msgs (once; half a minute)")
    build = VENV / "build" / "mems6dof_msgs"
    shutil.rmtree(build, ignore_errors=True)
    run(
        VENV / "bin" / "cmake", "-S", ROOT / "mems6dof_msgs", "-B", build, "-G", "Ninja", "-Wno-dev",
        f"-DCMAKE_MAKE_PROGRAM={VENV / 'bin' / 'ninja'}", f"-DCMAKE_INSTALL_PREFIX={VENV}",
        "-DCMAKE_BUILD_TYPE=Release", "-DBUILD_TESTING=OFF",
        f"-DPython3_EXECUTABLE={PYTHON}", f"-DPYTHON_EXECUTABLE={PYTHON}",
    )  # fmt: skip
    run(VENV / "bin" / "cmake", "--build", build, "--target", "install")


def install_package() -> None:
    pip = (PYTHON, "-m", "pip", "install", "--quiet", "--disable-pip-version-check")
    run(*pip, "--no-deps", "--no-build-isolation", "--editable", ROOT)
    # An editable install leaves out data files, and puts scripts into bin/ only, while `ros2 run`,
    # launch and the ament index look in lib/<package>/ and share/.
    share = VENV / "share"
    link(share / "ament_index" / "resource_index" / "packages" / PACKAGE, ROOT / "resource" / PACKAGE)
    shutil.rmtree(share / PACKAGE, ignore_errors=True)
    link(share / PACKAGE / "package.xml", ROOT / "package.xml")
    for name, folder in SHARED.items():
        for path in files(folder):  # file by file: ros2 launch does not look into linked folders
            link(share / PACKAGE / name / path.relative_to(ROOT / folder), path)
    for name in re.findall(r'"(\w+) = mems6dof_ros\.nodes\.', (ROOT / "setup.py").read_text()):
        link(VENV / "lib" / PACKAGE / name, VENV / "bin" / name)


def link(place: Path, target: Path) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    if place.is_symlink():
        place.unlink()
    place.symlink_to(target)


def step(name: str, content: str, work) -> None:
    stamp = VENV / f"{name}.stamp"
    if not stamp.exists() or stamp.read_text() != content:
        stamp.unlink(missing_ok=True)
        work()
        stamp.write_text(content)


def digest(paths, *extra: str) -> str:
    content = hashlib.sha256("\n".join(extra).encode())
    for path in sorted(paths):
        content.update(str(path.relative_to(ROOT)).encode() + b"\0" + path.read_bytes())
    return content.hexdigest()


def files(folder: str):
    return [path for path in (ROOT / folder).rglob("*") if path.is_file() and "__pycache__" not in path.parts]


def run(*command) -> None:
    """Run quietly; on failure show the end of what it said and stop."""
    environment = {name: value for name, value in os.environ.items() if name not in FOREIGN}
    environment.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)
    environment.update(AMENT_PREFIX_PATH=str(VENV), CMAKE_PREFIX_PATH=str(VENV))
    environment["PATH"] = os.pathsep.join([str(VENV / "bin"), environment.get("PATH", os.defpath)])
    command = [str(part) for part in command]
    result = subprocess.run(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=environment,
        stdin=subprocess.DEVNULL,
    )
    if result.returncode:
        print(result.stdout[-4000:], file=sys.stderr)
        stop(f"failed: {' '.join(command)[:200]}")


def say(text: str) -> None:
    print(f"mems6dof: {text}", flush=True)


def stop(text: str) -> None:
    sys.exit(f"mems6dof: {text}")


if __name__ == "__main__":
    main()
