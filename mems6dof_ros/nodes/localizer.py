"""``localizer``: frames to particles in three dimensions.

Subscribes to ``image_raw`` and, where somebody publishes it, ``frame_info``; publishes ``localizations``,
and ``localizations/points`` (sensor_msgs/PointCloud2) while somebody listens. Every frame gives one
message: an empty one where the frame cannot be used, so that nobody waits for it in vain. With
``tracking.enabled`` it subscribes to ``pose_6dof`` too. While ``frame_source`` shares its frames in memory
(``nodes.shared_frames``), it does not subscribe to the images.
"""

from __future__ import annotations

import contextlib
import math
import sys
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from sensor_msgs.msg import Image, PointCloud2, PointField

from mems6dof_msgs.msg import FrameInfo, Pose6DOF
from mems6dof_msgs.msg import Localizations as LocalizationsMessage
from mems6dof_ros.calibration.estimator import METHODS
from mems6dof_ros.calibration.file import load_calibration
from mems6dof_ros.errors import InputError
from mems6dof_ros.frame import NAN, Frame
from mems6dof_ros.localization.camera import CameraNoise
from mems6dof_ros.localization.detection import DetectionSettings
from mems6dof_ros.localization.fitting import WEIGHTINGS
from mems6dof_ros.localization.localizations import FIT_PARAMETERS, GaussianFits, Latency, Localizations
from mems6dof_ros.localization.localizer import Localizer, LocalizerSettings
from mems6dof_ros.localization.tracking import TrackingLocalizer, TrackingSettings
from mems6dof_ros.nodes import transport
from mems6dof_ros.nodes.common import QUEUE_PARAMETERS, WAIT_PARAMETER, InstrumentNode, run
from mems6dof_ros.nodes.frame_matcher import ArrivedFrame, FrameMatcher
from mems6dof_ros.nodes.frame_order import Arrival, FrameOrder
from mems6dof_ros.nodes.image_route import ImageRoute
from mems6dof_ros.nodes.parameters import Parameter, of_settings, to_settings
from mems6dof_ros.nodes.shared_frames import SLOTS, SharedImage
from mems6dof_ros.nodes.sim_time import on_jump_back
from mems6dof_ros.pose.cycle_pose import CyclePose
from mems6dof_ros.recording import messages, topics

POINTS = "localizations/points"

#: Seconds after which it is looked for a camera that offers less than we ask for.
_LOOK_FOR_CAMERAS = 1.0

_DETECTION = {
    "binning": ("px", "Side of one cell of the image that detection works on."),
    "spot_sigmas_px": ("px", "Sizes of spots to look for, standard deviations."),
    "threshold": ("1", "Least contrast of a spot, in standard deviations of the filtered background."),
    "separation_px": ("px", "Of two candidates closer than this only the brighter stays."),
    "background_px": ("px", "Size over which the background may vary, several times that of a spot."),
}
_SETTINGS = {
    "weighting": ("", f"Weights of the fit where no calibration prescribes them: {', '.join(WEIGHTINGS)}."),
    "window_px": ("px", "Odd side of the fitted window where no calibration prescribes it."),
    "pixel_size": ("m", "Image pixel size in object space where neither calibration nor frame states it."),
    "neighbour_distance": ("m", "Particles closer than this disturb each other and are flagged."),
    "neighbour_flux": ("1", "Fraction of a particle's light from which a neighbour disturbs it."),
    "least_significance": ("1", "Least amplitude in its standard deviations, else flagged as a poor fit."),
    "most_sigma": ("1", "Greatest width as a fraction of the window, else flagged as a poor fit."),
    "most_misfit": ("1", "Greatest rms residual beyond noise as a fraction of the light, else a poor fit."),
}
_TRACKING = {
    "detection_period": ("frames", "The whole frame is searched every so many frames."),
    "least_found": ("1", "Fraction of the expected good fits below which a frame is searched at once."),
}
#: Parameters that tell the noise of a camera: name to (unit, meaning).
CAMERA_NOISE = {
    "offset_adu": ("ADU", "Pixel value without light"),
    "gain_adu_per_electron": ("ADU/electron", "Gain"),
    "read_noise_electrons": ("electrons", "Standard deviation of what is not photon noise"),
    "saturation_adu": ("ADU", "Pixel value from which a pixel is saturated"),
}

PARAMETERS = (
    Parameter("calibration", "", "Calibration file; empty: x and y only, no z."),
    Parameter(
        "method",
        "",
        f"How z is read from the calibration: {', '.join(METHODS)}; empty: as the file says.",
        choices=("", *METHODS),
    ),
    *QUEUE_PARAMETERS,
    WAIT_PARAMETER,
    *(
        Parameter(f"camera.{name}", NAN, f"{doc}, in place of the calibration's.", unit, optional=True)
        for name, (unit, doc) in CAMERA_NOISE.items()
    ),
    *of_settings(LocalizerSettings, "", _SETTINGS),
    *of_settings(DetectionSettings, "detection.", _DETECTION),
    Parameter(
        "tracking.enabled",
        False,
        "Fit where the poses of one body say that its particles will be, and search the whole frame only now"
        " and then, or when they are not found there.",
    ),
    Parameter("tracking.body", "load_gear", "Name of that body."),
    *of_settings(TrackingSettings, "tracking.", _TRACKING),
)


class LocalizationOutput:
    """Localizes frames and publishes what it found, on behalf of a node with the parameters above."""

    def __init__(self, node: InstrumentNode) -> None:
        self._node = node
        self.localizer = make_localizer(node.values)
        self.tracker: TrackingLocalizer | None = None
        self.forget()
        self.publisher = node.create_publisher(LocalizationsMessage, topics.LOCALIZATIONS, transport.MESSAGES)
        self._points = node.create_publisher(PointCloud2, POINTS, transport.FRAMES)
        calibration = self.localizer.calibration
        node.get_logger().info(
            f"calibration {calibration.calibration_id}, method {calibration.method}"
            if calibration
            else "no calibration: x and y only"
        )

    def localize(self, frame: Frame) -> Localizations:
        """As Localizer.localize."""
        return (self.tracker or self.localizer).localize(frame)

    def forget(self) -> None:
        """Forget where particles were: cycles are counted anew."""
        if self._node.values["tracking.enabled"]:
            settings = to_settings(TrackingSettings, "tracking.", self._node.values)
            self.tracker = TrackingLocalizer(self.localizer, settings)

    def observe(self, pose: CyclePose) -> None:
        """Let the pose of a cycle tell where particles will be; from the thread that localizes."""
        if self.tracker and pose.valid and pose.body == self._node.values["tracking.body"]:
            self.tracker.observe(pose.cycle, pose.rotation, pose.translation, pose.reference_version)

    def publish(self, found: Localizations) -> None:
        """Publish, and keep account of it."""
        transport.publish(self.publisher, messages.localizations(found))
        if self._points.get_subscription_count():
            self._points.publish(point_cloud(found))
        health = self._node.health
        health.worked()
        health.count("frames localized")
        health.set("particles", len(found))
        health.time("localization", found.latency.localization)
        if self.tracker:
            self.tracker.search()
            health.set("frames searched", self.tracker.detections)


class LocalizerNode(InstrumentNode):
    """Localizer behind a queue."""

    def __init__(self) -> None:
        super().__init__("localizer", PARAMETERS)
        self._order = FrameOrder()
        self._jumps = on_jump_back(self, self._on_jump_back)

    def configure(self) -> None:
        self._order = FrameOrder()
        self._output = LocalizationOutput(self)
        self._last = -1, -1  # frame counter and cycle of the frame before

    def activate(self) -> None:
        self._matcher = FrameMatcher()
        self._poses: deque[CyclePose] = deque(maxlen=16)
        self._dropped = 0
        self._written_meanwhile = 0  # shared frames, while the last was localized
        self.start_worker(self._localize)
        missing = self.missing_subscribers({topics.LOCALIZATIONS: self._output.publisher})
        self.when_ready(missing, self._subscribe, self._rehearse)

    def _rehearse(self) -> None:
        rehearse(self._output.localizer)
        messages.prepare("sensor_msgs/msg/Image", "mems6dof_msgs/msg/Localizations")

    def _subscribe(self) -> None:
        stream = self.make_stream(self._on_tick)
        if self._output.tracker:
            stream.subscribe(Pose6DOF, topics.POSE_6DOF, self._on_pose)
        stream.subscribe(FrameInfo, topics.FRAME_INFO, self._on_info)
        self._subscribe_to_images()
        self._route = ImageRoute(self, self._subscribe_to_images, lambda: stream.unsubscribe(topics.IMAGE))
        self.health.gauge("images by", lambda: self._route.way)
        stream.begin()
        self.tell("ready")

    def _subscribe_to_images(self) -> None:
        assert self.stream is not None
        self._quality = transport.for_images(self, topics.IMAGE)
        self.stream.subscribe(Image, topics.IMAGE, self._on_image, self._quality, raw=True)
        self._looked_at = time.monotonic()

    def _look_for_cameras(self) -> None:
        """Subscribe anew where somebody publishes images who offers less than we ask for."""
        assert self.stream is not None
        self._looked_at = time.monotonic()
        if transport.for_images(self, topics.IMAGE) != self._quality:
            self.stream.unsubscribe(topics.IMAGE)
            self._subscribe_to_images()

    def _on_info(self, info: FrameInfo) -> None:
        stamp_ns = messages.nanoseconds(info.header.stamp)
        image = self._route.find(info.header, stamp_ns)
        if image or self._route.by_topic:
            self._matcher.add_info(stamp_ns, info, image, time.time_ns())
        self._route.choose(stamp_ns, image is not None, settled=not self._matcher.lacks_image)
        self._forward()

    def _on_image(self, data: bytes) -> None:
        arrival_ns = time.time_ns()
        with contextlib.suppress(InputError):
            if self._matcher.passes_by(transport.stamp_of(data)):
                return
        try:
            image = messages.deserialize(data, "sensor_msgs/msg/Image")  # its pixels stay where they are
        except Exception as error:  # whatever a reader of nonsense stumbles over
            self.health.refused(f"an image that cannot be read: {error!r}")
            return
        self._matcher.add_image(messages.nanoseconds(image.header.stamp), image, arrival_ns)
        self._forward()

    def _on_pose(self, pose: Pose6DOF) -> None:
        self._poses.append(messages.to_cycle_pose(pose))

    def _on_tick(self) -> None:
        self._matcher.tick()
        self._route.tick()
        if self._route.by_topic and time.monotonic() - self._looked_at > _LOOK_FOR_CAMERAS:
            self._look_for_cameras()
        self._forward()

    def _on_jump_back(self, seconds: float) -> None:
        self.health.lost(0, f"time jumped back by {seconds:.3f} s: from the next earlier frame on all is new")
        self._order.rewind()

    def _forward(self) -> None:
        """Hand on what is complete."""
        assert self.worker is not None
        self._informed = self._matcher.informed or self.count_publishers(topics.FRAME_INFO) > 0
        for arrived in self._matcher.take(self._informed):
            if arrived.info is None and self._informed:
                self.health.count("frames without frame_info")
            self.worker.put(arrived)

    # The worker ---------------------------------------------------------------------------------

    def _localize(self, arrived: ArrivedFrame) -> None:
        begin_ns = time.time_ns()
        shared = arrived.image if isinstance(arrived.image, SharedImage) else None
        behind = shared.written_since() if shared else 0
        if behind + self._written_meanwhile >= SLOTS:
            return  # would be overwritten before it is localized: as lost as from a full queue
        try:
            frame = messages.to_frame(arrived.image, arrived.info)
        except InputError as error:
            self.health.refused(str(error))
            if self._informed and arrived.info is None:
                return  # of whom nobody told that it is a frame
            frame = None
        if not self._take_in(arrived):
            return
        counter, cycle, lost = self._account(arrived.info)
        while self._poses:
            self._output.observe(self._poses.popleft())
        found = None
        if frame is not None:
            try:
                found = self._output.localize(replace(frame, frame_counter=counter, cycle=cycle))
            except InputError as error:
                self.health.refused(str(error))
        if shared:
            self._written_meanwhile = min(shared.written_since() - behind, SLOTS // 2)
        if shared and not shared.intact():
            self.health.lost(1, f"frame {counter} was overwritten while it waited or was localized")
            found = None
        if found is None:
            header = arrived.image.header
            published_ns = messages.nanoseconds(arrived.info.publication_time) if arrived.info else 0
            stamp_ns = messages.nanoseconds(header.stamp)
            found = nothing_found(stamp_ns, header.frame_id, counter, cycle, published_ns)
        published_ns = time.time_ns()
        found = replace(
            found,
            frames_dropped=lost,
            latency=_latency(arrived, begin_ns, published_ns),
            published_ns=published_ns,
        )
        self._output.publish(found)
        self.health.time("waiting in the queue", found.latency.queue)

    def _take_in(self, arrived: ArrivedFrame) -> bool:
        """False for a frame that comes again or late, of which there is, or will be, nothing to tell."""
        stamp_ns, info = messages.nanoseconds(arrived.image.header.stamp), arrived.info
        arrival = self._order.judge(stamp_ns, int(info.frame_counter) if info else None)
        if arrival in (Arrival.AGAIN, Arrival.LATE):
            self.health.refused(f"the frame of {stamp_ns} ns arrived {arrival.name.lower()}")
            return False
        if arrival is not Arrival.NEXT:
            if arrival is Arrival.ANEW:
                self.health.lost(0, f"the source has begun anew at {stamp_ns} ns")
            self._output.forget()
            self._poses.clear()
            if info:
                self._last = -1, -1
        return True

    def _account(self, info: FrameInfo | None) -> tuple[int, int, int]:
        """Frame counter, motion cycle, and frames lost since the last frame."""
        assert self.worker is not None
        dropped, self._dropped = self.worker.dropped - self._dropped, self.worker.dropped
        last_counter, last_cycle = self._last
        if info is None:
            # A camera that publishes only images: count ourselves, one motion cycle per frame.
            counter, cycle = last_counter + 1 + dropped, last_cycle + 1 + dropped
        else:
            counter, cycle = int(info.frame_counter), int(info.cycle)
        self._last = counter, cycle
        lost = max(counter - last_counter - 1, 0) if last_counter >= 0 else 0
        if (on_the_way := lost - (info.frames_dropped if info else 0)) > 0:
            of_which = f", {dropped} of them in this queue" if dropped else ""
            self.health.lost(on_the_way, f"{on_the_way} frames lost before frame {counter}{of_which}")
        return counter, cycle, lost


def make_localizer(values: Mapping[str, Any]) -> Localizer:
    """The localizer that the parameters describe; InputError where they cannot work together."""
    path, method = values["calibration"], values["method"]
    calibration = load_calibration(path, method or None) if path else None
    given = {
        name: values[f"camera.{name}"] for name in CAMERA_NOISE if not math.isnan(values[f"camera.{name}"])
    }
    if calibration:
        camera = replace(calibration.camera, **given)
    elif missing := [name for name in CAMERA_NOISE if name not in given]:
        raise InputError(
            f"parameter camera.{missing[0]}", "neither a value nor a calibration", "one of the two"
        )
    else:
        camera = CameraNoise(**given)
    detection = to_settings(DetectionSettings, "detection.", values)
    return Localizer(camera, calibration, to_settings(LocalizerSettings, "", values, detection=detection))


def rehearse(localizer: Localizer) -> None:
    """Localize what a frame may show, in one that nobody took: a few particles, for arrays of one alone have
    other types, and dark debris."""
    calibration, camera = localizer.calibration, localizer.camera
    width, height = calibration.image_size if calibration else (256, 256)
    pixel_size = calibration.pixel_size if calibration else 1e-7
    middle = np.array([height // 2, width // 2])[:, None, None]
    electrons: Any = np.full((height, width), 10.0)
    for place in ([0, 0], [80, 0], [0, 80], [80, 60]):
        apart = np.indices((height, width)) - middle - np.array(place)[:, None, None]
        electrons += 1000 * np.exp(-(apart**2).sum(axis=0) / (2 * 3.0**2))
    electrons[:20, :20] = 0
    level = np.clip(camera.offset_adu + camera.gain_adu_per_electron * electrons, 0, 65535)
    frame = Frame(level.astype(np.uint16), 0, 0, 0, pixel_size=pixel_size)
    with contextlib.suppress(InputError):  # the first frame will tell
        localizer.localize(frame)


def point_cloud(found: Localizations) -> PointCloud2:
    """Positions as float32 in m, with flux in electrons and flags."""
    kinds = {"x": "<f4", "y": "<f4", "z": "<f4", "flux": "<f4", "flags": "<u4"}
    points = np.empty(len(found), dtype=list(kinds.items()))
    points["x"], points["y"], points["z"] = found.position.T
    points["flux"], points["flags"] = found.fits.flux, found.flags
    cloud = PointCloud2(height=1, width=len(found), point_step=20, row_step=20 * len(found), is_dense=False)
    cloud.header = messages.to_rclpy(messages.header(found.stamp_ns, found.frame_id))
    cloud.fields = [
        PointField(
            name=name,
            offset=4 * k,
            datatype=PointField.UINT32 if kind == "<u4" else PointField.FLOAT32,
            count=1,
        )
        for k, (name, kind) in enumerate(kinds.items())
    ]
    cloud.data.frombytes(points.tobytes())
    return cloud


def _latency(arrived: ArrivedFrame, begin_ns: int, published_ns: int) -> Latency:
    capture = transported = NAN
    if arrived.info is not None:
        frame_published_ns = messages.nanoseconds(arrived.info.publication_time)
        transported = (arrived.arrival_ns - frame_published_ns) * 1e-9
        if arrived.info.live:
            capture = (frame_published_ns - messages.nanoseconds(arrived.info.header.stamp)) * 1e-9
    return Latency(
        capture=capture,
        frame_transport=transported,
        queue=(begin_ns - arrived.arrival_ns) * 1e-9,
        localization=(published_ns - begin_ns) * 1e-9,
    )


def nothing_found(
    stamp_ns: int, frame_id: str, frame_counter: int, cycle: int, frame_published_ns: int
) -> Localizations:
    """No particles, for a frame that cannot be used."""
    fits = GaussianFits(
        parameters=np.empty((0, len(FIT_PARAMETERS))),
        covariance=np.empty((0, len(FIT_PARAMETERS), len(FIT_PARAMETERS))),
        chi_square=np.empty(0),
        iterations=np.empty(0, np.int32),
        flags=np.empty(0, np.uint32),
    )
    return Localizations(
        stamp_ns=stamp_ns,
        frame_id=frame_id,
        frame_counter=frame_counter,
        cycle=cycle,
        position=np.empty((0, 3)),
        covariance=np.empty((0, 3, 3)),
        fits=fits,
        z_gap=np.empty(0),
        flags=np.empty(0, np.uint32),
        frame_published_ns=frame_published_ns,
    )


def main(args: list[str] | None = None) -> int:
    """Run the node; returns the exit status."""
    cv2.setNumThreads(1)  # the other cores have processes of their own
    return run(LocalizerNode, args)


if __name__ == "__main__":
    sys.exit(main())
