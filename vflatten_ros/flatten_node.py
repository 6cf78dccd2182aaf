"""The lifecycle node: gathers views beside the robot, answers a planner, flattens, publishes."""

from __future__ import annotations

import os
import time
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from rclpy.clock import Clock, JumpThreshold
from rclpy.clock_type import ClockType
from rclpy.duration import Duration

from vflatten_ros.bag import cloud_from, stamp_ns
from vflatten_ros.categories import load_templates
from vflatten_ros.core.calibration import calibration_from
from vflatten_ros.core.errors import InvalidCloud, InvalidConfig
from vflatten_ros.core.events import (
    CLOCK_SET_BACK,
    REMEDIES,
    ClockJumped,
    CloudDropped,
    Event,
    ItemStarted,
    RotationComplete,
    ViewAdded,
    ViewReplaced,
    WristStill,
)
from vflatten_ros.core.image_border import cut_off_now
from vflatten_ros.core.values import Calibration, FlatGarment
from vflatten_ros.files import load_calibration
from vflatten_ros.frames import Frames
from vflatten_ros.goals import Finished, Goals, Listener, Task
from vflatten_ros.node_inputs import Inputs
from vflatten_ros.node_lifecycle import ACTIVE, INACTIVE, SUCCESS, AnsweringLifecycleNode
from vflatten_ros.node_log import without_numbers
from vflatten_ros.node_outputs import (
    ERROR,
    OK,
    Outputs,
    Status,
    buffer_message,
    buffer_status,
    flattening_status,
    joint_fault_text,
    still_text,
)
from vflatten_ros.node_services import Services, summary
from vflatten_ros.parameters import CalibrationOptions, NodeOptions, Parameters, Settings
from vflatten_ros.session import BUSY, NOT_ACTIVE, Refused, Session
from vflatten_ros.worker import Load, Worker

TICK_S = 0.05
DIAGNOSTICS_S = 1.0
NAMESAKE_S = 30.0  # a node that was killed stays visible for 20 s


class FlattenNode(AnsweringLifecycleNode):
    """Everything runs in one thread, the executor's; flattening runs in another process."""

    def __init__(
        self, name: str = "vflatten", loader: Callable[[NodeOptions], Load] | None = None
    ) -> None:
        """Create the node, unconfigured.

        Parameters
        ----------
        name : str
            Node name, unless remapped.
        loader : callable, optional
            The node's options -> what the flattening process loads; for tests.

        Raises
        ------
        InvalidConfig
            A parameter that was given has the wrong type or is out of range.
        """
        super().__init__(name)
        self._loader = loader or _loader
        self.session: Session | None = None
        self.goals: Goals | None = None
        self.last_garment: FlatGarment | None = None  # of the present item
        self._item = 0  # the newest item's number: it goes on after a deactivation
        self._views_come = 0  # of that item
        self._joint_faults = 0  # told so far
        self._ends = False
        self.frames = Frames(self)
        self._waits_for_tf = False  # to activate by itself
        self.errors = 0  # of our own, caught by the main loop
        self._finished = self._failed = 0
        self._failing = False
        self._last = ""
        self._refused, self._last_refusal = 0, ""
        self._alone_at = time.monotonic()
        self._declared = Parameters(
            self, lambda: self.lifecycle_state()[0] == ACTIVE, self._on_settings
        )
        self._results = Outputs(self)
        self._sensors = Inputs(self, self.log, self._on_cloud, self._on_joints)
        self._requests = Services(self)
        self._worker_guard = self.create_guard_condition(self._on_worker)
        # A paused /clock must stop neither time-outs nor diagnostics.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(TICK_S, self._on_tick, clock=steady)
        self.create_timer(DIAGNOSTICS_S, self._on_diagnostics, clock=steady)
        self._jump = self.get_clock().create_jump_callback(
            JumpThreshold(
                min_forward=None, min_backward=Duration(seconds=-1), on_clock_change=False
            ),
            post_callback=self._on_clock_jump,
        )

    @property
    def settings(self) -> Settings:
        """The parameters' present values."""
        return self._declared.settings

    def active_session(self) -> Session:
        """The session; raises Refused while the node is not active."""
        if self._ends:
            raise Refused(NOT_ACTIVE, "the node is being ended; start it again")
        number, label = self.lifecycle_state()
        if number != ACTIVE or self.session is None:
            raise Refused(NOT_ACTIVE, f"the node is {label}; activate it first{self._why()}")
        return self.session

    def _why(self) -> str:
        return f" (last try: {self.trouble})" if self.trouble else ""

    def _on_settings(self, settings: Settings) -> None:
        if self.session is not None:
            self.session.buffer.configure(settings.core)

    # ---- lifecycle

    def autostart(self) -> None:
        """Configure and activate; a calibration from TF is waited for."""
        options = self.settings.node.calibration
        wanted = bool(options.tf_frame) and not options.file
        if not (wanted and self.frames.open()):
            super().autostart()
        elif self.trigger_configure() == SUCCESS:
            self._waits_for_tf = True
            self._activate_with_tf()

    def _activate_with_tf(self) -> None:
        """Activate once TF knows the calibration's frames; others may do it before."""
        options = self.settings.node.calibration
        self._waits_for_tf &= self.lifecycle_state()[0] == INACTIVE
        if not self._waits_for_tf:
            return
        if self.frames.known(options.frame, options.tf_frame):
            self._waits_for_tf = False
            self.trigger_activate()
            return
        frames = f"from {options.tf_frame!r} to {options.frame!r}"
        self.trouble = f"calibration.tf_frame: waiting for a transform {frames}"
        text = f"{self.trouble}; is it published, on /tf or /tf_static?"
        self.log.warning(text, cause="tf")

    def configure(self) -> None:
        """Check the categories and start the flattening process."""
        options = self.settings.node.node
        load_templates(options.categories or None)
        if self.goals is not None:
            self.goals.stop()
        worker = Worker(self._loader(options), self._worker_guard.trigger, options.worker_nice)
        self.goals = Goals(worker, lambda: self.settings.node.node.max_queued_goals)
        self._started_with = _of_process(options)

    def activate(self) -> None:
        """Read the calibration, begin an empty buffer and subscribe."""
        calibration = self._calibration(self.settings.node.calibration)
        if _of_process(self.settings.node.node) != self._started_with:
            self.configure()  # they may change until now
        self.session = Session(calibration, self.settings.core, self._item)
        self._begin_item(self.session.buffer.state().item)
        self._joint_faults = 0
        self._sensors.open(self.settings.node.clouds, self.settings.node.joint_states)
        self.buffer_changed()
        self.log.info(
            f"active: item {self._item} begins, clouds in {calibration.frame} turned by "
            f"{calibration.joint}, method {self.settings.core.method}"
        )

    def deactivate(self) -> None:
        """Unsubscribe and cancel what is being flattened."""
        self._sensors.close()
        self._abandon("the node was deactivated before this was done")

    def _abandon(self, reason: str) -> None:
        """Cancel what is being flattened, and answer who waits for it."""
        if self._requests.waiting:
            text = f"{self._requests.waiting} requests for a result are abandoned: {reason}"
            self.log.warning(text)
        if self.goals is not None:
            self.goals.cancel_all(reason)

    def end(self, cause: str) -> bool:
        """The node is about to be taken down; whether somebody is still to be answered."""
        self.log.info(f"the node ends: {cause}")
        self._ends = True
        self._sensors.close()
        waiting = self.answering
        self._abandon(f"the node was ended ({cause}) before this was done")
        return waiting

    @property
    def answering(self) -> bool:
        """Whether an answer to a request for a result has not left yet."""
        return self._requests.waiting > 0

    def take_joint_states(self) -> None:
        """Take every joint state that has come."""
        self._sensors.take_joint_states()

    def cleanup(self) -> None:
        """End the flattening process."""
        if self.goals is not None:
            self.goals.stop()
        self.goals = self.session = self.last_garment = None

    def _calibration(self, options: CalibrationOptions) -> Calibration:
        if options.file:
            return load_calibration(os.path.expanduser(options.file))
        values: dict[str, Any] = {
            name: getattr(options, name)
            for name in ("frame", "axis_point", "axis_direction", "gripper_tip", "joint_zero")
        }
        values |= {"joint": options.joint, "joint_sign": options.joint_sign}
        if options.tf_frame:
            values |= self.frames.calibration_values(options)
        elif not options.frame:
            raise InvalidConfig(
                "no calibration: set calibration.file, or calibration.frame and the numbers"
            )
        return calibration_from(values)

    # ---- clouds and joint states

    def _on_cloud(self, message: Any) -> None:
        if self.session is None:
            return
        self._sensors.take_joint_states()
        now = time.monotonic_ns()
        try:
            events = self.session.add_cloud(cloud_from(message), now)
        except InvalidCloud as error:
            events = self.session.reject_cloud(str(error), now)
        except Exception as error:
            self.errors += 1
            text = f"internal error with a cloud:\n{traceback.format_exc()}"
            self.log.warning(text, cause="cloud")
            events = self.session.reject_cloud(f"internal error: {error}", now)
        self.take_events(events)

    def _on_joints(self, message: Any) -> None:
        if self.session is not None:
            stamp = stamp_ns(message.header.stamp)
            now = time.monotonic_ns()
            self.take_events(self.session.add_joint(stamp, message.name, message.position, now))

    def take_events(self, events: Sequence[Event]) -> None:
        """Log what an operator should know, publish the buffer, begin what a rotation asks for."""
        for event in events:
            self._note(event)
        if events:
            self.buffer_changed()
        if any(isinstance(event, RotationComplete) for event in events):
            self._flatten_by_itself()
        elif any(isinstance(event, ViewAdded) for event in events):
            self._look_early()

    def _note(self, event: Event) -> None:
        if isinstance(event, ItemStarted):
            # a clock that goes to and fro, as with two publishers, begins item after item
            few = self.session is None or self._views_come < self.session.buffer.min_views
            cause = event.cause if few and event.cause == CLOCK_SET_BACK else ""
            self._begin_item(event.item)
            self.log.info(f"item {event.item} begins: {event.cause}", cause)
        elif isinstance(event, RotationComplete):
            self.log.info(f"rotation complete: {event.views} views")
        elif isinstance(event, ClockJumped):
            back = (event.from_ns - event.to_ns) * 1e-9
            text = f"stamps went back by {back:.3f} s: the views of before are forgotten"
            self.log.warning(text, cause="clock")
        elif isinstance(event, CloudDropped) and event.reason not in ("duplicate_angle", "cleared"):
            # each text once: one reason has many causes
            cause = without_numbers(event.text)
            self.log.warning(self._drop_line(event), cause, kind=event.reason)
        elif isinstance(event, WristStill) and self.session is not None:
            self.log.warning(still_text(self.session.calibration.joint, event))
        elif isinstance(event, ViewAdded | ViewReplaced):
            self._views_come += 1
            self._look_at_border(event.view_id)

    def _begin_item(self, item: int) -> None:
        self._item, self._views_come = item, 0
        self.last_garment = None

    def _look_at_border(self, view_id: int) -> None:
        """Warn while the item turns, not only with the result."""
        view = self.session.views().get(view_id) if self.session is not None else None
        if view is not None and (text := cut_off_now(view)):
            self.log.warning(f"view {view_id}: {text}", cause="truncated")

    def _drop_line(self, event: CloudDropped) -> str:
        remedy = f"; {REMEDIES[event.reason]}" if event.reason in REMEDIES else ""
        topic = self._sensors.topic("clouds")
        cloud = f"cloud {event.view_id}" if event.view_id >= 0 else "a late cloud"
        return f"{topic}: {cloud} dropped, {event.reason}: {event.text}{remedy}"

    def buffer_changed(self) -> None:
        """Publish the buffer's state and have its views at the worker."""
        if self.session is not None:
            self._results.publish_buffer(buffer_message(self.session))
            if self.goals is not None:
                self.goals.keep(self.session.buffer.views(), self.settings.core)

    def _on_clock_jump(self, jump: Any) -> None:
        """ROS time went back."""
        if self.session is not None:
            now = self.get_clock().now().nanoseconds
            self.take_events(self.session.clock_set_back(now))

    # ---- flattening

    def progress(self) -> float:
        """0-1 of the flattening that is being worked on."""
        return self.goals.progress if self.goals is not None else 0.0

    def _flatten_by_itself(self) -> None:
        if self.settings.node.node.auto_flatten:
            self._submit_own()

    def _submit_own(self) -> None:
        try:
            task = self.active_session().task(self.settings.core)
            self.submit(task, Listener(lambda stage, fraction: None, lambda outcome: None))
        except Refused as error:
            self.note_refusal(error, "not flattened by itself")

    def submit(self, task: Task, listener: Listener) -> None:
        """Have a task done; raises Refused if too many wait."""
        if self.goals is None or not self.goals.submit(task, listener):
            most = self.settings.node.node.max_queued_goals
            raise Refused(BUSY, f"{most} goals are waiting already; try again later")

    def _look_early(self) -> None:
        """Flatten what there is so far, if nothing else is being flattened."""
        idle = self.goals is not None and self.goals.ready and not self.goals.busy
        if self.session is None or not idle or self.settings.core.method != "rotation":
            return
        if self.session.due(self.settings.node.node.look_early_deg):
            self.session.looked()
            self._submit_own()

    def note_refusal(self, error: Refused, what: str = "a goal was refused") -> None:
        """A request for a result that is not even begun leaves a line, too."""
        self._refused += 1
        self._last_refusal = _first_line(str(error))
        text = f"{what}: {error}"
        self.log.warning(text, without_numbers(_first_line(text)), kind="refused")

    def _on_worker(self) -> None:
        if self.goals is None:
            return
        for line in self.goals.handle_events():
            self.log.error(line, cause="process")
        self._take_finished()

    def _take_finished(self) -> None:
        for finished in self.goals.take_finished() if self.goals is not None else ():
            self._on_outcome(finished)

    def _on_outcome(self, finished: Finished) -> None:
        item, outcome = finished.task.item, finished.outcome
        if outcome.garment is None:
            self._failing = not outcome.cancelled
            self._failed += self._failing
            self._last = "cancelled" if outcome.cancelled else _first_line(outcome.error)
            if self._failing:
                text = f"item {item} not flattened: {outcome.error}"
                self.log.warning(text, without_numbers(self._last), kind="failed")
            return
        if not finished.again:
            self._failing = False
            self._finished += 1
            self._last = summary(outcome.garment)
            total = sum(outcome.seconds.values())
            self.log.info(f"item {item} flattened in {total:.2f} s: {self._last}")
        if item == self._item:
            self._on_garment(outcome.garment)
            self._results.publish_result(outcome.messages, self.settings.node.outputs)
        elif not finished.again:
            self.log.info(
                f"the result of item {item} goes to those who asked for it only, and is not "
                f"published: item {self._item} has begun"
            )

    def _on_garment(self, garment: FlatGarment) -> None:
        """A result of the present item."""
        self.last_garment = garment
        if self.session is not None and garment.enough and not self.session.enough:
            self.session.enough = True
            self.log.info(f"item {self._item}: {len(garment.view_ids)} views are enough")
            self.buffer_changed()

    # ---- timers

    def _on_tick(self) -> None:
        if self.session is not None and self.lifecycle_state()[0] == ACTIVE:
            self._sensors.take_joint_states()
            self.take_events(self.session.tick(time.monotonic_ns()))
        if self.goals is not None:
            for line in self.goals.check_deadlines():
                self.log.warning(line, cause="stubborn")
            self._take_finished()

    def _on_diagnostics(self) -> None:
        self._activate_with_tf()
        self._look_for_namesakes()
        self._sensors.check_quiet(self.settings.node.node.no_data_warning_s)
        self._look_at_joint_states()
        self._results.publish_diagnostics(self._statuses())

    def _look_at_joint_states(self) -> None:
        """Joint states without a position come as fast as others: a line once in a while."""
        if self.session is None:
            return
        state = self.session.buffer.state()
        if state.joint_faults > self._joint_faults:
            self._joint_faults = state.joint_faults
            text = joint_fault_text(self.session.calibration.joint, state)
            self.log.warning(f"{self._sensors.topic('joint_states')}: {text}", cause="positions")

    def _look_for_namesakes(self) -> None:
        """Two nodes of one name answer one another's calls, now this one, now that."""
        now, me = time.monotonic(), (self.get_name(), self.get_namespace())
        if self.get_node_names_and_namespaces().count(me) < 2:
            self._alone_at = now
        elif now - self._alone_at > NAMESAKE_S:
            name = self.get_fully_qualified_name()
            text = f"another node is named {name} and answers the same calls: end it, or rename"
            self.log.warning(f"{text} one (vflatten node --name, or a namespace)", cause="namesake")

    def _statuses(self) -> list[Status]:
        _, label = self.lifecycle_state()
        level = ERROR if self.trouble else OK
        values = {"lifecycle": label, "internal errors": self.errors}
        statuses: list[Status] = [(level, "node", self.trouble or label, values)]
        statuses += self._sensors.statuses(self.settings.node.node.no_data_warning_s)
        if self.session is not None:
            statuses.append(buffer_status(self.session))
        statuses.append(
            flattening_status(
                self.goals,
                self._finished,
                self._failed,
                self._failing,
                self._last,
                self._refused,
                self._last_refusal,
            )
        )
        return statuses

    def destroy_node(self) -> None:
        """End the flattening process as well."""
        if self.goals is not None:
            self.goals.stop()
        self._requests.destroy()
        super().destroy_node()


def _first_line(text: str) -> str:
    return (text.splitlines() or [""])[0][:300]


def _of_process(options: NodeOptions) -> tuple[str, int, int]:
    """Settings that the flattening process is started with."""
    return options.categories, options.worker_processes, options.worker_nice


def _loader(options: NodeOptions) -> Load:
    from vflatten_ros import job

    return partial(job.load, options.categories, options.worker_processes)
