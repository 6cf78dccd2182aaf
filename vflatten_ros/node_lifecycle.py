"""The lifecycle of the node: every request gets an answer, and a failure its reason."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from vflatten_ros.core.errors import VFlattenError
from vflatten_ros.node_log import Log

INACTIVE, ACTIVE = 2, 3  # lifecycle_msgs/State.PRIMARY_STATE_...
TRANSITIONS = {0: "create", 1: "configure", 2: "cleanup", 3: "activate", 4: "deactivate"} | {
    **dict.fromkeys((5, 6, 7), "shutdown"),
    8: "destroy",
}  # lifecycle_msgs/Transition
SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class AnsweringLifecycleNode(LifecycleNode):
    """A lifecycle node that says no where rclpy's raises.

    Subclasses do the work in `configure`, `activate`, `deactivate` and `cleanup`, and raise
    VFlattenError where that fails.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.log = Log(self.get_logger())
        self.trouble = ""  # why the last transition failed
        # rclpy lets an impossible request's RCLError out of spin: that ends a node, unanswered.
        change_state = self._service_change_state.callback
        self._service_change_state.callback = partial(self._answer_change_state, change_state)

    def lifecycle_state(self) -> tuple[int, str]:
        """Number (lifecycle_msgs/State) and name."""
        number, label = self._state_machine.current_state
        return int(number), str(label)

    def autostart(self) -> None:
        """Configure and activate, as a lifecycle manager would."""
        if self.trigger_configure() == SUCCESS:
            self.trigger_activate()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Check the categories and start the flattening process."""
        return self._transition("configure", self.configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Read the calibration, begin an empty buffer and subscribe."""
        return self._transition("activate", self.activate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Unsubscribe and cancel what is being flattened."""
        done = "inactive: clouds and joint states are no longer taken"
        return self._transition("deactivate", self.deactivate, done)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """End the flattening process."""
        done = "unconfigured: the flattening process has ended"
        return self._transition("clean up", self.cleanup, done)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """As deactivate and cleanup."""
        done = "finalized: the node does nothing any more; end it"
        return self._transition("shut down", self._shut_down, done)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """After a mistake of our own: everything down, so that configure can try again."""
        return self._transition("recover", self._shut_down)

    def _transition(
        self, name: str, change: Callable[[], None], done: str = ""
    ) -> TransitionCallbackReturn:
        try:
            change()
        except VFlattenError as error:
            self.trouble = str(error)
            self.log.error(f"cannot {name}: {error}")
            return FAILURE
        except Exception:
            self.trouble = f"internal error in {name}"
            self.log.error(f"internal error in {name}:\n{traceback.format_exc()}")
            return TransitionCallbackReturn.ERROR
        self.trouble = ""
        if done:
            self.log.info(done)
        return SUCCESS

    def _shut_down(self) -> None:
        self.deactivate()
        self.cleanup()

    def _answer_change_state(self, change: Callable[..., Any], request: Any, response: Any) -> Any:
        number, label = request.transition.id, request.transition.label
        possible = [(known, name) for known, name, *_ in self._state_machine.available_transitions]
        if any(label == name if label else number == known for known, name in possible):
            return change(request, response)
        state = self.lifecycle_state()[1]
        asked = label[:60] or f"{TRANSITIONS.get(number, 'transition')} ({number})"
        others = ", ".join(dict.fromkeys(name for _, name in possible)) or "none"
        text = f"refused: {asked} is not possible while {state}; possible: {others}"
        self.log.warning(text, cause=f"transition {number} while {state}")
        response.success = False
        return response

    def configure(self) -> None:
        """Unconfigured to inactive."""

    def activate(self) -> None:
        """Inactive to active."""

    def deactivate(self) -> None:
        """Active to inactive; also called on the way down from any state."""

    def cleanup(self) -> None:
        """Inactive to unconfigured; also called on the way down from any state."""
