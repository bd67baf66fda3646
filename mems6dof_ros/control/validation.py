"""The controller on a simulated drive and synthetic poses: no images, no ROS, no waiting."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mems6dof_ros.control.commands import Acknowledgement, Outcome
from mems6dof_ros.control.controller import Controller, ControllerSettings, Decision, State
from mems6dof_ros.control.position import DriveModel, DriveSettings, Law, PositionLaw
from mems6dof_ros.pose.angles import from_swing_twist
from mems6dof_ros.pose.cycle_pose import CyclePose, PaperAngles, Status
from mems6dof_ros.simulation.microsystem import LoadGear
from mems6dof_ros.simulation.settings import SimulationSettings

Array = NDArray[np.float64]

#: Standard deviations of a synthetic pose: some 25 particles of 2 nm; m, rad.
SD_LATERAL, SD_AXIAL, SD_TILT, SD_PSI = 0.5e-9, 15e-9, 300e-6, 10e-6


@dataclass(frozen=True)
class Move:
    """How one target was approached: ``error`` rad of the true psi at the end, ``cycles`` driven, and the
    ``fewest`` that an exactly known drive without errors would take."""

    target: float
    error: float
    cycles: int
    fewest: int
    state: State = State.ARRIVED
    reason: str = ""


@dataclass(frozen=True)
class Drive:
    """A kind of drive: what it does (``simulation``), and what the controller is told of it (``known``)."""

    name: str
    simulation: Mapping[str, Any]
    known: Mapping[str, Any]

    def settings(self, seed: int) -> SimulationSettings:
        """The simulated drive, one of its kind by ``seed``."""
        return SimulationSettings(seed=seed, **self.simulation)

    @property
    def told(self) -> DriveSettings:
        """What the controller knows of every drive of this kind."""
        return DriveSettings(**self.known)

    @property
    def tolerance(self) -> float:
        """One step's resolution or 1 mrad, whichever is larger; rad."""
        return max(self.told.resolution, 1e-3)


#: Step 78.5 mrad; unless said otherwise gain off by 1 % rms, jitter 1 mrad, backlash 5 mrad.
DRIVES = (
    Drive("as simulated by default", {}, {}),
    Drive("gain off by 10 % rms", {"step_error": 0.1}, {}),
    Drive("5 % stalls, 2 % skipped teeth", {"stall_probability": 0.05, "skip_probability": 0.02}, {}),
    Drive("backlash 20 mrad, 5 expected", {"backlash": 20e-3}, {}),
    Drive("jitter 3 mrad", {"step_jitter": 3e-3}, {"scatter": 3e-3}),
    Drive(
        "all of these",
        {
            "step_error": 0.1,
            "stall_probability": 0.05,
            "skip_probability": 0.02,
            "backlash": 20e-3,
            "step_jitter": 3e-3,
        },
        {"scatter": 3e-3},
    ),
    Drive("whole cycles only", {}, {"fine_steps": False}),
)


class Fault(NamedTuple):
    """What goes wrong on the way to the controller: each function returns what arrives, None: nothing.

    ``pose`` of the pose that should arrive and of the last that did; ``answer`` of an acknowledgement.
    """

    pose: Callable[[CyclePose, CyclePose], CyclePose | None] = lambda pose, before: pose
    answer: Callable[[Acknowledgement], Acknowledgement | None] = lambda answer: answer


class SyntheticLoop:
    """A gear on its drive, a controller, and between them poses with the noise that they claim.

    From motion cycle ``fault_from`` on, ``fault`` is in between too. Time is virtual: ``now`` s, one period
    per cycle.
    """

    def __init__(
        self,
        simulation: SimulationSettings,
        drive: DriveSettings | None = None,
        limits: ControllerSettings | None = None,
        law: Law | None = None,
    ) -> None:
        self.gear = LoadGear(simulation)
        self.limits = limits or ControllerSettings()
        self.controller = Controller(self.limits, law or PositionLaw(drive or DriveSettings()))
        self.fault, self.fault_from = Fault(), 0
        self.now = 1e6
        self._delivered: CyclePose | None = None
        self._rng = np.random.default_rng([simulation.seed, 31])
        self._step = abs(simulation.step)

    def go(self, target: float) -> Move:
        """Drive to psi = ``target`` rad until the controller rests."""
        distance = abs(target - self.gear.psi)
        start = self.gear.cycle
        decision = self.controller.set_target(target, self.now)
        while self.controller.state is State.MOVING:
            decision = self._obey(decision) if decision and decision.command else self._wait()
        return Move(
            target,
            self.gear.psi - target,
            self.gear.cycle - start,
            math.ceil(distance / self._step),
            self.controller.state,
            self.controller.reason,
        )

    def pose(self) -> CyclePose:
        """The pose of the gear as it stands, exposed now."""
        body = self.gear.pose(0.0)
        truth = np.array([*(body.translation - [1.5e-6, -2.5e-6, 0.0]), 0, 0, self.gear.psi])
        sd = np.array([SD_LATERAL, SD_LATERAL, SD_AXIAL, SD_TILT, SD_TILT, SD_PSI])
        displacement = truth + sd * self._rng.standard_normal(6)
        return synthetic_pose(displacement, np.diag(sd**2), self.gear.cycle, round(self.now * 1e9))

    def _obey(self, decision: Decision) -> Decision | None:
        command = decision.command
        assert command is not None
        motion = command.motion
        for _ in range(motion.cycles):
            self.gear.advance(1, motion.direction, motion.amplitude)
            self.now += 1 / command.frequency
        done = Acknowledgement(
            command.id, Outcome.DONE, "", motion.cycles, self.gear.cycle, round(self.now * 1e9)
        )
        fault = self.fault if self.gear.cycle >= self.fault_from else Fault()
        following = None
        if (answer := fault.answer(done)) is not None:
            following = self.controller.on_acknowledgement(answer, self.now)
        exposed = self.pose()
        self.now += 0.02
        if (pose := fault.pose(exposed, self._delivered or exposed)) is not None:
            self._delivered = pose
            following = self.controller.on_pose(pose, self.now) or following
        return following

    def _wait(self) -> Decision | None:
        self.now += 0.01
        return self.controller.on_time(self.now)


def synthetic_pose(displacement: Array, covariance: Array, cycle: int, stamp_ns: int) -> CyclePose:
    """A valid pose at ``displacement`` (6,) with ``covariance`` (6, 6), in reference version 2."""
    nan = math.nan
    return CyclePose(
        stamp_ns=stamp_ns,
        frame_id="microscope",
        frame_counter=cycle,
        cycle=cycle,
        body="load_gear",
        status=Status.TRACKING,
        reason="",
        reference_version=2,
        rotation=from_swing_twist(*displacement[3:]),
        translation=displacement[:3],
        covariance=covariance,
        displacement=displacement,
        displacement_covariance=covariance,
        angles=PaperAngles(nan, nan, nan, nan, nan, nan, False, False),
        increment=np.full(6, nan),
        increment_covariance=np.full((6, 6), nan),
        increment_cycles=0,
        residual_rms_xy=nan,
        residual_rms_z=nan,
        chi_square=nan,
        particles_used=25,
        particles_seen=25,
        particles_expected=25,
        particle_id=np.empty(0, np.int32),
        residual=np.empty((0, 3)),
    )


def random_targets(count: int, seed: int) -> list[float]:
    """Angles in rad within half a revolution either way."""
    return np.random.default_rng([seed, 30]).uniform(-math.pi, math.pi, count).tolist()


def open_loop(simulation: SimulationSettings, drive: DriveSettings, targets: Sequence[float]) -> list[Move]:
    """The same targets by the same knowledge of the same drive, but without looking."""
    gear, model = LoadGear(simulation), DriveModel(drive)
    believed, moves = 0.0, []
    for target in targets:
        start, distance = gear.cycle, abs(target - gear.psi)
        least = 0.5 * drive.step if not drive.fine_steps else 1e-9
        while abs(target - believed) > least:
            motion = model.plan(target - believed)
            gear.advance(motion.cycles, motion.direction, motion.amplitude)
            rotation = motion.direction * max(model.turn(motion.amplitude) - model.slack(motion.direction), 0)
            model.learn(motion, rotation)
            believed += rotation
        fewest = math.ceil(distance / abs(simulation.step))
        moves.append(Move(target, gear.psi - target, gear.cycle - start, fewest))
    return moves


def _changed(**changes: Any) -> Fault:
    return Fault(lambda pose, before: replace(pose, **changes))


def _displaced(index: int, value: float) -> Fault:
    def move(pose: CyclePose, before: CyclePose) -> CyclePose:
        displacement = pose.displacement.copy()
        displacement[index] = value
        return replace(pose, displacement=displacement)

    return Fault(move)


#: What a controller must not act on.
FAULTS: Mapping[str, Fault] = {
    "pose lost": _changed(status=Status.LOST, reason="no particles seen", displacement=np.full(6, math.nan)),
    "pose degraded": _changed(status=Status.DEGRADED, reason="whole turns of psi uncertain"),
    "pose initializing": _changed(status=Status.INITIALIZING),
    "pose of the cycle before, again": Fault(lambda pose, before: replace(before, stamp_ns=pose.stamp_ns)),
    "pose stale": Fault(lambda pose, before: replace(pose, stamp_ns=pose.stamp_ns - 2 * 10**9)),
    "pose with NaN": _displaced(0, math.nan),
    "psi not known well": _changed(displacement_covariance=np.eye(6) * 1e-6),
    "play beyond its limit": _displaced(1, 5e-6),
    "tilt beyond its limit": _displaced(4, 10e-3),
    "psi with another zero": _changed(reference_version=3),
    "no pose": Fault(pose=lambda pose, before: None),
    "no acknowledgement": Fault(answer=lambda answer: None),
    "command refused": Fault(
        answer=lambda answer: replace(answer, outcome=Outcome.REFUSED, reason="disabled")
    ),
    "drive moved by somebody else": Fault(lambda pose, before: replace(pose, cycle=pose.cycle + 1)),
}


def cycles_after(fault: Fault, seed: int = 1) -> tuple[int, str]:
    """Motion cycles made after the one in which ``fault`` began, and the reason that the controller gives."""
    loop = SyntheticLoop(SimulationSettings(seed=seed))
    loop.fault, loop.fault_from = fault, 6
    move = loop.go(2.0)
    if move.state is not State.STOPPED:
        raise AssertionError(f"the controller went on: {move}")
    return loop.gear.cycle - loop.fault_from, move.reason


def figures(
    seeds: int = 20, count: int = 20, progress: Callable[[int, int], None] = lambda done, total: None
) -> Iterator[tuple[Drive, list[Move], list[Move]]]:
    """Per kind of drive: ``count`` targets for each of ``seeds`` drives, closed and open loop."""
    for k, drive in enumerate(DRIVES):
        closed, opened = [], []
        for seed in range(1, seeds + 1):
            targets = random_targets(count, seed)
            loop = SyntheticLoop(drive.settings(seed), drive.told)
            closed += [loop.go(target) for target in targets]
            opened += open_loop(drive.settings(seed), drive.told, targets)
        progress(k + 1, len(DRIVES))
        yield drive, closed, opened
