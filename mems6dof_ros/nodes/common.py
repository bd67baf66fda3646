"""What every node here is: parameters, a queue with its worker, diagnostics, a clean start and end."""

from __future__ import annotations

import ctypes
import functools
import gc
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.publisher import Publisher
from rclpy.signals import SignalHandlerOptions

from mems6dof_ros.allocator import keep_memory
from mems6dof_ros.errors import InputError, Mems6dofError
from mems6dof_ros.nodes import transport
from mems6dof_ros.nodes.health import Health
from mems6dof_ros.nodes.lifecycle import ManagedNode
from mems6dof_ros.nodes.parameters import AUTOSTART, Parameter, declare
from mems6dof_ros.nodes.stream import Stream
from mems6dof_ros.nodes.worker import Worker

#: Environment variable by which the runner, or `launch`, tells a node its process id.
PARENT_VARIABLE = "MEMS6DOF_PARENT"

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
    "Publish nothing before these nodes subscribe to these topics, so that none misses the beginning: a"
    " list of topic:node; or topic:number, so many of whatever name.",
)
#: Fraction of a queue from which it is a concern.
_FULL = 0.8
#: Seconds of waiting for others after which it is a concern.
_PATIENCE = 10.0
#: Seconds between looks whether the node is to end: each costs rclpy some milliseconds.
_LOOK = 0.25


class InstrumentNode(ManagedNode):
    """A managed node with declared parameters, ``values`` by name, ``health``, perhaps a ``worker`` and a
    ``stream`` that feeds it.

    ``finished`` set from any thread ends the process in good order, ``failure`` with its exception.
    """

    def __init__(self, name: str, parameters: Sequence[Parameter]) -> None:
        super().__init__(name)
        self.values = declare(self, (AUTOSTART, *parameters), lambda: self.lifecycle)
        self.health = Health(self)
        self.worker: Worker[Any] | None = None
        self.stream: Stream | None = None
        self.finished = threading.Event()
        self.failure: BaseException | None = None
        self._rehearsal: threading.Thread | None = None
        self._waiting_since = math.inf  # monotonic s; infinite: for nobody
        self.health.watch("readiness", self._waiting_concern)
        self.health.watch("queue", self._queue_concern)

    def entered(self, state: str) -> None:
        self.health.entered(state)
        self.get_logger().info(state)
        if state == "finalized":
            self.finished.set()

    def hindered(self, error: Exception) -> None:
        if isinstance(error, (Mems6dofError, OSError)):
            self.health.refused(f"{self.lifecycle}: {error}")
        else:
            self.failure = error  # a defect

    def deactivate(self) -> None:
        """Finish what is queued; before what else a node does."""
        if self.stream:
            self.stream.ask_to_end()
        if self.worker is not None and (left := self.worker.end()):
            self.health.lost(left, f"{left} messages left in the queue")
        if self.stream:
            self.stream.end()
        self.worker = self.stream = None

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., None], qos_profile: Any, **options: Any
    ) -> Any:
        """As rclpy's, but a message that ``callback`` raises InputError for is refused and counted."""

        @functools.wraps(callback)
        def take(*arguments: Any) -> None:
            try:
                callback(*arguments)
            except InputError as error:
                self.health.refused(f"{topic}: {error}")

        return super().create_subscription(msg_type, topic, take, qos_profile, **options)

    def start_worker(self, work: Callable[[Any], None], capacity: int | None = None) -> Worker[Any]:
        """A worker until the node is deactivated, with the queue that the parameters describe, or of
        ``capacity``."""
        capacity = capacity or self.values["queue_size"]
        self.worker = Worker(work, capacity, self.values["queue_policy"])
        self.health.gauge("queue", lambda: 0 if self.worker is None else len(self.worker))
        return self.worker

    def make_stream(self, tick: Callable[[], None] = lambda: None) -> Stream:
        """A stream until the node is deactivated, to be begun once it is subscribed to something."""

        def failed(error: BaseException) -> None:
            self.failure = error

        self.stream = Stream(self, failed, tick)
        return self.stream

    def _waiting_concern(self) -> str:
        late = self.lifecycle == "active" and time.monotonic() - self._waiting_since > _PATIENCE
        return f"active: {self.health.state}" if late else ""

    def _queue_concern(self) -> str:
        fill = 0.0 if self.worker is None else self.worker.fill
        return f"the queue is {fill:.0%} full" if fill > _FULL else ""

    def when_ready(
        self,
        waiting_for: Callable[[], str],
        act: Callable[[], None],
        rehearse: Callable[[], None] = lambda: None,
    ) -> None:
        """Of ``activate``: call ``act`` in the executor's thread, once ``waiting_for`` returns nothing.

        Nodes subscribe, or begin to publish, only then, so that readiness travels from the end of the chain
        to its beginning and the first message finds everybody listening. ``rehearse`` runs before, in a
        thread: it computes what nobody sees, so that the first message does not wait for the compiler.
        """
        tell_at, interval = 0.0, 5.0
        self._waiting_since = time.monotonic()

        def compile_kernels() -> None:
            try:
                rehearse()
            except BaseException as error:  # handed to the main thread, which ends the node
                self.failure = error

        if self._rehearsal is None:  # once in a process
            self._rehearsal = threading.Thread(target=compile_kernels, name="rehearsal", daemon=True)
            self._rehearsal.start()

        def look() -> None:
            nonlocal tell_at, interval
            assert self._rehearsal is not None
            if missing := "the compiler" if self._rehearsal.is_alive() else waiting_for():
                self.health.state = f"waiting for {missing}"
                if time.monotonic() > tell_at:
                    self.get_logger().info(self.health.state)
                    tell_at, interval = time.monotonic() + interval, 2 * interval
                return
            timer.cancel()
            self._waiting_since = math.inf
            gc.collect()
            gc.freeze()  # what is there by now stays; to look through it again takes 50 ms now and then
            act()

        timer = self.create_timer(0.02, look, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def missing_subscribers(self, publishers: Mapping[str, Publisher]) -> Callable[[], str]:
        """For ``when_ready``: the topics that lack subscribers by the parameter ``wait_for_subscribers``.

        Raises InputError where the parameter is malformed.
        """
        required = required_subscribers(self.values[WAIT_PARAMETER.name], publishers)

        def missing() -> str:
            lacking = []
            for topic, (names, number) in required.items():
                name = publishers[topic].topic_name
                here = {info.node_name for info in self.get_subscriptions_info_by_topic(name)}
                matched = publishers[topic].get_subscription_count()
                if absent := sorted(names - here):
                    lacking.append(f"{topic} ({', '.join(absent)})")
                elif matched < (least := max(number, len(names))):
                    lacking.append(f"{topic} ({matched} of {least})")
            return f"subscribers of {', '.join(lacking)}" if lacking else ""

        return missing

    def tell(self, state: str) -> None:
        """Note and log what the node does."""
        self.health.state = state
        self.get_logger().info(state)

    def check(self) -> None:
        """Raise what ended a thread of this node; called from the main loop."""
        failure = self.failure or (None if self.worker is None else self.worker.failure)
        if failure:
            raise failure

    def end(self, spin: Callable[[float], None]) -> None:
        """Finish what is queued and release everything; ``spin(s)`` lets callbacks run before."""
        if self.lifecycle != "finalized" and self.trigger_shutdown() != TransitionCallbackReturn.SUCCESS:
            self.failure = self.failure or self.trouble


def required_subscribers(entries: Sequence[str], topics: Collection[str]) -> dict[str, tuple[set[str], int]]:
    """``["pose_6dof:recorder", "pose:2"]`` to ``{"pose_6dof": ({"recorder"}, 0), "pose": (set(), 2)}``;
    InputError where an entry is malformed."""
    required: dict[str, tuple[set[str], int]] = {}
    for entry in entries:
        topic, _, who = entry.partition(":")
        if topic not in topics or not who:
            raise InputError(
                f"parameter {WAIT_PARAMETER.name}",
                f"'{entry}'",
                f"topic:node or topic:number, topic one of {', '.join(topics)}",
            )
        names, number = required.get(topic, (set(), 0))
        required[topic] = (names, int(who)) if who.isdigit() else ({*names, who}, number)
    return required


def run(create: Callable[[], InstrumentNode], args: list[str] | None = None, *, frames: bool = False) -> int:
    """Run the node that ``create`` makes until SIGINT, SIGTERM or its own end; returns the exit status.

    0: ended in good order, what was queued finished; a second signal ends at once. 1: refused to start or
    failed, with one line that says why. ``frames``: the node publishes images.
    """
    _die_with_parent()
    keep_memory()
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
        if node.values[AUTOSTART.name]:
            node.bring_up()
        else:
            node.get_logger().info("unconfigured: waiting for a lifecycle manager")
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
    """Be told by SIGTERM when the runner or `launch` that started this process is gone, even by a kill."""
    parent = int(os.environ.pop(PARENT_VARIABLE, 0))
    if not parent or sys.platform != "linux":
        return
    if os.getppid() == parent:
        set_parent_death_signal = 1  # prctl.h
        ctypes.CDLL(None).prctl(set_parent_death_signal, signal.SIGTERM)
    if not Path(f"/proc/{parent}").exists():  # it died before we asked
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
            executor.spin_once(timeout_sec=_LOOK)
            # CPython may overlook a signal that comes while threads hand over the interpreter.
            ctypes.pythonapi.PyErr_CheckSignals()
            node.check()
        node.end(spin)
        node.check()
    finally:
        node.destroy_node()
        executor.shutdown()
