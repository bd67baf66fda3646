"""Managed nodes (https://design.ros2.org/articles/node_lifecycle.html) that need nobody to manage them.

rclpy manages publishers only, and hides why a transition failed. Here a node says in four methods what its
states mean, and whatever it creates belongs to the state it was created for::

    unconfigured ──configure──▶ inactive ──activate──▶ active
         ◀──────────cleanup──────── ◀──────deactivate──────

An error in a transition is told, everything is released, and the node is unconfigured again.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from mems6dof_ros.nodes.worker import DRAIN_TIMEOUT

#: What a node can create, as rclpy names it.
_KINDS = ("publisher", "subscription", "client", "service", "timer", "guard_condition")


class ManagedNode(LifecycleNode):
    """A lifecycle node that says in ``configure``, ``activate``, ``deactivate`` and ``cleanup`` what it does.

    What is created on the node from ``configure`` on is destroyed after ``cleanup``, what is created from
    ``activate`` on, in callbacks too, after ``deactivate``: publishers, subscriptions, clients, services,
    timers and guard conditions. The four run in the executor's thread; an exception of theirs fails the
    transition and is kept in ``trouble``. One that fails releases what it opened itself: what it would have
    made is not unmade.
    """

    def __init__(self, name: str) -> None:
        self.trouble: Exception | None = None
        self._before: list[set[Any]] = []  # entities before configure, and before activate
        super().__init__(name)
        self._change_state = self._service_change_state.callback
        self._service_change_state.callback = self._on_change_state

    def configure(self) -> None:
        """Open, check and make what the parameters ask for; publish and take nothing yet."""

    def activate(self) -> None:
        """Begin, or go on, to take and to publish."""

    def deactivate(self) -> None:
        """Take and publish nothing more, but keep what is known."""

    def cleanup(self) -> None:
        """Release and forget what ``configure`` has made."""

    def entered(self, state: str) -> None:
        """A transition has led to ``state``, by its label in lifecycle_msgs/State."""

    def hindered(self, error: Exception) -> None:
        """A transition that somebody asked for has failed by ``error``."""

    @property
    def lifecycle(self) -> str:
        """Label of the state."""
        return str(self._state_machine.current_state[1])

    def bring_up(self) -> None:
        """Configure and activate, as far as that is still to be done; raises what hindered it."""
        for state, trigger in (("unconfigured", self.trigger_configure), ("inactive", self.trigger_activate)):
            if self.lifecycle == state and trigger() != TransitionCallbackReturn.SUCCESS:
                assert self.trouble is not None
                raise self.trouble

    # What rclpy calls ---------------------------------------------------------------------------

    def _on_change_state(self, request: Any, response: Any) -> Any:
        self.trouble = None
        try:
            self._change_state(request, response)
        except RuntimeError:  # a transition that the state does not have; it must not end the node
            response.success = False
        if self.trouble is not None:
            self.hindered(self.trouble)
        return response

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._pass("inactive", lambda: self._enter(self.configure))

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._pass("active", lambda: self._enter(self.activate))

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._pass("inactive", lambda: self._leave(1))

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._pass("unconfigured", lambda: self._leave(0))

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._pass("finalized", lambda: self._leave(0))

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._pass("unconfigured", lambda: self._leave(0))

    def _pass(self, state: str, act: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            act()
        except Exception as error:
            self.trouble = error
            return TransitionCallbackReturn.ERROR
        self.entered(state)
        return TransitionCallbackReturn.SUCCESS

    def _enter(self, begin: Callable[[], None]) -> None:
        before = self._entities()
        try:
            begin()
        except BaseException:
            self._destroy_all_but(before)
            raise
        self._before.append(before)

    def _leave(self, depth: int) -> None:
        while len(self._before) > depth:
            before = self._before.pop()
            try:
                (self.deactivate if self._before else self.cleanup)()
            finally:
                self._destroy_all_but(before)

    def _entities(self) -> set[Any]:
        return {entity for kind in _KINDS for entity in self._of_kind(kind)}

    def _destroy_all_but(self, kept: set[Any]) -> None:
        deadline = time.monotonic() + DRAIN_TIMEOUT
        for kind in _KINDS:
            for entity in self._of_kind(kind):
                if entity in kept:
                    continue
                if kind == "publisher":  # what its readers have not yet taken would be lost
                    entity.wait_for_all_acked(Duration(seconds=max(deadline - time.monotonic(), 0.0)))
                getattr(self, f"destroy_{kind}")(entity)

    def _of_kind(self, kind: str) -> list[Any]:
        return list(getattr(self, "guards" if kind == "guard_condition" else f"{kind}s"))
