"""Whether the views turn as the joint says, and about which axis.

Neighbouring views show the same cloth: registered, most of it lies on itself. The motions that this
takes tell where the axis is about which the item turns. If the sign of the joint is wrong, or the
item does not turn, hardly any cloth lies on itself, wherever the axis is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.errors import InvalidCalibration, NotEnoughViews
from vflatten_ros.core.geometry import inverse, transform_points
from vflatten_ros.core.motions import axis_error, effect, stepped
from vflatten_ros.core.parallel import mapped
from vflatten_ros.core.registration import (
    Agreement,
    Folded,
    ViewSurface,
    agreement,
    register_views,
    turned,
    view_surface,
)
from vflatten_ros.core.values import Calibration, Float, Notice, Progress, View, no_progress

FAR = 3.0  # standard deviations of the axis' error, beyond which views are registered from there
KNOWN = 0.75  # the same, from which on views tell better than the calibration: they err by 2 mm
TOLD = 2.0  # the same, beyond which the result says so
NEAR = 0.5  # the same, steps of it that no longer matter
ROUNDS, FEWEST = 8, 3  # at most; after which each must be better than those before
ROUGH_M, ROUGH_DEG, ROUGH_REACH_M = 0.03, 5.0, 0.02  # while the axis may be anywhere
FOUND_M, FOUND_RAD = 2e-4, np.radians(0.02)  # steps of a calibration that no longer matter


@dataclass(frozen=True)
class Axis:
    """The axis about which an item turned."""

    calibration: Calibration
    moved_m: float  # from where it was said to be, at the gripper tip
    leaned_rad: float
    agreement: Agreement


@dataclass(frozen=True, eq=False)
class Turned:
    """Registered views, and about which axis they turn."""

    poses: list[Float]  # (4, 4) each: takes its hanger coordinates to the common ones
    config: RotationConfig  # by which they were registered
    calibration: Calibration  # that has the axis
    T_hanger_common: Float  # (4, 4) to its hanger frame
    notices: tuple[Notice, ...] = ()


def as_they_turn(
    given: Calibration,
    surfaces: Sequence[ViewSurface],
    poses: Sequence[Float],
    config: RotationConfig,
    progress: Progress = no_progress,
) -> Turned:
    """Views about the axis that they tell of, where it is not that of the calibration.

    Parameters
    ----------
    given : Calibration
        Of the views.
    surfaces : sequence of ViewSurface
        Of them, by it.
    poses : sequence of ndarray of shape (4, 4)
        Result of register_views for them.
    config : RotationConfig
    progress : Progress

    Raises
    ------
    InvalidCalibration
        They turn the other way, or not at all.
    """
    poses, error, suiting = _about_true_axis(surfaces, poses, config, progress)
    agreed = agreement(surfaces, poses, config)
    as_given = Turned(list(poses), suiting, given, np.eye(4))
    if not agreed.enough and (otherwise := _contradiction(given, surfaces, agreed, config)):
        raise InvalidCalibration(otherwise)
    if agreed.hopeless:
        return replace(as_given, notices=_misplaced(agreed))
    if not agreed.least or _deviations(error, config) <= KNOWN:
        return as_given
    return replace(
        as_given,
        calibration=corrected(given, error),
        T_hanger_common=to_hanger(given, error),
        notices=_off(error, config, given),
    )


def refine_axis(
    views: Sequence[View], config: RotationConfig, progress: Progress = no_progress
) -> Axis:
    """Where the axis is about which an item turned, from its views alone.

    Any cloth does that hangs still and is no body of revolution. How high the gripper tip is does
    not show: it moves with the axis.

    Parameters
    ----------
    views : sequence of View
        Of one rotation, 30 degrees apart or less. Their axis may be off by 10 cm and 10 degrees.
    config : RotationConfig
    progress : Progress

    Returns
    -------
    Axis
        Of the joint as it is said to turn, or, where only that fits, the other way round.

    Raises
    ------
    NotEnoughViews
    InvalidCalibration
        The views fit together neither way.
    """
    given = views[0].calibration
    progress("axis", 0.0)
    surfaces = list(mapped(partial(view_surface, config=config), views))
    found = _refined(given, surfaces, config, progress)
    if not found.agreement.least:
        raise NotEnoughViews(
            f"calibration: {len(views)} views, and hardly two of them near each other in angle; "
            "turn the item once and take a view every 30 degrees or oftener"
        )
    if not found.agreement.enough:
        if _agreement_if_still(given, surfaces, config).plainly_more_than(found.agreement):
            raise InvalidCalibration(_still(given))
        other = _refined(*_reversed(given, surfaces), config, progress)
        found = other if other.agreement.plainly_more_than(found.agreement) else found
    if found.agreement.hopeless:
        raise InvalidCalibration(f"{_neither(found.agreement)}, or measure the axis again")
    moved_m, leaned_rad = apart(given, found.calibration)
    return replace(found, moved_m=moved_m, leaned_rad=leaned_rad)


def corrected(calibration: Calibration, error: Float) -> Calibration:
    """The calibration without an error (4,) of its axis, as motions.axis_error has it."""
    T_rig_hanger = calibration.T_rig_hanger(0.0)
    away = stepped(np.eye(4), np.r_[error[:2], 0.0, error[2:], 0.0])
    T_true_given = T_rig_hanger @ inverse(away) @ inverse(T_rig_hanger)
    direction = T_true_given[:3, :3] @ np.array(calibration.axis_direction)
    given = np.array([calibration.axis_point, calibration.gripper_tip])
    point, tip = transform_points(T_true_given, given).tolist()
    return replace(
        calibration,
        axis_point=tuple(point),
        axis_direction=tuple((direction / np.linalg.norm(direction)).tolist()),
        gripper_tip=tuple(tip),
    )


def to_hanger(calibration: Calibration, error: Float) -> Float:
    """(4, 4) from the common coordinates of views with an axis error to the true hanger frame."""
    away = stepped(np.eye(4), np.r_[error[:2], 0.0, error[2:], 0.0])
    T_rig_hanger = corrected(calibration, error).T_rig_hanger(0.0)
    return inverse(T_rig_hanger) @ calibration.T_rig_hanger(0.0) @ inverse(away)


def apart(given: Calibration, found: Calibration) -> tuple[float, float]:
    """Distance of two axes at the gripper tip of the first, m, and the angle between them, rad."""
    up, point = np.array(given.axis_direction), np.array(given.axis_point)
    at = point + ((np.array(given.gripper_tip) - point) @ up) * up
    away = np.cross(at - np.array(found.axis_point), np.array(found.axis_direction))
    cross = np.cross(given.axis_direction, found.axis_direction)
    lean = np.arcsin(min(1.0, float(np.linalg.norm(cross))))
    return float(np.linalg.norm(away)), float(lean)


def _contradiction(
    given: Calibration, surfaces: Sequence[ViewSurface], agreed: Agreement, config: RotationConfig
) -> str:
    """What else the views say of how the item turns, where little of their cloth lies on itself.

    Parameters
    ----------
    given : Calibration
    surfaces : sequence of ViewSurface
        Of the views, by it.
    agreed : Agreement
        Of these, registered as the joint has them.
    config : RotationConfig

    Returns
    -------
    str
        Empty where they fit together no better any other way.
    """
    if _agreement_if_still(given, surfaces, config).plainly_more_than(agreed):
        return _still(given)
    _, other_way = _reversed(given, surfaces)
    other = agreement(other_way, register_views(other_way, config), config)
    if other.plainly_more_than(agreed):
        return (
            f"the views fit together if the item turns the other way ({other.share:.0%} of "
            f"neighbouring views' cloth lies on itself, {agreed.share:.0%} as it is): set "
            f"joint_sign to {-given.joint_sign:g} in the calibration"
        )
    return ""


def _misplaced(agreed: Agreement) -> tuple[Notice, ...]:
    """Says that the views do not fit together."""
    text = _neither(agreed)
    return Notice("views_misplaced", text), Notice("untrusted", text)


def _off(error: Float, config: RotationConfig, given: Calibration) -> tuple[Notice, ...]:
    """Says that the axis of a calibration is off, if by so much that it should be corrected."""
    if _deviations(error, config) <= TOLD:
        return ()
    true = corrected(given, error)
    moved_m, leaned_rad = apart(given, true)
    text = (
        f"the item turns about an axis {1e3 * moved_m:.0f} mm and "
        f"{np.degrees(leaned_rad):.1f} degrees from that of the calibration; this "
        "result is about that one: 'vflatten calibrate' writes a calibration that has it"
    )
    return (Notice("axis_off", text),)


def _deviations(error: Float, config: RotationConfig) -> float:
    """How large an axis error (4,) is, in standard deviations of what is usual."""
    lean_rad, shift_m = np.hypot(*error[:2]), np.hypot(*error[2:])
    return float(max(lean_rad / np.radians(config.axis_deg), shift_m / config.axis_m))


def _rough(config: RotationConfig) -> RotationConfig:
    """For an axis that may be anywhere near."""
    return replace(
        config,
        axis_m=max(config.axis_m, ROUGH_M),
        axis_deg=max(config.axis_deg, ROUGH_DEG),
    )


def _about_true_axis(
    surfaces: Sequence[ViewSurface],
    poses: Sequence[Float],
    config: RotationConfig,
    progress: Progress,
) -> tuple[Sequence[Float], Float, RotationConfig]:
    """Poses, anew where the axis is far off; the axis' error (4,); the config that suits it."""
    angles = [surface.angle_rad for surface in surfaces]
    error = axis_error(angles, poses, config)
    if _deviations(error, config) <= FAR:
        return poses, error, config
    rough = _rough(config)
    for _ in range(ROUNDS):
        there = [stepped(np.eye(4), effect(angle) @ error) for angle in angles]
        placed = Folded(tuple(surfaces), tuple(there), rough)
        poses = register_views(surfaces, rough, progress, placed)
        before, error = error, axis_error(angles, poses, rough)
        if _deviations(error - before, config) < NEAR:
            break
    return poses, error, rough


def _refined(
    given: Calibration, seen: Sequence[ViewSurface], config: RotationConfig, progress: Progress
) -> Axis:
    """The axis in rounds: each begins where the last one left it."""
    rough = _rough(config)
    reaching = replace(rough, register_reach_m=ROUGH_REACH_M)
    calibration, near, best = given, False, 0.0
    for done in range(ROUNDS):
        progress("axis", done / ROUNDS)
        surfaces = [_by(calibration, given, surface, surface.angle_rad) for surface in seen]
        poses = register_views(surfaces, rough if near else reaching)
        agreed = agreement(surfaces, poses, config)
        error = axis_error([surface.angle_rad for surface in seen], poses, rough)
        calibration = corrected(calibration, error)
        small = np.hypot(*error[:2]) < FOUND_RAD and np.hypot(*error[2:]) < FOUND_M
        if (near and small) or (done >= FEWEST and agreed.share <= best):
            break
        near, best = agreed.enough, max(best, agreed.share)
    return Axis(calibration, 0.0, 0.0, agreed)


def _by(
    calibration: Calibration, given: Calibration, surface: ViewSurface, angle_rad: float
) -> ViewSurface:
    """A surface that is by the given calibration, by another one and at another angle."""
    T_rig_hanger = given.T_rig_hanger(surface.angle_rad)
    T_new_old = inverse(calibration.T_rig_hanger(angle_rad)) @ T_rig_hanger
    return turned(surface, T_new_old, angle_rad)


def _reversed(
    given: Calibration, surfaces: Sequence[ViewSurface]
) -> tuple[Calibration, list[ViewSurface]]:
    """Calibration and surfaces, had the item turned the other way."""
    other = replace(given, joint_sign=-given.joint_sign)
    return other, [_by(other, given, surface, -surface.angle_rad) for surface in surfaces]


def _agreement_if_still(
    given: Calibration, surfaces: Sequence[ViewSurface], config: RotationConfig
) -> Agreement:
    """As if the item had not turned at all."""
    still = [
        replace(_by(given, given, surface, 0.0), angle_rad=surface.angle_rad)
        for surface in surfaces
    ]
    return agreement(still, [np.eye(4)] * len(still), config)


def _still(calibration: Calibration) -> str:
    return (
        f"joint {calibration.joint!r} turns and the item does not: give the joint that turns it "
        "as 'joint' in the calibration"
    )


def _neither(agreed: Agreement) -> str:
    return (
        f"the views do not fit together: {agreed.share:.0%} of neighbouring views' cloth lies on "
        f"itself, expected {agreed.least:.0%} or more. Check the axis, that the item hangs still, "
        "and that joint states are in radians and of the same clock as the clouds"
    )
