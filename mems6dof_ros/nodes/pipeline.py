"""``pipeline``: frame_source, localizer and pose_estimator in one process, for the lowest latency.

The same cores call each other as functions; the same topics come out, the pose before everything else, and
the image only while somebody listens. Parameters and services are those of the three nodes, but that there
is nothing to queue and nobody to wait for: frames come at a rate or in steps.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace

import cv2

from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import NAN, Frame
from mems6dof_ros.localization.localizations import Latency
from mems6dof_ros.nodes import frame_source, localizer, pose_estimator
from mems6dof_ros.nodes.common import QUEUE_PARAMETERS, WAIT_PARAMETER, run
from mems6dof_ros.nodes.parameters import Parameter
from mems6dof_ros.recording import messages, topics


def _parameters() -> tuple[Parameter, ...]:
    by_name: dict[str, Parameter] = {}
    for parameter in (*frame_source.PARAMETERS, *localizer.PARAMETERS, *pose_estimator.PARAMETERS):
        by_name.setdefault(parameter.name, parameter)
    between_nodes = ("window", "acknowledged_by", "acknowledge_timeout")
    for name in (*(p.name for p in QUEUE_PARAMETERS), *between_nodes):
        del by_name[name]
    by_name["pacing"] = replace(
        by_name["pacing"],
        doc="When the next frame is taken: rate: so many a second; step: at each call of ~/step.",
        choices=("rate", "step"),
    )
    by_name[WAIT_PARAMETER.name] = WAIT_PARAMETER
    return tuple(by_name.values())


PARAMETERS = _parameters()


class PipelineNode(frame_source.FrameSourceNode):
    """Frames to poses by function calls, in the thread of the frames."""

    def __init__(self) -> None:
        super().__init__("pipeline", PARAMETERS)

    def configure(self) -> None:
        self._localization = localizer.LocalizationOutput(self)
        self._pose = pose_estimator.PoseOutput(self)
        if self._localization.tracker and len(self._pose.bodies) > 1:
            raise InputError("parameter tracking.enabled", "several bodies", "false: it follows but one")
        super().configure()

    def _begin_when_ready(self) -> None:
        publishers = {
            **self._topics,
            topics.LOCALIZATIONS: self._localization.publisher,
            **self._pose.publishers,
        }
        self.when_ready(self.missing_subscribers(publishers), self._thread.start, self._rehearse)

    def _rehearse(self) -> None:
        messages.prepare("mems6dof_msgs/msg/Localizations")
        localizer.rehearse(self._localization.localizer)
        pose_estimator.rehearse(self._pose.settings)

    def _deliver(self, frame: Frame) -> None:
        begin_ns = time.time_ns()
        frame = replace(frame, published_ns=begin_ns)
        try:
            found = self._localization.localize(frame)
        except InputError as error:
            self.health.refused(str(error))
            found = localizer.nothing_found(
                frame.stamp_ns, frame.frame_id, frame.frame_counter, frame.cycle, begin_ns
            )
        localized_ns = time.time_ns()
        latency = Latency(
            capture=(begin_ns - frame.stamp_ns) * 1e-9 if frame.live else NAN,
            frame_transport=0.0,
            queue=0.0,
            localization=(localized_ns - begin_ns) * 1e-9,
        )
        found = replace(found, latency=latency, published_ns=localized_ns)
        try:
            for pose in self._pose.estimate(found, localized_ns):
                self._localization.observe(pose)
        except InputError as error:
            self.health.refused(str(error))
        self._localization.publish(found)
        self._publish(frame, begin_ns)


def main(args: list[str] | None = None) -> int:
    """Run the node; returns the exit status."""
    cv2.setNumThreads(1)  # the other cores have processes of their own
    return run(PipelineNode, args, frames=True)


if __name__ == "__main__":
    sys.exit(main())
