"""``calibrator``: scans beads through focus and calibrates the optics, as an action.

Action (relative): ``calibrate`` (mems6dof_msgs/Calibrate), one goal at a time. While it scans, the node
subscribes to ``image_raw`` and, where somebody publishes it, ``frame_info``, and moves the stage by the
service ``move_stage`` (mems6dof_msgs/MoveStage), see ``nodes.stage``. Afterwards the stage stands in the
middle of the scan. A goal that is cancelled or fails writes nothing.
"""

from __future__ import annotations

import contextlib
import math
import queue
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.clock import Clock, ClockType
from rclpy.task import Future
from sensor_msgs.msg import Image

from mems6dof_msgs.action import Calibrate
from mems6dof_msgs.msg import FrameInfo
from mems6dof_msgs.srv import MoveStage
from mems6dof_ros.calibration.calibrate import CalibrationResult, CalibrationSettings, calibrate
from mems6dof_ros.calibration.file import save_calibration
from mems6dof_ros.calibration.focus_stack import DEFAULT_WINDOW_PX, FocusStack, measure_stack
from mems6dof_ros.calibration.report import write_report
from mems6dof_ros.errors import InputError, Mems6dofError
from mems6dof_ros.frame import NAN, Frame
from mems6dof_ros.localization.camera import CameraNoise
from mems6dof_ros.localization.fitting import DEFAULT_WEIGHTING, WEIGHTINGS
from mems6dof_ros.nodes import transport
from mems6dof_ros.nodes.common import InstrumentNode, run
from mems6dof_ros.nodes.frame_matcher import FrameMatcher
from mems6dof_ros.nodes.localizer import CAMERA_NOISE
from mems6dof_ros.nodes.parameters import Parameter
from mems6dof_ros.nodes.stage import MOVE_STAGE
from mems6dof_ros.nodes.worker import DRAIN_TIMEOUT
from mems6dof_ros.recording import messages, topics
from mems6dof_ros.recording.frames import write_bag
from mems6dof_ros.sources.source import frames, open_recording
from mems6dof_ros.sources.stage import FocusScan, Standing, scan

#: Name of the action.
CALIBRATE = "calibrate"

PARAMETERS = (
    *(
        Parameter(f"camera.{name}", NAN, f"{doc}.", unit, optional=True)
        for name, (unit, doc) in CAMERA_NOISE.items()
    ),
    Parameter("pixel_size", NAN, "Pixel size in object space where frames do not tell.", "m", optional=True),
    Parameter(
        "wavelength",
        NAN,
        "Of the emission: with bead_diameter, and the aperture in the goal, method psf is calibrated too.",
        "m",
        optional=True,
    ),
    Parameter("bead_diameter", NAN, "Of the beads.", "m", optional=True),
    Parameter("window_px", DEFAULT_WINDOW_PX, "Odd side of the fitted window.", "px", (5, 255)),
    Parameter("weighting", DEFAULT_WEIGHTING, "Weights of the fit.", choices=tuple(WEIGHTINGS)),
    Parameter("stage_timeout", 30.0, "Longest that the stage may take to a position.", "s", (0.1, 3600.0)),
    Parameter("frame_timeout", 10.0, "Longest that a frame may take to come.", "s", (0.1, 3600.0)),
)


class Cancelled(Exception):
    """The goal was cancelled, or the node ends."""


class CalibratorNode(InstrumentNode):
    """The action server; each goal has a thread of its own."""

    def __init__(self) -> None:
        super().__init__("calibrator", PARAMETERS)

    def configure(self) -> None:
        given = {name: self.values[f"camera.{name}"] for name in CAMERA_NOISE}
        if missing := [name for name, value in given.items() if math.isnan(value)]:
            raise InputError(f"parameter camera.{missing[0]}", "no value", "what the data sheet says")
        self._camera = CameraNoise(**given)

    def activate(self) -> None:
        self._busy = threading.Lock()
        self._ending = threading.Event()
        self._stage = self.create_client(MoveStage, MOVE_STAGE)
        self._server = ActionServer(
            self,
            Calibrate,
            CALIBRATE,
            self._execute,
            goal_callback=self._on_goal,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
            feedback_pub_qos_profile=transport.MESSAGES,  # planes are fitted faster than they are heard of
        )
        self.tell("ready")

    def deactivate(self) -> None:
        self._ending.set()
        self._busy.acquire(timeout=DRAIN_TIMEOUT)  # a goal that is not wanted any more ends within a plane
        self._server.destroy()
        super().deactivate()

    def _on_goal(self, goal: Calibrate.Goal) -> GoalResponse:
        if not self._busy.acquire(blocking=False):
            self.health.refused("a goal while another one is being calibrated")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    async def _execute(self, handle: ServerGoalHandle) -> Calibrate.Result:
        """In the executor's thread, which goes on with other callbacks while it waits."""
        camera_frames = _CameraFrames(self)
        done: Future = Future(executor=self.executor)
        goal = _Goal(handle, camera_frames, self._move, self._ending, self._camera, self.values)

        def work() -> None:
            try:
                result = goal.reach()
            except BaseException as error:
                done.set_exception(error)
            else:
                done.set_result(result)
            finally:
                self._busy.release()

        threading.Thread(target=work, name="calibration", daemon=True).start()
        self.tell("calibrating")
        try:
            result = await done
            handle.succeed()
            self.health.count("calibrations")
        except Cancelled as error:
            result = Calibrate.Result(message=str(error))
            if handle.is_cancel_requested:
                handle.canceled()
            else:
                handle.abort()
        except Mems6dofError as error:
            result = Calibrate.Result(message=str(error))
            self.health.refused(str(error))
            handle.abort()
        finally:
            camera_frames.close()
        self.tell("ready")
        self.get_logger().info(result.message)
        return result

    def _move(self, z: float, check: Callable[[], None]) -> Standing:
        """In the thread of a goal: move the stage; raises Mems6dofError where it does not get there."""
        deadline = time.monotonic() + self.values["stage_timeout"]
        where = self._stage.srv_name
        while not self._stage.service_is_ready():
            check()
            if time.monotonic() > deadline:
                raise Mems6dofError(f"{where}: found nobody; expected a stage that offers this service")
            time.sleep(0.02)
        answered = threading.Event()
        future = self._stage.call_async(MoveStage.Request(z=z))
        future.add_done_callback(lambda _: answered.set())
        while not answered.wait(0.05):
            check()
            if time.monotonic() > deadline:
                found = f"no answer within {self.values['stage_timeout']:g} s"
                raise Mems6dofError(f"{where}: found {found}; expected the stage at {z * 1e6:.3f} um")
        answer = future.result()
        if not answer.success:
            raise Mems6dofError(f"{where}: the stage does not move to {z * 1e6:.3f} um: {answer.message}")
        return Standing(answer.z, messages.nanoseconds(answer.settled))


class _CameraFrames:
    """Frames of the camera from now on until ``close``; ``next`` waits for one in another thread."""

    def __init__(self, node: InstrumentNode) -> None:
        self._node = node
        self._matcher = FrameMatcher()
        self._frames: queue.Queue[Any] = queue.Queue(maxsize=4)
        self._ours = [
            node.create_subscription(FrameInfo, topics.FRAME_INFO, self._on_info, transport.MESSAGES),
            node.create_subscription(
                Image, topics.IMAGE, self._on_image, transport.for_images(node, topics.IMAGE)
            ),
        ]
        self._timer = node.create_timer(0.1, self._on_tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def close(self) -> None:
        """Subscribe no longer."""
        for subscription in self._ours:
            self._node.destroy_subscription(subscription)
        self._node.destroy_timer(self._timer)

    def next(self, timeout: float, check: Callable[[], None]) -> Frame:
        """The next frame; Mems6dofError where none comes within ``timeout`` s, and what ``check`` raises."""
        deadline = time.monotonic() + timeout
        while True:
            check()
            try:
                arrived = self._frames.get(timeout=0.05)
            except queue.Empty:
                if time.monotonic() > deadline:
                    raise Mems6dofError(
                        f"{topics.IMAGE}: found no frame within {timeout:g} s; expected a camera that runs"
                    ) from None
                continue
            return messages.to_frame(arrived.image, arrived.info)

    def _on_info(self, info: FrameInfo) -> None:
        self._matcher.add_info(messages.nanoseconds(info.header.stamp), info)
        self._forward()

    def _on_image(self, image: Image) -> None:
        self._matcher.add_image(messages.nanoseconds(image.header.stamp), image, time.time_ns())
        self._forward()

    def _on_tick(self) -> None:
        self._matcher.tick()
        self._forward()

    def _forward(self) -> None:
        expected = self._matcher.informed or self._node.count_publishers(topics.FRAME_INFO) > 0
        for arrived in self._matcher.take(expected):
            if self._frames.full():  # nobody waits for them while the stage moves
                self._frames.get_nowait()
            self._frames.put_nowait(arrived)


class _Goal:
    """One goal, reached in a thread of its own."""

    def __init__(
        self,
        handle: ServerGoalHandle,
        camera_frames: _CameraFrames,
        move: Callable[[float, Callable[[], None]], Standing],
        ending: threading.Event,
        camera: CameraNoise,
        values: dict[str, Any],
    ) -> None:
        self._handle, self._frames, self._move = handle, camera_frames, move
        self._ending, self._camera, self._values = ending, camera, values
        self._asked: Calibrate.Goal = handle.request
        self._stage_z = NAN

    def reach(self) -> Calibrate.Result:
        """Scan, calibrate, write; raises Cancelled, and Mems6dofError where it cannot be done."""
        asked = self._asked
        output = _new_file(asked.output)
        plan = FocusScan(asked.start, asked.stop, asked.step, asked.frames_per_plane)
        if asked.rotations and len(asked.rotations) != len(asked.earlier_stacks) + 1:
            expected = f"one of each of {len(asked.earlier_stacks)} earlier stacks and of this scan"
            raise InputError("rotations", f"{len(asked.rotations)} values", expected)
        stacks = [
            self._measured(frames(open_recording(Path(path))), Path(path).name)
            for path in asked.earlier_stacks
        ]
        planes = self._scanned(plan)
        stacks.append(self._measured(planes, "focus scan"))
        settings = CalibrationSettings(
            axial_range=asked.axial_range or None,
            numerical_aperture=asked.numerical_aperture or None,
            wavelength=self._known("wavelength"),
            bead_diameter=self._known("bead_diameter"),
            rotations=tuple(asked.rotations) or None,
        )
        self._tell("modelling", 0, 0)
        result = calibrate(stacks, settings, lambda _: self.check())
        report = output.with_suffix(".html")
        self._write(result, output, report, planes)
        calibration = result.calibration
        return Calibrate.Result(
            message=f"{output}: calibration {calibration.calibration_id} of {len(result.beads)} beads",
            calibration_id=calibration.calibration_id,
            method=calibration.method,
            beads=len(result.beads),
            beads_rejected=len(result.rejected),
            warnings=list(result.warnings),
            report=str(report),
        )

    def _known(self, name: str) -> float | None:
        value = self._values[name]
        return None if math.isnan(value) else float(value)

    def check(self) -> None:
        """Raise Cancelled where the goal is no longer wanted."""
        if self._handle.is_cancel_requested:
            raise Cancelled("cancelled: nothing was written")
        if self._ending.is_set():
            raise Cancelled("the calibrator was stopped: nothing was written")

    def _tell(self, phase: str, plane: int, planes: int) -> None:
        self.check()
        self._handle.publish_feedback(
            Calibrate.Feedback(phase=phase, plane=plane, planes=planes, stage_z=self._stage_z)
        )

    def _scanned(self, plan: FocusScan) -> list[Frame]:
        def tell(done: int, total: int, z: float) -> None:
            self._stage_z = z
            self._tell("scanning", done, total)

        def next_frame() -> Frame:
            frame = self._frames.next(self._values["frame_timeout"], self.check)
            return frame if frame.pixel_size > 0 else replace(frame, pixel_size=self._values["pixel_size"])

        try:
            return list(scan(plan, lambda z: self._move(z, self.check), next_frame, tell))
        finally:
            if not self._ending.is_set():
                with contextlib.suppress(Mems6dofError):  # what happened in the scan matters more
                    self._move((plan.start + plan.stop) / 2, lambda: None)

    def _measured(self, planes: Iterable[Frame], description: str) -> FocusStack:
        return measure_stack(
            planes,
            self._camera,
            self._values["weighting"],
            self._values["window_px"],
            description,
            lambda done, total: self._tell("fitting", done, total),
        )

    def _write(self, result: CalibrationResult, output: Path, report: Path, planes: Sequence[Frame]) -> None:
        """Everything or nothing."""
        kept = Path(self._asked.stack_output) if self._asked.stack_output else None
        written: list[Path] = []
        try:
            if kept is not None:
                written.append(_new_directory(kept))
                made_by = {"made_by": "mems6dof calibrator"}
                write_bag(kept, planes, self._camera, made_by, lambda _: self.check())
            self.check()
            unfinished = report.with_suffix(".part")
            written.append(unfinished)
            write_report(result, unfinished)
            save_calibration(result.calibration, output)
            unfinished.replace(report)
        except BaseException:
            for path in written:
                if path.is_dir():
                    shutil.rmtree(path)
                else:
                    path.unlink(missing_ok=True)
            raise


def _new_file(name: str) -> Path:
    path = Path(name)
    if not name or not path.parent.is_dir() or path.is_dir():
        raise InputError("goal output", repr(name), "a file in a directory that exists")
    return path


def _new_directory(path: Path) -> Path:
    if path.exists():
        raise InputError("goal stack_output", f"{path} exists", "a new directory")
    return path


def main(args: list[str] | None = None) -> int:
    """Run the node; returns the exit status."""
    return run(CalibratorNode, args)


if __name__ == "__main__":
    sys.exit(main())
