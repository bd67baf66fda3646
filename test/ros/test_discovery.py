"""Processes on a crowded host find each other."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

_BODY = """
import sys, time, rclpy
from std_msgs.msg import Empty
from mems6dof_ros.nodes.transport import MESSAGES, use_profile
use_profile(frames=False)
rclpy.init()
node = rclpy.create_node(sys.argv[1])
if sys.argv[1] == "talker":
    node.create_publisher(Empty, "crowd", MESSAGES)
    time.sleep(60)
end = time.monotonic() + 20
while not node.count_publishers("crowd"):
    if time.monotonic() > end:
        sys.exit("no publisher found")
    time.sleep(0.1)
"""


@pytest.fixture
def crowd(domain: int) -> Iterator[None]:
    """As if 40 participants ran in the domain: discovery ports are 7400 + 250 domain + 10 + 2 participant
    (RTPS 2.5, 9.6.2.3)."""
    with ExitStack() as stack:
        for participant in range(40):
            taken = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            taken.bind(("", 7410 + 250 * domain + 2 * participant))
        yield


def test_processes_beyond_the_default_range_find_each_other(crowd: None) -> None:
    talker = subprocess.Popen([sys.executable, "-c", _BODY, "talker"])
    try:
        done = subprocess.run([sys.executable, "-c", _BODY, "listener"], timeout=60, stderr=subprocess.PIPE)
        assert done.returncode == 0, done.stderr.decode()
    finally:
        talker.kill()
        talker.wait()
