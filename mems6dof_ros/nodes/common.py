"""What every node here is made of: a bounded queue with a worker, diagnostics, a clean start and end."""

from __future__ import annotations

import ctypes
import os
import signal
import statistics
import sys
import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable, Collection, Mapping, Sequence
from types import FrameType
from typing import Any, Generic, Literal, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.signals import SignalHandlerOptions

from mems6dof_ros.errors import InputError, Mems6dofError
from mems6dof_ros.nodes import transport
from mems6dof_ros.nodes.parameters import Parameter, declare

Item = TypeVar("Item")

#: Environment variable by which the runner tells a node its process id.
PARENT_VARIABLE = "MEMS6DOF_PARENT"

#: Seconds that the end of a node may take: for what is queued, then for what readers have not yet taken.
DRAIN_TIMEOUT = 3.0

QUEUE_PARAMETERS = (
    Parameter("queue_size", 16, "Messages that wait for the computation.", "messages", (1, 100_000)),
    Parameter(
        "queue_policy",
        "block",
        "What to do when the queue is full: block loses nothing while the publisher waits too, drop_oldest"
        " keeps up with a publisher that does not.",
        choices=("block", "drop_oldest"),
    ),
)
WAIT_PARAMETER = Parameter(
    "wait_for_subscribers",
    (),
    "Publish nothing before each of these topics has so many subscribers, so that nobody misses the"
    " beginning: a list of topic:number.",
)


class Worker(Generic[Item]):
    """A thread that takes items out of a bounded queue and calls ``work`` with each.

    Callbacks only ``put``. ``policy`` when ``capacity`` items wait: ``block`` until there is room, or
    ``drop_oldest`` and count it in ``dropped``. An exception of ``work`` ends the thread and is kept
    in ``failure``.
    """

    def __init__(
        self,
        work: Callable[[Item], None],
        capacity: int,
        policy: Literal["block", "drop_oldest"] = "block",
    ) -> None:
        self.dropped = 0
        self.failure: BaseException | None = None
        self._work, self._capacity, self._policy = work, capacity, policy
        self._items: deque[Item] = deque()
        self._changed = threading.Condition()
        self._busy = self._ending = False
        self._thread = threading.Thread(target=self._run, name="worker", daemon=True)
        self._thread.start()

    def __len__(self) -> int:
        return len(self._items)

    def put(self, item: Item) -> None:
        """Append ``item``, see ``policy``; ignored once the worker has ended."""
        with self._changed:
            if self._policy == "drop_oldest" and len(self._items) >= self._capacity:
                self._items.popleft()
                self.dropped += 1
            while len(self._items) >= self._capacity and not self._ending:
                self._changed.wait()
            if not self._ending:
                self._items.append(item)
                self._changed.notify_all()

    def end(self, timeout: float = DRAIN_TIMEOUT) -> int:
        """Let the worker finish what is queued, for ``timeout`` s at most; returns how many items it left."""
        with self._changed:
            self._changed.wait_for(lambda: self._ending or not (self._items or self._busy), timeout)
            left = len(self._items) + self._busy
            self._ending = True
            self._items.clear()
            self._changed.notify_all()
        self._thread.join(timeout=1.0)
        return left

    def _run(self) -> None:
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._items or self._ending)
                    if self._ending:
                        return
                    item = self._items.popleft()
                    self._busy = True
                    self._changed.notify_all()
                self._work(item)
                with self._changed:
                    self._busy = False
                    self._changed.notify_all()
        except BaseException as error:  # handed to the main thread, which ends the node
            with self._changed:
                self.failure = error
                self._ending, self._busy = True, False
                self._changed.notify_all()


class Health:
    """Counts and times of a node, published on /diagnostics once per second; safe for any thread.

    The level is WARN while something was lost, ERROR while something was refused, in the last second.
    """

    PERIOD = 1.0  # s
    MOST_LINES = 10  # that are logged of the problems of one period

    def __init__(self, node: Node, hardware_id: str = "") -> None:
        self.state = "starting"
        self._node, self._hardware_id = node, hardware_id
        self._lock = threading.Lock()
        self._totals: dict[str, int] = defaultdict(int)
        self._reported: dict[str, int] = {}
        self._times: dict[str, list[float]] = defaultdict(list)
        self._values: dict[str, str] = {}
        self._problems: list[tuple[bytes, str]] = []
        self._gauges: dict[str, Callable[[], Any]] = {}
        self._since = time.monotonic()
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", transport.MESSAGES)
        # Wall time: with use_sim_time and no clock, diagnostics must still say so.
        node.create_timer(self.PERIOD, self.publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def count(self, what: str, number: int = 1) -> None:
        """Add to a total, reported with its rate."""
        with self._lock:
            self._totals[what] += number

    def total(self, what: str) -> int:
        """A total so far."""
        with self._lock:
            return self._totals[what]

    def time(self, what: str, seconds: float) -> None:
        """Add a duration in s, reported as median and maximum of the period in ms."""
        with self._lock:
            self._times[what].append(seconds)

    def set(self, what: str, value: Any) -> None:
        """Note the latest value of something."""
        with self._lock:
            self._values[what] = str(value)

    def gauge(self, what: str, read: Callable[[], Any]) -> None:
        """Have ``read`` called for every report."""
        self._gauges[what] = read

    def lost(self, number: int, why: str) -> None:
        """Something was lost: count it and warn."""
        self._problem(DiagnosticStatus.WARN, "lost", number, why)

    def refused(self, why: str) -> None:
        """Input that could not be used: count it and report an error."""
        self._problem(DiagnosticStatus.ERROR, "refused", 1, why)

    def _problem(self, level: bytes, what: str, number: int, why: str) -> None:
        with self._lock:
            self._totals[what] += number
            self._problems.append((level, why))
            if len(self._problems) > self.MOST_LINES:
                return
        log = self._node.get_logger()
        if level == DiagnosticStatus.ERROR:
            log.error(why)
        else:
            log.warning(why)

    def publish(self) -> None:
        """Publish the report of the time since the last one."""
        now = time.monotonic()
        with self._lock:
            span, self._since = now - self._since, now
            values = {what: str(total) for what, total in self._totals.items()}
            for what, total in self._totals.items():
                values[f"{what}, 1/s"] = f"{(total - self._reported.get(what, 0)) / span:.1f}"
            self._reported = dict(self._totals)
            for what, times in self._times.items():
                if times:
                    values[f"{what}, ms, median"] = f"{statistics.median(times) * 1e3:.2f}"
                    values[f"{what}, ms, max"] = f"{max(times) * 1e3:.2f}"
                times.clear()
            values.update(self._values)
            problems, self._problems = self._problems, []
        if (more := len(problems) - self.MOST_LINES) > 0:
            self._node.get_logger().warning(f"and {more} more problems in the last second")
        values.update({what: str(read()) for what, read in self._gauges.items()})
        level, message = max(problems, default=(DiagnosticStatus.OK, self.state), key=lambda p: p[0])
        status = DiagnosticStatus(
            level=level,
            name=self._node.get_fully_qualified_name().lstrip("/"),
            message=message,
            hardware_id=self._hardware_id,
            values=[KeyValue(key=key, value=value) for key, value in sorted(values.items())],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)


class InstrumentNode(Node):
    """A node with declared parameters, ``values`` by name, ``health``, and perhaps a ``worker``.

    ``finished`` set from any thread ends the process in good order, ``failure`` with its exception.
    """

    def __init__(self, name: str, parameters: Sequence[Parameter]) -> None:
        super().__init__(name)
        self.values = declare(self, parameters)
        self.health = Health(self)
        self.worker: Worker[Any] | None = None
        self.finished = threading.Event()
        self.failure: BaseException | None = None

    def start_worker(self, work: Callable[[Any], None]) -> Worker[Any]:
        """The node's worker, with the queue that the parameters describe."""
        self.worker = Worker(work, self.values["queue_size"], self.values["queue_policy"])
        self.health.gauge("queue", self.worker.__len__)
        return self.worker

    def when_ready(self, waiting_for: Callable[[], str], act: Callable[[], None]) -> None:
        """Call ``act`` in the executor's thread, once ``waiting_for`` returns nothing to wait for.

        Nodes subscribe, or begin to publish, only then, so that readiness travels from the end of the chain
        to its beginning and the first message finds everybody listening.
        """
        told = -float("inf")

        def look() -> None:
            nonlocal told
            if missing := waiting_for():
                self.health.state = f"waiting for {missing}"
                if time.monotonic() - told > 5.0:
                    told = time.monotonic()
                    self.get_logger().info(self.health.state)
                return
            timer.cancel()
            act()

        timer = self.create_timer(0.02, look, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def missing_subscribers(self, publishers: Mapping[str, Publisher]) -> Callable[[], str]:
        """For ``when_ready``: the topics that lack subscribers by the parameter ``wait_for_subscribers``.

        Raises InputError where the parameter is malformed.
        """
        required = required_subscribers(self.values[WAIT_PARAMETER.name], publishers)

        def missing() -> str:
            counts = {topic: publishers[topic].get_subscription_count() for topic in required}
            lacking = [
                f"{topic} ({counts[topic]} of {number})"
                for topic, number in required.items()
                if counts[topic] < number
            ]
            return f"subscribers of {', '.join(lacking)}" if lacking else ""

        return missing

    def tell(self, state: str) -> None:
        """Note and log the state of the node."""
        self.health.state = state
        self.get_logger().info(state)

    def check(self) -> None:
        """Raise what ended a thread of this node; called from the main loop."""
        failure = self.failure or (self.worker.failure if self.worker else None)
        if failure:
            raise failure

    def end(self, spin: Callable[[float], None]) -> None:
        """Finish what is queued and release everything; ``spin(s)`` lets callbacks run meanwhile."""
        if self.worker and (left := self.worker.end()):
            self.get_logger().warning(f"{left} messages left in the queue")


def required_subscribers(entries: Sequence[str], topics: Collection[str]) -> dict[str, int]:
    """``["pose_6dof:2"]`` to ``{"pose_6dof": 2}``; InputError where an entry is malformed."""
    required = {}
    for entry in entries:
        topic, _, number = entry.partition(":")
        if topic not in topics or not number.isdigit():
            raise InputError(
                f"parameter {WAIT_PARAMETER.name}",
                f"'{entry}'",
                f"topic:number, topic one of {', '.join(topics)}",
            )
        required[topic] = int(number)
    return required


def run(create: Callable[[], InstrumentNode], args: list[str] | None = None, *, frames: bool = False) -> int:
    """Run the node that ``create`` makes until SIGINT, SIGTERM or its own end; returns the exit status.

    0: ended in good order, what was queued finished; a second signal ends at once. 1: refused to start or
    failed, with one line that says why. ``frames``: the node publishes images.
    """
    _die_with_parent()
    stop = threading.Event()

    def on_signal(number: int, frame: FrameType | None) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    # Our own handlers: rclpy's invalidate the context at once, and what is queued could not be published.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_signal)
    try:
        warning = transport.use_profile(frames=frames)
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        node = create()
        if warning:
            node.get_logger().warning(warning)
        _spin(node, stop)
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except Mems6dofError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except RuntimeError as error:  # rclpy's own, of a malformed command line or parameter file
        if type(error).__module__.partition(".")[0] not in ("rclpy", "_rclpy_pybind11"):
            raise
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    finally:
        rclpy.try_shutdown()
    return 0


def _die_with_parent() -> None:
    """Be told by SIGTERM when the runner that started this process is gone, even when it was killed."""
    parent = os.environ.pop(PARENT_VARIABLE, None)
    if parent and sys.platform == "linux":
        set_parent_death_signal = 1  # prctl.h
        ctypes.CDLL(None).prctl(set_parent_death_signal, signal.SIGTERM)
        if os.getppid() != int(parent):  # it died before we asked
            sys.exit(1)


def _spin(node: InstrumentNode, stop: threading.Event) -> None:
    executor: Executor = SingleThreadedExecutor()
    executor.add_node(node)

    def spin(seconds: float) -> None:
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0:
            executor.spin_once(timeout_sec=left)

    try:
        while rclpy.ok() and not stop.is_set() and not node.finished.is_set():
            executor.spin_once(timeout_sec=0.1)
            node.check()
        node.end(spin)
        node.check()
    finally:
        node.destroy_node()
        executor.shutdown()
