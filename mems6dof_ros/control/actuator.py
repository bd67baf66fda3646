"""The rules of the actuation interface, once for every drive."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from mems6dof_ros.control.commands import Acknowledgement, Command, Outcome, why_refused


class Actuator:
    """Stands between commands and a drive that makes one motion cycle after another.

    Commands are submitted by any thread. The drive's own thread asks for ``next_cycle``, makes it, and
    says ``cycle_done``; so a stop, a later command or a disabled drive takes effect within one cycle. Each
    command is answered once through ``on_acknowledgement``, in whichever thread ended it.

    ``max_cycles``, ``max_frequency`` Hz: commands beyond are refused.
    """

    def __init__(self, max_cycles: int = 1000, max_frequency: float = 200.0) -> None:
        self.on_acknowledgement: Callable[[Acknowledgement], None] = lambda acknowledgement: None
        #: Motion cycles completed.
        self.cycle = 0
        self._max_cycles, self._max_frequency = max_cycles, max_frequency
        self._changed = threading.Condition()
        self._enabled = True
        self._in_cycle = False
        self._current: _Job | None = None
        self._pending: _Job | None = None  # waits for the end of the cycle under way
        self._due = 0.0  # monotonic s, when the next cycle may begin

    def submit(self, command: Command) -> None:
        """Take ``command`` in place of the one before it."""
        now_ns = time.time_ns()
        refusal = why_refused(command, now_ns, self._max_cycles, self._max_frequency)
        with self._changed:
            if not self._enabled and command.motion.cycles:
                refusal = "the drive is disabled"
            if refusal:
                answers = [Acknowledgement(command.id, Outcome.REFUSED, refusal, 0, self.cycle, now_ns)]
            else:
                answers = self._cut(f"replaced by command {command.id}")
                self._pending = _Job(command, now_ns)
                answers += self._settle()
        self._tell(answers)

    def enable(self, enabled: bool) -> None:
        """Obey commands or, from the end of the cycle under way, none but stops."""
        with self._changed:
            self._enabled = enabled
            answers = [] if enabled else self._cut("the drive was disabled")
        self._tell(answers)

    def next_cycle(self, timeout: float) -> Command | None:
        """Wait until a cycle is to be made and return its command; None after ``timeout`` s."""
        deadline = time.monotonic() + timeout
        with self._changed:
            while self._current is None or time.monotonic() < self._due:
                now = time.monotonic()
                if now >= deadline:
                    return None
                self._changed.wait((deadline if self._current is None else min(deadline, self._due)) - now)
            now = time.monotonic()
            period = 1 / self._current.command.frequency
            self._due = (self._due if now - self._due < period else now) + period
            self._in_cycle = True
            self._current.started_ns = self._current.started_ns or time.time_ns()
            return self._current.command

    def cycle_done(self) -> None:
        """The cycle that ``next_cycle`` asked for has been made."""
        with self._changed:
            assert self._current is not None
            self._in_cycle = False
            self.cycle += 1
            self._current.driven += 1
            self._current.ended_ns = time.time_ns()
            answers = self._settle()
        self._tell(answers)

    def _cut(self, why: str) -> list[Acknowledgement]:
        """End what is driven and what waits; returns what can be answered now."""
        for job in (self._current, self._pending):
            if job is not None:
                job.cut = job.cut or why
        return self._settle()

    def _settle(self) -> list[Acknowledgement]:
        """Answer the commands that have ended, begin the one that waits."""
        answers = []
        while not self._in_cycle and (self._current is None or self._current.ended):
            if self._current is not None:
                answers.append(self._current.answer(self.cycle))
            self._current, self._pending = self._pending, None
            if self._current is None:
                break
        if self._in_cycle and self._pending is not None and self._pending.cut:
            answers.append(self._pending.answer(self.cycle))
            self._pending = None
        self._changed.notify_all()
        return answers

    def _tell(self, answers: list[Acknowledgement]) -> None:
        for answer in answers:
            self.on_acknowledgement(answer)


@dataclass
class _Job:
    """A command and how far it is; ``cut``: why it ends early."""

    command: Command
    received_ns: int
    started_ns: int = 0
    ended_ns: int = 0
    driven: int = 0
    cut: str = ""

    @property
    def ended(self) -> bool:
        return bool(self.cut) or self.driven == self.command.motion.cycles

    def answer(self, cycle: int) -> Acknowledgement:
        done = self.driven == self.command.motion.cycles
        return Acknowledgement(
            self.command.id,
            Outcome.DONE if done else Outcome.STOPPED,
            "" if done else self.cut,
            self.driven,
            cycle,
            self.received_ns,
            self.started_ns,
            self.ended_ns,
        )
