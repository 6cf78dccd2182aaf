"""How noisy and how far apart the points are, and the lengths that suit them.

The lengths of RotationConfig are set for a good stereo rig a little more than a metre away. Noisier
points need wider fits, but those take more of the layers that hang close together for one: so fits
are widened by less than the noise would ask for, and samples of one sheet may be farther out of
line. Where points are farther apart, samples are, too, and both sides of a rim end farther from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.spatial import cKDTree

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.values import Float, Notice

AROUND = 20  # points through which a plane is laid
LOOKED_AT = 2000  # points of a view, at most
SEEN_SHARE = 0.75  # of the noise, most that neighbouring points do not have in common
MOST_NOISE, MOST_PITCH = 4.0, 2.5  # times what the config is for, beyond which nothing is widened
SURE = 1.15  # times the noise that a view shows, beyond which what other views tell counts
SMOOTHED = 2.0  # times that noise, as far as views differ if filters have taken most of it away
TRUSTED_NOISE = 3.0  # times, beyond which layers that touch are one, and legs a skirt
TOLD_NOISE, TOLD_PITCH = 1.4, 1.3  # times, beyond which the result says so


@dataclass(frozen=True)
class Grain:
    """Of the points on the item."""

    noise_m: float  # standard deviation from the planes of neighbours; more, as borne_out says
    pitch_m: float  # to the nearest neighbour


def grain_of(points: Float) -> Grain:
    """Median noise and pitch of one view's points (n, 3), n > 20.

    Noise that neighbouring points have in common does not show.
    """
    some = points[:: max(1, len(points) // LOOKED_AT)]
    distance, near = cKDTree(points).query(some, k=AROUND)
    around = points[near] - points[near].mean(axis=1, keepdims=True)
    across = np.linalg.eigvalsh(around.transpose(0, 2, 1) @ around)[:, 0].clip(0.0)
    noise = np.sqrt(np.median(across) / (AROUND - 3))  # a plane takes three of them
    return Grain(float(noise), float(np.median(distance[:, 1])))


def borne_out(grain: Grain, apart_m: float) -> Grain:
    """The grain that suits points whose neighbours have noise in common, which one view hides.

    Parameters
    ----------
    grain : Grain
        Typical of the views.
    apart_m : float
        Standard deviation of overlapping views' surfaces from each other: of what the points of a
        view have in common, twice. Of the noise that the config is for it is as large as the
        noise of the points; the same lengths suit if the sum of both is the same.
    """
    both = float(np.hypot(grain.noise_m, apart_m / np.sqrt(2.0)) / np.sqrt(1.5))
    return replace(grain, noise_m=both) if both > SURE * grain.noise_m else grain


def typical(grains: Sequence[Grain]) -> Grain:
    """The median of several views."""
    return Grain(
        float(np.median([grain.noise_m for grain in grains])),
        float(np.median([grain.pitch_m for grain in grains])),
    )


def suited(config: RotationConfig, grain: Grain) -> RotationConfig:
    """The config with its lengths widened for points noisier or farther apart than it is for.

    No length goes beyond its allowed range.
    """
    if not config.widen:
        return config
    noise, pitch = _times(config, grain)
    noise, pitch = min(noise, MOST_NOISE), min(pitch, MOST_PITCH)
    times = {
        "noise_m": noise,
        "pitch_m": pitch,
        "view_fit_m": noise**0.5,
        "fit_m": noise**0.3 * pitch**0.6,
        "step_m": noise**0.5,
        "spacing_m": pitch**0.6,
        "link_m": pitch**0.6,
        "rim_m": pitch,
    }
    most = {field.name: field.metadata["high"] for field in fields(config)}
    wider = {name: min(most[name], by * getattr(config, name)) for name, by in times.items()}
    return replace(config, **wider)


def notices_of(config: RotationConfig, grain: Grain, apart_m: float) -> tuple[Notice, ...]:
    """Says that the points are much coarser than the config is for, or smoothed, if they are.

    Parameters
    ----------
    config : RotationConfig
    grain : Grain
        Typical of the views, other views heard.
    apart_m : float
        Standard deviation of overlapping views' surfaces from each other.
    """
    notices = []
    if apart_m > SMOOTHED * grain.noise_m:
        text = (
            f"views differ by {1e3 * apart_m:.1f} mm where the points of one scatter by "
            f"{1e3 * grain.noise_m:.1f} mm only: filters that smooth the depth, or matching of "
            "large blocks, join layers; turn them off"
        )
        notices.append(Notice("smoothed_depth", text))
    noise, pitch = _times(config, grain)
    if noise > TOLD_NOISE or pitch > TOLD_PITCH:
        text = (
            f"the points scatter by {1e3 * grain.noise_m:.1f} mm and are "
            f"{1e3 * grain.pitch_m:.1f} mm apart, the method is set for "
            f"{SEEN_SHARE * 1e3 * config.noise_m:.1f} and {1e3 * config.pitch_m:.1f} mm: layers "
            "that hang close together may be taken for one; hold the item nearer to the rig"
        )
        notices.append(Notice("coarse_points", text))
    return tuple(notices)


def too_noisy(config: RotationConfig, grain: Grain) -> str:
    """Why no result from such points should be trusted; empty: it may be."""
    times = _times(config, grain)[0]
    if times <= TRUSTED_NOISE:
        return ""
    return (
        f"the points scatter by {1e3 * grain.noise_m:.1f} mm, {times:.1f} times as much as the "
        "method is set for: layers that touch cannot be told apart"
    )


def _times(config: RotationConfig, grain: Grain) -> tuple[float, float]:
    """How much noisier and farther apart, at least 1."""
    noise = grain.noise_m / (SEEN_SHARE * config.noise_m)
    return max(1.0, noise), max(1.0, grain.pitch_m / config.pitch_m)
