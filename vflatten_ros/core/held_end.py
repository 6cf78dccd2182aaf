"""The ends of a sheet that looks the same turned by half a turn: names that do not hang on chance.

Nothing tells the two ends of a towel apart but how it hangs. By convention the end at the gripper
is the one called bottom, as in the recordings in bags/: what hangs lowest is at the top.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vflatten_ros.core.config import RecognitionConfig
from vflatten_ros.core.measurement import half_turn_about, held_above_m
from vflatten_ros.core.recognition import UNKNOWN, Recognition, recognise
from vflatten_ros.core.values import FlatPoints, Outline


def held_end_below(
    found: Recognition, outline: Outline, points: FlatPoints, config: RecognitionConfig
) -> Recognition:
    """The same, turned by half a turn if the gripper would hold the upper end of a single sheet.

    Parameters
    ----------
    found : Recognition
        Of the outline and the points.
    outline : Outline
    points : FlatPoints
        Hanging from the origin of the hanger frame.
    config : RecognitionConfig

    Raises
    ------
    InvalidInput
        As recognise.
    """
    fit = found.fit
    if fit is None or found.category == UNKNOWN or not fit.template.single_sheet:
        return found
    middle = half_turn_about(fit)
    if middle is None or held_above_m(fit, points, middle) <= 0.0:
        return found
    name, template = found.category, fit.template
    pose = np.r_[fit.pose[0] + np.pi, 2.0 * middle - fit.pose[1:]]
    turned = recognise(outline, points, (template,), config, begin={name: (pose, fit.state)})
    return replace(
        found,
        fit=turned.fits[name],
        fits={**found.fits, name: turned.fits[name]},
        template_uv=turned.fits[name].points()[: template.vertices],
        template_seen=turned.fits[name].vertex_seen()[: template.vertices],
    )
