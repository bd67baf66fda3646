"""A stream takes messages beside an executor that has other things to do."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger

from mems6dof_msgs.msg import FrameInfo, Pose6DOF
from mems6dof_ros.nodes.stream import Stream
from mems6dof_ros.nodes.transport import MESSAGES

PATIENCE = 30.0


@pytest.fixture
def node() -> Iterator[Any]:
    context = rclpy.Context()
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("stream_test", context=context)
    yield node
    node.destroy_node()
    context.try_shutdown()


def until(done: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not done():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def unexpected(error: BaseException) -> None:
    raise AssertionError("the stream has failed") from error


def test_messages_arrive_in_order_without_an_executor(node: Any) -> None:
    arrived: list[Any] = []
    stream = Stream(node, unexpected)
    stream.subscribe(FrameInfo, "a", lambda message: arrived.append(message.frame_counter))
    stream.subscribe(Pose6DOF, "b", arrived.append, raw=True)
    publisher = node.create_publisher(FrameInfo, "a", MESSAGES)
    other = node.create_publisher(Pose6DOF, "b", MESSAGES)
    stream.begin()
    until(lambda: publisher.get_subscription_count() == 1 and other.get_subscription_count() == 1)
    for number in range(50):
        publisher.publish(FrameInfo(frame_counter=number))
    until(lambda: len(arrived) == 50)
    assert arrived == list(range(50))
    other.publish(Pose6DOF())
    until(lambda: len(arrived) == 51)
    assert isinstance(arrived[-1], bytes)
    stream.end()
    publisher.publish(FrameInfo(frame_counter=51))
    time.sleep(0.05)
    assert len(arrived) == 51


def test_a_callback_that_blocks_keeps_messages_waiting_and_the_executor_free(node: Any) -> None:
    arrived: list[int] = []
    ticks: list[float] = []
    free = threading.Event()
    stream = Stream(node, unexpected, lambda: ticks.append(time.monotonic()), period=0.02)

    def take(message: FrameInfo) -> None:
        free.wait(PATIENCE)
        arrived.append(message.frame_counter)

    stream.subscribe(FrameInfo, "a", take)
    publisher = node.create_publisher(FrameInfo, "a", MESSAGES)
    node.create_service(Trigger, "ask", lambda request, response: response)
    client = node.create_client(Trigger, "ask")
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    stream.begin()
    until(lambda: publisher.get_subscription_count() == 1 and len(ticks) > 2)
    for number in range(20):
        publisher.publish(FrameInfo(frame_counter=number))
    assert client.wait_for_service(PATIENCE)
    answer = client.call_async(Trigger.Request())
    executor.spin_until_future_complete(answer, PATIENCE)
    assert answer.done()
    assert not arrived
    free.set()
    until(lambda: len(arrived) == 20)
    assert arrived == list(range(20))
    stream.end()
    executor.shutdown()


def test_an_exception_is_handed_over(node: Any) -> None:
    failures: list[BaseException] = []
    stream = Stream(node, failures.append)

    def broken(message: FrameInfo) -> None:
        raise RuntimeError("a defect")

    stream.subscribe(FrameInfo, "a", broken)
    publisher = node.create_publisher(FrameInfo, "a", MESSAGES)
    stream.begin()
    until(lambda: publisher.get_subscription_count() == 1)
    publisher.publish(FrameInfo())
    until(lambda: bool(failures))
    assert "a defect" in str(failures[0])
    stream.end()
