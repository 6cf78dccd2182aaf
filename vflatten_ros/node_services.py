"""The node's services and its action: requests in, answers out; every request gets one."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from geometry_msgs.msg import PointStamped
from rclpy.action import ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.task import Future
from std_srvs.srv import Trigger

from vflatten_ros import messages
from vflatten_ros.action import Flatten
from vflatten_ros.core.events import Event
from vflatten_ros.core.geometry import transform_points
from vflatten_ros.core.values import FlatGarment, Landmark
from vflatten_ros.goals import Listener
from vflatten_ros.msg import Correspondence, Status, ViewInfo
from vflatten_ros.node_outputs import buffer_message, result_message
from vflatten_ros.session import (
    CANCELLED,
    FAILED,
    INVALID_ARGUMENT,
    MAX_PAIRS,
    NO_RESULT,
    NO_VIEWS,
    NOT_HELD,
    NOT_SEEN,
    OK,
    PARTLY,
    UNKNOWN_ID,
    UNKNOWN_NAME,
    Refused,
    Session,
)
from vflatten_ros.srv import (
    AddCorrespondences,
    ClearCorrespondences,
    ClearViews,
    GetState,
    ListCorrespondences,
    ListViews,
    LocateLandmark,
    SelectViews,
)
from vflatten_ros.worker import Outcome

if TYPE_CHECKING:
    from vflatten_ros.flatten_node import FlattenNode

RESULT_KEPT_S = 60  # for a client that asks late; rclpy's 15 minutes would pile results up


class Waiting(NamedTuple):
    """A request for a result, and what it waits for."""

    listener: Listener
    outcome: Future
    item: int


class Services:
    """All of the node's services. A request that cannot be done raises Refused in here."""

    def __init__(self, node: FlattenNode) -> None:
        self._node = node
        self._waiting: dict[bytes, Waiting] = {}
        self.waiting = 0  # requests for a result that have no answer yet
        for kind, name, callback in (
            (GetState, "state", self._get_state),
            (ListViews, "list_views", self._list_views),
            (SelectViews, "select_views", self._select_views),
            (ClearViews, "clear_views", self._clear_views),
            (AddCorrespondences, "add_correspondences", self._add_pairs),
            (ListCorrespondences, "list_correspondences", self._list_pairs),
            (ClearCorrespondences, "clear_correspondences", self._clear_pairs),
            (LocateLandmark, "locate_landmark", self._locate),
        ):
            node.create_service(kind, f"~/{name}", partial(self._answer, callback))
        # In a group of its own: while it waits, nothing else of its group is served.
        node.create_service(
            Trigger,
            "~/flatten",
            self._trigger_flatten,
            callback_group=ReentrantCallbackGroup(),
        )
        node.create_service(Trigger, "~/new_item", partial(self._trigger, self._new_item))
        node.create_service(Trigger, "~/clear", partial(self._trigger, self._clear_all_pairs))
        self._action = ActionServer(
            node,
            Flatten,
            "~/flatten",
            self._execute,
            cancel_callback=self._on_cancel,
            result_timeout=RESULT_KEPT_S,
        )

    def destroy(self) -> None:
        """Take the action server down."""
        self._action.destroy()

    # ---- answers

    def _answer(self, callback: Callable[..., None], request: Any, response: Any) -> Any:
        response.status = Status(code=OK)
        try:
            callback(request, response)
        except Refused as error:
            response.status = Status(code=error.code, message=str(error))
        return response

    def _trigger(self, callback: Callable[[], str], _: Any, response: Any) -> Any:
        try:
            response.message = callback()
            response.success = True
        except Refused as error:
            response.message = str(error)
        return response

    def _session(self) -> Session:
        return self._node.active_session()

    # ---- state and views

    def _get_state(self, _: Any, response: Any) -> None:
        goals = self._node.goals
        response.lifecycle_state = self._node.lifecycle_state()[0]
        response.flattening = goals is not None and goals.busy
        response.progress = self._node.progress() if response.flattening else 0.0
        response.buffer = buffer_message(self._node.session)

    def _list_views(self, _: Any, response: Any) -> None:
        session = self._session()
        chosen = set(session.selected())
        response.views = [
            messages.fill(ViewInfo(), messages.view_info_fields(view, view_id in chosen))
            for view_id, view in session.views().items()
        ]

    def _select_views(self, request: Any, response: Any) -> None:
        response.selected = list(self._session().select(list(request.ids)))
        self._node.buffer_changed()

    def _clear_views(self, request: Any, response: Any) -> None:
        session = self._session()
        if not len(request.ids):
            response.removed = len(session.views())
            self._new_item()
            return
        response.removed, unknown, events = session.clear_views(list(request.ids))
        self._node.take_events(events)
        _report_unknown(response.status, "view", unknown, response.removed)

    def _new_item(self) -> str:
        events: tuple[Event, ...] = self._session().new_item("requested")
        self._node.take_events(events)
        return f"item {self._session().buffer.state().item} begins"

    # ---- corresponding points

    def _add_pairs(self, request: Any, response: Any) -> None:
        session = self._session()
        if not request.pairs:
            raise Refused(INVALID_ARGUMENT, "the request holds no pairs")
        if len(request.pairs) > MAX_PAIRS:
            text = f"{len(request.pairs)} pairs in one request; at most {MAX_PAIRS} are taken"
            raise Refused(INVALID_ARGUMENT, text)
        answers = session.add_pairs(messages.read(pair) for pair in request.pairs)
        response.ids = [number for number, _ in answers]
        response.accepted = [number > 0 for number, _ in answers]
        response.reasons = [reason for _, reason in answers]
        refused = [reason for number, reason in answers if not number]
        if refused:
            response.status.code = INVALID_ARGUMENT if len(refused) == len(answers) else PARTLY
            response.status.message = (
                f"{len(refused)} of {len(answers)} refused, first: {refused[0]}"
            )
        self._node.buffer_changed()

    def _list_pairs(self, _: Any, response: Any) -> None:
        session = self._session()
        views = session.views()
        response.pairs = [
            messages.fill(Correspondence(), messages.correspondence_fields(pair, number, views))
            for number, pair in sorted(session.pairs.items())
        ]

    def _clear_pairs(self, request: Any, response: Any) -> None:
        response.removed, unknown = self._session().clear_pairs(list(request.ids))
        _report_unknown(response.status, "pair", unknown, response.removed)
        self._node.buffer_changed()

    def _clear_all_pairs(self) -> str:
        removed, _ = self._session().clear_pairs([])
        self._node.buffer_changed()
        return f"{removed} corresponding points removed"

    # ---- landmarks

    def _locate(self, request: Any, response: Any) -> None:
        session = self._session()
        self._node.take_joint_states()  # the fingers may have opened, too
        garment = self._node.last_garment
        if garment is None:
            item = session.buffer.state().item
            text = f"nothing of item {item} has been flattened yet; send a Flatten goal first"
            raise Refused(NO_RESULT, text)
        if session.buffer.fingers_open:
            raise Refused(
                NOT_HELD,
                "the fingers are open: the item of the last result hangs there no longer; "
                "grasp an item, turn it and flatten",
            )
        mark = _landmark(garment, request.name)
        limit_s = self._node.settings.node.node.no_data_warning_s
        angle, stamp_ns = _angle(session, request, limit_s)
        unseen = f"no view shows {mark.name!r}; turn the item and flatten again"
        if mark.xyz_hanger is None:
            raise Refused(NOT_SEEN, unseen)
        xyz = transform_points(garment.calibration.T_rig_hanger(angle), np.array(mark.xyz_hanger))
        frame = garment.calibration.frame
        if request.frame_id not in ("", frame):
            xyz = transform_points(self._node.frames.matrix(request.frame_id, frame), xyz)
            frame = request.frame_id
        fields = {
            "header": messages.header_fields(stamp_ns, frame),
            "point": messages.point_fields(xyz),
        }
        response.position = messages.fill(PointStamped(), fields)
        response.sigma = float(mark.xyz_sigma_m)
        response.certainty = float(mark.certainty)
        response.trusted = garment.trusted
        response.views = list(mark.views)
        if not mark.seen:
            raise Refused(NOT_SEEN, f"{unseen}; the position is the nearest cloth that one shows")

    # ---- flattening

    async def _trigger_flatten(self, _: Any, response: Any) -> Any:
        try:
            waiting = self._submit("", [], lambda stage, fraction: None)
        except Refused as error:
            response.message = str(error)
            return response
        outcome = await self._outcome(waiting)
        response.success = outcome.garment is not None
        response.message = (
            summary(outcome.garment) if outcome.garment is not None else outcome.error
        )
        return response

    def _submit(
        self, method: str, ids: list[int], on_progress: Callable[[str, float], None]
    ) -> Waiting:
        """Ask for a flattening; the future gives its Outcome. Raises Refused."""
        try:
            return self._submitted(method, ids, on_progress)
        except Refused as error:
            self._node.note_refusal(error)
            raise

    def _submitted(
        self, method: str, ids: list[int], on_progress: Callable[[str, float], None]
    ) -> Waiting:
        node = self._node
        task = self._session().task(node.settings.core, method, ids)
        future = Future()
        listener = Listener(on_progress, future.set_result)
        node.submit(task, listener)
        return Waiting(listener, future, task.item)

    async def _outcome(self, waiting: Waiting) -> Outcome:
        self.waiting += 1
        try:
            outcome: Outcome = await waiting.outcome
        finally:
            self.waiting -= 1
        return outcome

    async def _execute(self, goal: Any) -> Any:
        key = bytes(goal.goal_id.uuid)
        try:
            waiting = self._submit(
                goal.request.method, list(goal.request.view_ids), partial(self._feedback, goal)
            )
        except Refused as error:
            goal.abort()
            return Flatten.Result(status=Status(code=error.code, message=str(error)))
        self._waiting[key] = waiting
        if goal.is_cancel_requested:
            self._on_cancel(goal)
        self._feedback(goal, "waiting", 0.0)
        try:
            outcome = await self._outcome(waiting)
        finally:
            del self._waiting[key]
        if goal.is_cancel_requested:
            goal.canceled()
            status = Status(code=CANCELLED, message="cancelled on request")
            return Flatten.Result(status=status, item=waiting.item)
        result = _result(outcome)
        result.item = waiting.item
        goal.succeed() if outcome.garment is not None else goal.abort()
        return result

    def _feedback(self, goal: Any, stage: str, fraction: float) -> None:
        feedback = Flatten.Feedback(stage=stage, stage_progress=float(fraction))
        feedback.progress = self._node.progress()
        goal.publish_feedback(feedback)

    def _on_cancel(self, goal: Any) -> CancelResponse:
        """Answer at once; the worker stops by itself, or is ended after a grace period."""
        waiting = self._waiting.get(bytes(goal.goal_id.uuid))
        if waiting is not None and not waiting.outcome.done():
            if self._node.goals is not None:
                self._node.goals.withdraw(waiting.listener)
            self._node.log.info(f"a goal of item {waiting.item} was cancelled by its caller")
            waiting.outcome.set_result(Outcome(0, error="cancelled on request", cancelled=True))
        return CancelResponse.ACCEPT


def summary(garment: FlatGarment) -> str:
    """One line of a result."""
    sizes = [
        f"{m.name} {m.value_m:.3f} +- {m.sigma_m:.3f} m{' (inferred)' if m.inferred else ''}"
        for m in (garment.measurement("width"), garment.measurement("length"))
        if m is not None
    ]
    notices = [notice.code for notice in garment.notices]
    return ", ".join([garment.category, *sizes, f"quality {garment.quality:.2f}", *notices])


def _result(outcome: Outcome) -> Any:
    result = Flatten.Result()
    if outcome.garment is None:
        failed = NO_VIEWS if outcome.few_views else FAILED
        code = CANCELLED if outcome.cancelled else failed
        result.status = Status(code=code, message=outcome.error)
        return result
    result.status = Status(code=OK, message=summary(outcome.garment))
    result.flattened = result_message("flattened_view", outcome.messages)
    result.estimate = result_message("garment", outcome.messages)
    result.stages = list(outcome.seconds)
    result.seconds = [float(s) for s in outcome.seconds.values()]
    return result


def _landmark(garment: FlatGarment, name: str) -> Landmark:
    for mark in garment.landmarks:
        if mark.name == name:
            return mark
    known = ", ".join(mark.name for mark in garment.landmarks) or "none"
    raise Refused(
        UNKNOWN_NAME, f"a {garment.category} has no landmark {name[:60]!r}; it has: {known}"
    )


def _angle(session: Session, request: Any, limit_s: float) -> tuple[float, int]:
    """Item angle asked for, and the stamp of the joint state that has it, 0 if it is given."""
    if request.at_angle:
        angle = float(request.item_angle)
        if not np.isfinite(angle) or abs(angle) > 1e6:
            raise Refused(INVALID_ARGUMENT, f"item_angle: expected an angle in rad, got {angle}")
        return angle, 0
    return session.item_angle(time.monotonic_ns(), limit_s)


def _report_unknown(status: Any, what: str, unknown: list[int], removed: int) -> None:
    if unknown:
        status.code = PARTLY if removed else UNKNOWN_ID
        status.message = f"{what} {unknown[0]} does not exist ({len(unknown)} unknown ids)"
