"""ros2 launch mems6dof_ros calibrate.launch.py --show-args"""

from mems6dof_ros.nodes.launching import description
from mems6dof_ros.nodes.system import SYSTEMS


def generate_launch_description():
    return description(SYSTEMS["calibrate"])
