"""The ends of a sheet that looks the same turned by half a turn: names that do not hang on chance.

Nothing tells the two ends of a towel apart but how it hangs. By convention the end at the gripper
is the one called bottom, as in most simulated recordings: what hangs lowest is at the top.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from vflatten_ros.core.measurement import half_turn_about, held_above_m
from vflatten_ros.core.recognition import UNKNOWN, Recognition, likeliest_of
from vflatten_ros.core.template_fit import Fit, place
from vflatten_ros.core.values import FlatPoints


def held_end_below(found: Recognition, points: FlatPoints) -> Recognition:
    """The same, turned by half a turn if the gripper would hold the upper end of a single sheet.

    Only names change: the outline, the sizes and how certain they are stay as they were.

    Parameters
    ----------
    found : Recognition
    points : FlatPoints
        Of the same item, hanging from the origin of the hanger frame.
    """
    fit = found.fit
    if fit is None or found.category == UNKNOWN or not fit.template.single_sheet:
        return found
    middle = half_turn_about(fit)
    if middle is None or held_above_m(fit, points, middle) <= 0.0:
        return found
    turned = replace(found, fits={**found.fits, found.category: half_turned(fit)})
    return likeliest_of(turned, found.probabilities)


def half_turned(fit: Fit) -> Fit:
    """The same outline in the flat frame, fitted by its template half a turn about its middle.

    Parameters
    ----------
    fit : Fit
        Of a template whose outline is the same after half a turn.
    """
    k = fit.template.vertices
    placed, slope = place(fit.template, fit.pose, fit.state)
    middle, middle_slope = placed[:k].mean(axis=0), slope[:k].mean(axis=0)
    onto = cKDTree(placed[:k]).query(2.0 * middle - placed[:k])[1]
    change = np.eye(len(fit.covariance))  # the place goes to twice the middle less itself
    change[1:3] = 2.0 * middle_slope - change[1:3]
    return replace(
        fit,
        pose=np.r_[fit.pose[0] + np.pi, 2.0 * middle - fit.pose[1:]],
        covariance=change @ fit.covariance @ change.T,
        edge_seen=fit.edge_seen[onto],
    )
