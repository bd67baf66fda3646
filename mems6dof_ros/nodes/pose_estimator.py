"""``pose_estimator``: particles to the pose of the gear, once per motion cycle.

Subscribes to ``localizations``; publishes ``pose_6dof`` for every one of them, and ``pose`` and
``pose_with_covariance`` while the pose is valid, all with the header of the frame. Services
(std_srvs/Trigger): ``~/reset``, ``~/set_reference``.
"""

from __future__ import annotations

import sys
import threading
import time
from dataclasses import replace

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from std_srvs.srv import Trigger

from mems6dof_msgs.msg import Localizations as LocalizationsMessage
from mems6dof_msgs.msg import Pose6DOF
from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import NAN
from mems6dof_ros.localization.localizations import Localizations
from mems6dof_ros.nodes import transport
from mems6dof_ros.nodes.common import QUEUE_PARAMETERS, WAIT_PARAMETER, InstrumentNode, WhileRoom, run
from mems6dof_ros.nodes.parameters import Parameter, of_settings, to_settings
from mems6dof_ros.pose.cycle_pose import CyclePose
from mems6dof_ros.pose.estimator import PoseEstimator
from mems6dof_ros.pose.settings import PoseSettings
from mems6dof_ros.pose.synthetic import Scene, SyntheticGear
from mems6dof_ros.recording import messages, topics

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
    "recentre_at": (
        "rad",
        "Turns since the reference at which the origin moves to the centre of rotation as known by then, each"
        " a new reference version; empty: only ~/set_reference.",
    ),
}  # fmt: skip

PARAMETERS = (
    Parameter("body", "load_gear", "Name of the rigid body in the messages."),
    *QUEUE_PARAMETERS,
    WAIT_PARAMETER,
    *of_settings(PoseSettings, "", _SETTINGS),
)


class PoseOutput:
    """Estimates poses, publishes them and serves requests, on behalf of a node with the parameters above."""

    def __init__(self, node: InstrumentNode) -> None:
        self._node = node
        self.settings = to_settings(PoseSettings, "", node.values)
        self._estimator = PoseEstimator(self.settings, node.values["body"])
        self._using_estimator = threading.Lock()
        self._last_counter: int | None = None
        self.publishers = {
            topic: node.create_publisher(kind, topic, transport.MESSAGES)
            for topic, kind in (
                (topics.POSE_6DOF, Pose6DOF),
                (topics.POSE, PoseStamped),
                (topics.POSE_WITH_COVARIANCE, PoseWithCovarianceStamped),
            )
        }
        node.create_service(Trigger, "~/reset", self._on_reset)
        node.create_service(Trigger, "~/set_reference", self._on_set_reference)

    def estimate(self, found: Localizations, arrival_ns: int) -> CyclePose:
        """The pose, published; raises as PoseEstimator.update. ``arrival_ns`` of ``found``, host clock."""
        self._account(found)
        with self._using_estimator:
            cycle_pose = self._estimator.update(found)
        published_ns = time.time_ns()
        latency = replace(
            found.latency,
            localization_transport=(arrival_ns - found.published_ns) * 1e-9,
            pose=(published_ns - arrival_ns) * 1e-9,
            total=(published_ns - found.frame_published_ns) * 1e-9 if found.frame_published_ns else NAN,
        )
        cycle_pose = replace(cycle_pose, latency=latency)
        self._publish(cycle_pose)
        return cycle_pose

    def _publish(self, cycle_pose: CyclePose) -> None:
        self.publishers[topics.POSE_6DOF].publish(messages.to_rclpy(messages.pose6dof(cycle_pose)))
        if cycle_pose.valid:
            pose = messages.pose_stamped(cycle_pose)
            covariant = messages.pose_with_covariance_stamped(cycle_pose)
            self.publishers[topics.POSE].publish(messages.to_rclpy(pose))
            self.publishers[topics.POSE_WITH_COVARIANCE].publish(messages.to_rclpy(covariant))
        health = self._node.health
        health.state = cycle_pose.status.name.lower() + (
            f": {cycle_pose.reason}" if cycle_pose.reason else ""
        )
        health.count("poses")
        health.count(f"poses {cycle_pose.status.name.lower()}")
        health.set("particles used", cycle_pose.particles_used)
        health.set("residual xy, nm", f"{cycle_pose.residual_rms_xy * 1e9:.2f}")
        health.set("residual z, nm", f"{cycle_pose.residual_rms_z * 1e9:.1f}")
        health.time("pose", cycle_pose.latency.pose)
        health.time("frame to pose", cycle_pose.latency.total)

    def _account(self, found: Localizations) -> None:
        """Count the localizations that were lost on the way here."""
        last, self._last_counter = self._last_counter, found.frame_counter
        if last is not None and (lost := found.frame_counter - last - 1 - found.frames_dropped) > 0:
            self._node.health.lost(lost, f"{lost} localizations lost before frame {found.frame_counter}")

    # Services -----------------------------------------------------------------------------------

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        with self._using_estimator:
            self._estimator.reset()
        response.success, response.message = True, "the next cycle founds a new reference"
        return response

    def _on_set_reference(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            with self._using_estimator:
                version = self._estimator.set_reference()
            response.success, response.message = True, f"reference version {version}"
        except InputError as error:
            response.success, response.message = False, str(error)
        return response


class PoseEstimatorNode(InstrumentNode):
    """PoseEstimator behind a queue."""

    def __init__(self) -> None:
        super().__init__("pose_estimator", PARAMETERS)

    def configure(self) -> None:
        self._output = PoseOutput(self)

    def activate(self) -> None:
        self.start_worker(self._estimate)
        missing = self.missing_subscribers(self._output.publishers)
        self.when_ready(missing, self._subscribe, lambda: rehearse(self._output.settings))

    def _subscribe(self) -> None:
        assert self.worker is not None
        self.create_subscription(
            LocalizationsMessage,
            topics.LOCALIZATIONS,
            self._on_localizations,
            transport.MESSAGES,
            callback_group=WhileRoom(self.worker),
        )
        self.tell("ready")

    def _on_localizations(self, message: LocalizationsMessage) -> None:
        assert self.worker is not None
        self.worker.put((message, time.time_ns()))

    def _estimate(self, arrived: tuple[LocalizationsMessage, int]) -> None:
        message, arrival_ns = arrived
        try:
            self._output.estimate(messages.to_localizations(message), arrival_ns)
        except InputError as error:
            self.health.refused(str(error))


def rehearse(settings: PoseSettings) -> None:
    """Follow a gear that nobody sees: from cycle to cycle, and once lost and found."""
    gear, estimator = SyntheticGear(Scene(particles=40), seed=0), PoseEstimator(settings)
    for step in (0.1, 0.1, 1.0, 0.1):
        estimator.update(gear.observe()[0])
        gear.advance(step)


def main(args: list[str] | None = None) -> int:
    """Run the node; returns the exit status."""
    return run(PoseEstimatorNode, args)


if __name__ == "__main__":
    sys.exit(main())
