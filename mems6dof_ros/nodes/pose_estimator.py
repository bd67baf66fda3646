"""``pose_estimator``: particles to the poses of one or more rigid bodies, once per motion cycle.

Subscribes to ``localizations``; publishes ``pose_6dof`` for every one of them, and ``pose`` and
``pose_with_covariance`` while the pose is valid, all with the header of the frame. Each body after the first
has these topics below its own name, and there ``relative_pose`` (PoseWithCovarianceStamped): its pose in the
body frame of the first, whose name is the frame_id. Services (std_srvs/Trigger), for all bodies: ``~/reset``,
``~/set_reference``, ``~/save_field_correction``.
"""

from __future__ import annotations

import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from std_srvs.srv import Trigger

from mems6dof_msgs.msg import Localizations as LocalizationsMessage
from mems6dof_ros.analysis.field_calibration import with_field_error
from mems6dof_ros.calibration.file import Calibration, load_calibration, save_calibration
from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import NAN
from mems6dof_ros.localization.localizations import Localizations
from mems6dof_ros.nodes import transport
from mems6dof_ros.nodes.common import QUEUE_PARAMETERS, WAIT_PARAMETER, InstrumentNode, run
from mems6dof_ros.nodes.frame_order import Arrival, CycleCount, FrameOrder
from mems6dof_ros.nodes.parameters import Parameter, of_settings, to_settings
from mems6dof_ros.nodes.sim_time import on_jump_back
from mems6dof_ros.pose.bodies import Bodies
from mems6dof_ros.pose.bodies_file import load_bodies
from mems6dof_ros.pose.cycle_pose import CyclePose
from mems6dof_ros.pose.estimator import PoseEstimator
from mems6dof_ros.pose.field import FieldError
from mems6dof_ros.pose.settings import PoseSettings
from mems6dof_ros.pose.synthetic import Scene, SyntheticGear
from mems6dof_ros.recording import messages, topics
from mems6dof_ros.recording.poses import pose_messages, pose_topics

_SETTINGS = {
    "reference": (
        "",
        "What a frame is registered to: map, the constellation map refined as cycles arrive, or previous, the"
        " micrograph before, as the paper does, whose errors add up.",
    ),
    "gates": ("m", "Annealed gates of the iterative closest point, descending."),
    "min_particles": ("particles", "Fewer matched particles give no pose."),
    "confirm_after": ("cycles", "Sightings of a newcomer before it joins the map."),
    "retire_after": ("cycles", "Misses in a row, where it should be seen, before a particle leaves the map."),
    "overlap": ("m", "Particles closer than this count less until their residuals prove them good."),
    "gate_xy": ("1", "Standard deviations in x and y beyond which a particle is left out."),
    "gate_z": ("1", "Standard deviations in z beyond which the z of a particle is left out."),
    "max_displacement": ("m", "Farther from its centre of rotation no body moves: the pose is lost."),
    "max_tilt": ("rad", "Likewise for the tilt."),
    "max_centre_distance": ("m", "The centre of rotation lies within this of the field's centre."),
    "max_false_alarms": ("1", "Matches this good that chance gives, log10: the proof against a wrong pose."),
    "field_size": ("m", "Width and height of the field; empty: taken from where particles are seen."),
    "field_degree": ("1", "Degree of the smooth field error that is estimated with the map; 0: none."),
    "field_sd_xy": ("m", "Its prior standard deviation in x and y: what the calibration leaves."),
    "field_sd_z": ("m", "Likewise in z."),
    "beyond_calibration": (
        "",
        "Use particles outside the ranges of z, field and brightness of the calibration, too.",
    ),
    "recentre_at": (
        "rad",
        "Turns since the reference at which the origin moves to the centre of rotation as known by then, each"
        " a new reference version; empty: only ~/set_reference.",
    ),
}  # fmt: skip

PARAMETERS = (
    Parameter("body", "load_gear", "Name of the rigid body in the messages, where there is but one."),
    Parameter("bodies", "", "File of several rigid bodies (docs/files.md); empty: one, of the name above."),
    Parameter(
        "calibration",
        "",
        "Calibration file of the localizer: the field error begins with what its field correction leaves"
        " uncertain; empty: with the field_sd below.",
    ),
    Parameter(
        "field_correction",
        "",
        "Calibration file that ~/save_field_correction writes: that one, corrected by the field error as"
        " measured by then.",
    ),
    *QUEUE_PARAMETERS,
    WAIT_PARAMETER,
    *of_settings(PoseSettings, "", _SETTINGS),
)


class PoseOutput:
    """Estimates poses, publishes them and serves requests, on behalf of a node with the parameters above."""

    def __init__(self, node: InstrumentNode) -> None:
        self._node = node
        self.settings = to_settings(PoseSettings, "", node.values)
        path = node.values["calibration"]
        self._calibration: Calibration | None = load_calibration(path) if path else None
        self._bodies = make_bodies(node.values, self.settings, self._calibration)
        self._using_bodies = threading.Lock()
        self._cycles, self._valid = 0, Counter[str]()
        self._last_counter: int | None = None
        self._number, self._without_increment = CycleCount(), set[str]()
        self.bodies = [estimator.body for estimator in self._bodies.estimators]
        self.publishers = {
            topic: node.create_publisher(messages.rclpy_type(kind), topic, transport.MESSAGES)
            for topic, kind in pose_topics(self.bodies).items()
        }
        for name, act in (
            ("reset", self._reset),
            ("set_reference", self._set_reference),
            ("save_field_correction", self._save_field_correction),
        ):
            node.create_service(Trigger, f"~/{name}", _served(act))

    def estimate(self, found: Localizations, arrival_ns: int) -> list[CyclePose]:
        """The pose of each body, published. ``arrival_ns`` of ``found``, host clock. Raises InputError where
        ``found`` is malformed or by another calibration than the one that we were told."""
        self._account(found)
        if self._calibration and len(found) and found.calibration_id != self._calibration.calibration_id:
            by = f"by calibration {found.calibration_id or 'none'}"
            raise InputError("localizations", by, f"{self._calibration.calibration_id}, the parameter's")
        with self._using_bodies:
            poses = self._bodies.update(replace(found, cycle=self._number(found.cycle)))
            self._cycles += 1
            self._valid.update(pose.body for pose in poses if pose.valid)
        published_ns = time.time_ns()
        latency = replace(
            found.latency,
            localization_transport=(arrival_ns - found.published_ns) * 1e-9,
            pose=(published_ns - arrival_ns) * 1e-9,
            total=(published_ns - found.frame_published_ns) * 1e-9 if found.frame_published_ns else NAN,
        )
        poses = [replace(self._as_counted(pose, found.cycle), latency=latency) for pose in poses]
        for topic, message in pose_messages(poses):
            transport.publish(self.publishers[topic], message)
        with self._using_bodies:
            self._bodies.learn()  # what takes milliseconds now and then, when the poses are out
        self._report(poses)
        return poses

    def begin_anew(self, *, forget: bool) -> None:
        """Frames and cycles are counted anew, of the same bodies or, ``forget``, of whatever there is."""
        self._last_counter = None
        self._number.restart()
        if forget:
            self._reset()
        else:
            self._without_increment = set(self.bodies)

    def _as_counted(self, pose: CyclePose, cycle: int) -> CyclePose:
        """With the source's own ``cycle``; how many went by while it did not count, nobody knows."""
        pose = replace(pose, cycle=cycle)
        if not pose.valid or pose.body not in self._without_increment:
            return pose
        self._without_increment.discard(pose.body)
        none, uncertain = np.full(6, NAN), np.full((6, 6), NAN)
        return replace(pose, increment_cycles=0, increment=none, increment_covariance=uncertain)

    def _report(self, poses: list[CyclePose]) -> None:
        health, states = self._node.health, []
        health.worked()
        for pose in poses:
            of = f"{pose.body} " if len(poses) > 1 else ""
            status = pose.status.name.lower()
            states.append(f"{of}{status}" + (f": {pose.reason}" if pose.reason else ""))
            health.count(f"{of}poses")
            health.count(f"{of}poses {status}")
            health.set(f"{of}particles used", pose.particles_used)
            health.set(f"{of}residual xy, nm", f"{pose.residual_rms_xy * 1e9:.2f}")
            health.set(f"{of}residual z, nm", f"{pose.residual_rms_z * 1e9:.1f}")
        health.state = "; ".join(states)
        health.time("pose", poses[0].latency.pose)
        health.time("frame to pose", poses[0].latency.total)

    def _account(self, found: Localizations) -> None:
        """Count the localizations that were lost on the way here."""
        last, self._last_counter = self._last_counter, found.frame_counter
        if last is not None and (lost := found.frame_counter - last - 1 - found.frames_dropped) > 0:
            self._node.health.lost(lost, f"{lost} localizations lost before frame {found.frame_counter}")

    # Services: each returns what to answer, or raises InputError -----------------------------------

    def _reset(self) -> str:
        with self._using_bodies:
            self._bodies.reset()
            self._cycles, self._valid = 0, Counter()
        return "the next cycle founds a new reference"

    def _set_reference(self) -> str:
        with self._using_bodies:
            versions = {estimator.body: estimator.set_reference() for estimator in self._bodies.estimators}
        return "reference version " + ", ".join(
            f"{version} of {body}" if len(versions) > 1 else f"{version}"
            for body, version in versions.items()
        )

    def _save_field_correction(self) -> str:
        path = self._node.values["field_correction"]
        if not path or self._calibration is None:
            raise InputError("field correction", "no parameter field_correction or calibration", "both")
        with self._using_bodies:
            corrected = with_field_error(
                self._calibration,
                self._bodies.measured_field(),
                self.settings,
                f"live, {self._node.get_fully_qualified_name()}",
                self._valid,
                self._cycles,
            )
        save_calibration(corrected, path)
        return f"calibration {corrected.calibration_id} in {path}"


def _served(act: Callable[[], str]) -> Callable[[Trigger.Request, Trigger.Response], Trigger.Response]:
    def answer(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            response.success, response.message = True, act()
        except InputError as error:
            response.success, response.message = False, str(error)
        return response

    return answer


def make_bodies(values: Mapping[str, Any], settings: PoseSettings, calibration: Calibration | None) -> Bodies:
    """The bodies that the parameters describe; InputError where they cannot be told apart."""
    field = FieldError.remaining(calibration.correction if calibration else None, settings)
    if values["bodies"]:
        return load_bodies(Path(values["bodies"]), settings, field)
    return Bodies([PoseEstimator(settings, values["body"], field=field)])


class PoseEstimatorNode(InstrumentNode):
    """PoseEstimators behind a queue."""

    def __init__(self) -> None:
        super().__init__("pose_estimator", PARAMETERS)
        self._order = FrameOrder()
        self._jumps = on_jump_back(self, self._on_jump_back)

    def configure(self) -> None:
        self._order = FrameOrder()
        self._output = PoseOutput(self)

    def activate(self) -> None:
        self.start_worker(self._estimate)
        missing = self.missing_subscribers(self._output.publishers)
        self.when_ready(missing, self._subscribe, lambda: rehearse(self._output.settings))

    def _subscribe(self) -> None:
        stream = self.make_stream()
        stream.subscribe(LocalizationsMessage, topics.LOCALIZATIONS, self._on_localizations)
        stream.begin()
        self.tell("ready")

    def _on_localizations(self, message: LocalizationsMessage) -> None:
        assert self.worker is not None
        self.worker.put((message, time.time_ns()))

    def _estimate(self, arrived: tuple[LocalizationsMessage, int]) -> None:
        message, arrival_ns = arrived
        try:
            found = messages.to_localizations(message)
            arrival = self._order.judge(found.stamp_ns, found.frame_counter)
            if arrival in (Arrival.AGAIN, Arrival.LATE):
                self.health.refused(f"localizations of {found.stamp_ns} ns arrived {arrival.name.lower()}")
                return
            if arrival is not Arrival.NEXT:
                self._output.begin_anew(forget=arrival is Arrival.REWOUND)
            self._output.estimate(found, arrival_ns)
        except InputError as error:
            self.health.refused(str(error))

    def _on_jump_back(self, seconds: float) -> None:
        then = "the next cycle before now founds a new reference"
        self.health.lost(0, f"time jumped back by {seconds:.3f} s: {then}")
        self._order.rewind()


def rehearse(settings: PoseSettings) -> None:
    """Follow a gear that nobody sees, and tell of it: from cycle to cycle, and once lost and found."""
    gear, estimator = SyntheticGear(Scene(particles=40), seed=0), PoseEstimator(settings)
    for step in (0.1, 0.1, 1.0, 0.1):
        for _, message in pose_messages([estimator.update(gear.observe()[0])]):
            messages.serialize(message)
        gear.advance(step)


def main(args: list[str] | None = None) -> int:
    """Run the node; returns the exit status."""
    return run(PoseEstimatorNode, args)


if __name__ == "__main__":
    sys.exit(main())
