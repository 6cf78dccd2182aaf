"""Every default, once: frozen dataclasses that become ROS parameters, config/*.yaml and docs."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar, get_type_hints

from vflatten_ros.core.errors import InvalidConfig

Section = TypeVar("Section", bound="Checked")
METHODS = ("rotation", "kita2019")


def option(
    default: Any,
    doc: str,
    *,
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    read_only: bool = False,
) -> Any:
    """A configuration field with its description and allowed range.

    `low` and `high` are inclusive. `read_only`: cannot change while the node is active.
    """
    metadata = {"doc": doc, "low": low, "high": high, "choices": choices, "read_only": read_only}
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class Checked:
    """A section whose fields are checked against their type, range and choices."""

    def __post_init__(self) -> None:
        types = get_type_hints(type(self))
        for item in dataclasses.fields(self):
            _check(item, types[item.name], getattr(self, item.name))


def _check(item: dataclasses.Field[Any], kind: Any, value: Any) -> None:
    name = item.name
    if kind is float and type(value) not in (float, int):
        raise InvalidConfig(f"{name}: expected a number, got {value!r}")
    if kind in (int, bool, str) and type(value) is not kind:
        raise InvalidConfig(f"{name}: expected {kind.__name__}, got {value!r}")
    low, high = item.metadata.get("low"), item.metadata.get("high")
    if (low is not None and not value >= low) or (high is not None and not value <= high):
        raise InvalidConfig(
            f"{name}: expected {low} to {high}, got {value}; {item.metadata['doc']}"
        )
    choices = item.metadata.get("choices", ())
    if choices and value not in choices:
        raise InvalidConfig(f"{name}: expected one of {', '.join(choices)}, got {value!r}")


@dataclass(frozen=True)
class JointConfig(Checked):
    """Wrist angle at a cloud's stamp."""

    max_age_s: float = option(
        0.1,
        "Farthest either joint state may be from the cloud's stamp between them, s.",
        low=0.001,
        high=10.0,
    )
    wait_s: float = option(
        1.0, "How long a cloud waits for its joint states, s.", low=0.0, high=60.0
    )
    history_s: float = option(30.0, "Joint states kept, s.", low=1.0, high=3600.0)


@dataclass(frozen=True)
class SegmentationConfig(Checked):
    """Which points of a cloud belong to the item."""

    radius_m: float = option(
        0.6, "Farthest an item point may be from the wrist axis, m.", low=0.05, high=5.0
    )
    length_m: float = option(
        2.5, "Farthest an item point may hang below the gripper tip, m.", low=0.1, high=10.0
    )
    tip_clearance_m: float = option(
        0.008,
        "Points less than this below the gripper tip are the gripper's, m.",
        low=-0.1,
        high=0.5,
    )
    link_m: float = option(0.015, "Points nearer than this are one piece, m.", low=0.003, high=0.1)
    gap_m: float = option(
        0.15,
        "A piece belongs to the item if no wider gap parts it from the rest or the tip, m; "
        "three times as wide along the axis.",
        low=0.0,
        high=1.0,
    )
    piece_area_m2: float = option(
        0.0001, "Pieces that show less than this area are noise, m2.", low=0.0, high=0.1
    )
    support_m: float = option(
        0.01, "Neighbours within this depth support a point, m.", low=0.001, high=0.1
    )
    support_points: int = option(
        2, "A point with fewer neighbours at its depth is a flying pixel.", low=0, high=20
    )
    trim_px: int = option(
        0,
        "Pixels taken off where the item ends or hides itself, for stereo that makes what is in "
        "front wider by so much: up to half the block that it matches; organised clouds only.",
        low=0,
        high=50,
    )
    wall_m: float = option(
        0.015, "Half the thickness taken for a wall or table, m.", low=0.001, high=0.1
    )
    wall_area_m2: float = option(
        0.05,
        "Planes that show less area outside of the radius are no walls, m2.",
        low=0.001,
        high=10.0,
    )
    min_points: int = option(100, "Views with fewer item points are dropped.", low=3, high=100000)


@dataclass(frozen=True)
class BufferConfig(Checked):
    """How many views are kept."""

    max_views: int = option(128, "Most views kept at a time.", low=2, high=10000)
    max_megabytes: float = option(512.0, "Most memory for views, MB.", low=1.0, high=65536.0)
    max_waiting: int = option(
        32, "Most clouds that wait for joint states at a time.", low=1, high=1000
    )
    duplicate_angle_deg: float = option(
        2.0, "Views nearer in angle replace one another, the better stays, deg.", low=0.0, high=45.0
    )
    max_rate_rad_s: float = option(
        0.0,
        "Clouds taken while the wrist turns faster are dropped, rad/s; 0: never.",
        low=0.0,
        high=100.0,
    )
    swing_m: float = option(
        0.03,
        "An item whose middle moved by more at the same angle has swung: the newer view stays, m; "
        "0: not checked.",
        low=0.0,
        high=1.0,
    )
    max_gap_deg: float = option(
        45.0,
        "Largest angle between neighbouring views of a complete rotation, deg.",
        low=1.0,
        high=180.0,
    )
    min_views: int = option(6, "Fewest views of a complete rotation.", low=2, high=1000)
    clock_jump_s: float = option(
        1.0,
        "Stamps that step back by more mean that the clock was set back, s.",
        low=0.01,
        high=3600.0,
    )
    finger_joints: str = option(
        "finger_left,finger_right",
        "Joints whose opening and closing starts a new item, by commas; empty: none.",
    )
    finger_open: float = option(
        0.02,
        "Fingers are open where their mean position is above this, m or rad.",
        low=-10.0,
        high=10.0,
    )
    finger_closed: float = option(
        0.01, "Open fingers are closed again below this, m or rad.", low=-10.0, high=10.0
    )


@dataclass(frozen=True)
class SurfaceConfig(Checked):
    """Local fit of the cloth's surface."""

    fit: str = option(
        "quadratic",
        "Local fit: 'linear' in (x, y) as the paper's, or 'quadratic' in the local tangent frame.",
        choices=("quadratic", "linear"),
    )
    radius_m: float = option(0.0115, "Radius r0 of the local fit, m.", low=0.002, high=0.1)
    along_rulings: bool = option(
        True, "Average the quadratic fit along the straight lines of the cloth."
    )


@dataclass(frozen=True)
class BoundaryConfig(Checked):
    """Points on the boundary of the observed region (paper, section 3)."""

    spacing_m: float = option(0.02, "Distance between boundary points, m.", low=0.002, high=0.2)


@dataclass(frozen=True)
class PatchConfig(Checked):
    """Parts of a view that no crease and no depth jump cuts apart."""

    step_m: float = option(
        0.003,
        "Smallest step between neighbouring pixels that parts two layers, m.",
        low=1e-4,
        high=0.1,
    )
    step_sigmas: float = option(
        4.0, "The same in standard deviations of the steps that noise makes.", low=1.0, high=20.0
    )
    lone_step_m: float = option(
        0.008, "The same where too few pixels are around for the slopes, m.", low=1e-4, high=0.1
    )
    jump_m: float = option(
        0.03,
        "Change of depth to the next pixel that is a step on any slope, m.",
        low=0.001,
        high=1.0,
    )
    margin_px: int = option(
        2,
        "Patches do not join through what is this near to a line of steps, pixels.",
        low=0,
        high=20,
    )
    gap_px: int = option(
        5,
        "Where other cloth follows within this, a patch's end need not be the item's, pixels.",
        low=1,
        high=50,
    )
    min_points: int = option(40, "Patches of fewer pixels are left out.", low=3, high=100000)


@dataclass(frozen=True)
class GeodesicConfig(Checked):
    """Shortest lines along the surface (paper, section 2.1)."""

    solver: str = option(
        "newton",
        "'springs': the paper's on its linear fit; 'newton': Gauss-Newton on the fitted surface.",
        choices=("newton", "springs"),
    )
    nodes: int = option(50, "Nodes M of a line.", low=3, high=500)
    height_window_m: float = option(
        0.05,
        "Pairs of boundary points nearer in height than this get a line, m.",
        low=0.0,
        high=2.0,
    )


@dataclass(frozen=True)
class IntegrationConfig(Checked):
    """Joining two views of the two-view method (paper, section 3)."""

    evidence: str = option(
        "surface",
        "'boundary': the paper's boundary points and lines; 'surface': samples of all cloth.",
        choices=("surface", "boundary"),
    )
    overlap: bool = option(
        True,
        "With 'surface': join the views by all cloth that both show, not by given points alone.",
    )
    spacing_m: float = option(0.009, "Spacing of the surface samples, m.", low=0.002, high=0.1)
    pair_sigma_m: float = option(
        0.003, "Error of a corresponding point, one sigma, m.", low=1e-4, high=0.1
    )
    pair_reach_px: int = option(
        3, "A corresponding pixel this near to the item is moved onto it, pixels.", low=0, high=50
    )
    reject_m: float = option(
        0.015,
        "Corresponding points this far from where the others put them are left out, m.",
        low=0.001,
        high=0.5,
    )
    sway_m: float = option(0.01, "How far the item sways between the views, m.", low=1e-4, high=0.2)
    lag_deg: float = option(0.5, "How far it lags behind the wrist, deg.", low=0.0, high=20.0)
    same_m: float = option(
        0.003, "Surfaces of two views this near show the same cloth, m.", low=1e-4, high=0.05
    )


@dataclass(frozen=True)
class CorrespondenceConfig(Checked):
    """Corresponding points that are found without a person."""

    count: int = option(8, "Most points found for two views.", low=2, high=1000)
    reach_m: float = option(
        0.003, "Points of two registered views farther apart are not the same, m.",
        low=5e-4, high=0.05,
    )  # fmt: skip
    features: bool = option(True, "Look for features of the colour image, too.")
    feature_reach_m: float = option(
        0.015, "How far a feature may be from where the surfaces put it, m.", low=0.001, high=0.2
    )
    feature_ratio: float = option(
        0.8, "Most that a feature may differ, as a share of the next best.", low=0.1, high=1.0
    )
    feature_most: float = option(
        300.0, "Most that features of the same place differ in their descriptor.", low=1.0, high=1e4
    )
    check_pairs: int = option(
        4,
        "Pairs of neighbouring views whose features check the registration of all views; 0: none.",
        low=0,
        high=1000,
    )
    slide_m: float = option(
        0.003, "Features this far from where the registration puts them are told, m.",
        low=1e-4, high=0.1,
    )  # fmt: skip
    feature_agree_m: float = option(
        0.004, "Features agree that one motion brings this near, m.", low=0.001, high=0.05
    )


@dataclass(frozen=True)
class ViewsConfig(Checked):
    """Choosing views."""

    apart_deg: float = option(
        150.0, "Two views farther apart are no pair for the two-view method, deg.",
        low=10.0, high=180.0,
    )  # fmt: skip
    pairs: int = option(
        6, "Most pairs of views that the two-view method tries by itself.", low=1, high=1000
    )
    enough_probability: float = option(
        0.9, "Least probability of the category for the views to be enough.", low=0.0, high=1.0
    )
    enough_sigma: float = option(
        0.06, "Most deviation, one sigma, of width and length for that, as a share of each.",
        low=0.0, high=1.0,
    )  # fmt: skip


@dataclass(frozen=True)
class FlatteningConfig(Checked):
    """Distances to plane (paper, section 2.2)."""

    solver: str = option(
        "majorization",
        "'springs' as the paper's, or 'majorization': weighted robust stress majorisation.",
        choices=("majorization", "springs"),
    )
    spring_steps: int = option(20000, "Most steps of the springs.", low=1, high=1000000)
    rounds: int = option(8, "Most reweightings of the majorisation.", low=1, high=1000)
    inner_steps: int = option(
        10, "Steps of the majorisation with the same weights.", low=1, high=1000
    )
    robust_sigmas: float = option(
        4.0, "Distances off by more standard deviations lose their say.", low=0.5, high=100.0
    )
    tolerance_m: float = option(
        2e-6, "The search ends when points move less, m.", low=1e-9, high=0.01
    )


@dataclass(frozen=True)
class AssemblyConfig(Checked):
    """Placing pieces that hidden folds part from the rest, by the category's outline."""

    rotations: int = option(60, "Rotations tried.", low=4, high=3600)
    hinges: int = option(
        5, "Places tried for the tip of a fold between two pieces.", low=1, high=100
    )
    categories: int = option(
        3, "Likeliest categories for which pieces are placed with care.", low=1, high=100
    )
    hopeless: float = option(
        15.0,
        "Outlines that fit worse than the best by this, in halves of sigma squared, are dropped.",
        low=0.0,
        high=1000.0,
    )
    alternations: int = option(
        3,
        "Times that pieces are placed and the outline is fitted, in turns; 0: not.",
        low=0,
        high=100,
    )
    touch_m: float = option(0.012, "Cloth this near as it hangs may touch, m.", low=0.001, high=0.1)
    joined_m: float = option(
        0.006, "Cloth this near as it hangs is joined there, m.", low=0.0005, high=0.1
    )
    overlap_m: float = option(
        0.004, "Pieces may overlap by so much in the plane, m.", low=0.0, high=0.1
    )
    hinge_m: float = option(
        0.01,
        "How far from there the pieces may meet in the plane, one sigma, m.",
        low=0.001,
        high=0.5,
    )
    misfit_m: float = option(
        0.01, "How far ends may be from the category's outline, one sigma, m.", low=0.001, high=0.1
    )
    end_weight: float = option(
        6.0, "Independent observations that a piece's ends count for.", low=0.0, high=1000.0
    )
    inner_weight: float = option(
        6.0, "The same for its cloth, which must be inside the outline.", low=0.0, high=1000.0
    )
    overlap_weight: float = option(
        60.0, "The same for its cloth, which must not lie on other cloth.", low=0.0, high=10000.0
    )
    chord_weight: float = option(
        60.0,
        "The same for how much farther apart points hang than it is along the cloth.",
        low=0.0,
        high=10000.0,
    )
    slack_weight: float = option(
        10.0,
        "The same for how much farther apart they lie than they hang: any chord up to the way "
        "along the cloth is as likely.",
        low=0.0,
        high=1000.0,
    )
    sigma_m: float = option(
        0.006, "Error of the outline where pieces were placed, one sigma, m.", low=0.0, high=0.1
    )
    turn_rad: float = option(
        0.1, "How far a placed piece may be turned wrongly, one sigma, rad.", low=0.0, high=1.0
    )
    shift_m: float = option(
        0.02, "How far a placed piece may be off, one sigma, m.", low=0.0, high=0.2
    )


@dataclass(frozen=True)
class ContourConfig(Checked):
    """Flattened points to outline."""

    cell_m: float = option(
        0.002, "Cell of the raster that unites the views, m.", low=5e-4, high=0.02
    )
    close_m: float = option(
        0.003,
        "Gaps of the flattened surface narrower than twice this are closed, m.",
        low=0.0,
        high=0.1,
    )
    bridge_m: float = option(
        0.04,
        "The same for gaps between ends of what was seen, not of the item, m.",
        low=0.0,
        high=0.5,
    )
    spacing_m: float = option(0.005, "Spacing of the outline's points, m.", low=0.001, high=0.1)
    smooth_m: float = option(0.003, "Smoothing along the outline, one sigma, m.", low=0.0, high=0.1)
    seen_m: float = option(
        0.006, "Outline farther than this from seen cloth is not seen, m.", low=0.001, high=0.1
    )


@dataclass(frozen=True)
class RecognitionConfig(Checked):
    """Outline to category (paper, eq. 11; fit of the categories' outlines)."""

    decay: float = option(
        0.05, "Decay of eq. 11's model images, in longest lengths.", low=0.005, high=0.5
    )
    model_rotations: int = option(180, "Rotations tried by eq. 11.", low=8, high=3600)
    fit_rotations: int = option(
        24, "Rotations from which the outlines are fitted.", low=4, high=360
    )
    misfit_m: float = option(
        0.008,
        "How far cuts differ from the categories' outlines, one sigma, m.",
        low=0.001,
        high=0.1,
    )
    correlation_m: float = option(
        0.08, "Length of outline over which errors are alike, m.", low=0.005, high=1.0
    )
    unknown_misfit: float = option(
        1.0, "Misfit, in sigma squared halves, at which 'unknown' wins.", low=0.1, high=20.0
    )


@dataclass(frozen=True)
class MeasurementConfig(Checked):
    """Category and outline to sizes and landmarks."""

    landmark_radius_m: float = option(
        0.02,
        "Farthest seen point from a landmark whose place in 3-D it gives, m.",
        low=0.002,
        high=0.2,
    )
    layer_gap_m: float = option(
        0.02,
        "Points of one flat place farther apart in 3-D lie on two layers, m.",
        low=0.002,
        high=0.5,
    )
    few_views_factor: float = option(
        1.6,
        "Factor on the deviations of what one or two views give: edges err as a whole there, "
        "where cloth is hidden in folds; measured over recordings.",
        low=1.0,
        high=10.0,
    )
    unseen_share: float = option(
        0.08,
        "Share of a size, one sigma, that lies beyond what is seen, where no view shows its end; "
        "measured over recordings.",
        low=0.0,
        high=1.0,
    )
    low_coverage: float = option(
        0.75, "Share of the item seen below which the result says so.", low=0.0, high=1.0
    )
    trusted_quality: float = option(
        0.3, "Quality below which sizes are not to be trusted.", low=0.0, high=1.0
    )


@dataclass(frozen=True)
class RotationConfig(Checked):
    """The automatic method: one surface model from all views."""

    noise_m: float = option(
        0.001, "Depth noise of one point that the lengths below are for, m.", low=1e-5, high=0.02
    )
    pitch_m: float = option(
        0.0026,
        "Distance of neighbouring points that the lengths below are for, m.",
        low=1e-4,
        high=0.05,
    )
    widen: bool = option(
        True,
        "Widen the lengths of fits, samples and links where points are noisier or farther apart.",
    )
    trim_edges: bool = option(
        True,
        "Take points off that stereo adds beside edges and where nothing is, as other views tell.",
    )
    view_fit_m: float = option(
        0.012, "Radius of the local planes of a single view, m.", low=0.002, high=0.1
    )
    sway_m: float = option(0.003, "How far the item sways, m.", low=1e-5, high=0.1)
    lag_deg: float = option(0.5, "How far the item lags behind the wrist, deg.", low=0.001, high=20)
    axis_m: float = option(0.003, "Error of the calibrated axis' place, m.", low=1e-5, high=0.1)
    axis_deg: float = option(
        0.5, "Error of the calibrated axis' direction, deg.", low=0.001, high=20.0
    )
    overlap_deg: float = option(
        50.0, "Views nearer in angle are registered to one another, deg.", low=1.0, high=180.0
    )
    register_points: int = option(500, "Points of a view that are registered.", low=50, high=100000)
    register_reach_m: float = option(
        0.008, "Points farther apart are not the same cloth, m.", low=0.001, high=0.1
    )
    register_rounds: int = option(4, "Most rounds of the registration.", low=1, high=100)
    spacing_m: float = option(0.005, "Spacing of the surface samples, m.", low=0.001, high=0.05)
    fit_m: float = option(
        0.007, "Radius of the local fit of a sample to all views, m.", low=0.002, high=0.05
    )
    link_m: float = option(0.011, "Longest link between samples, m.", low=0.002, high=0.1)
    step_m: float = option(
        0.00055, "Largest step between linked samples, along their normal, m.", low=1e-5, high=0.02
    )
    overlap: float = option(
        0.3, "Least share of neighbours that linked samples have in common.", low=0.0, high=1.0
    )
    rim_m: float = option(0.007, "Longest link round a sharp rim, m.", low=0.001, high=0.05)
    rim_detour_m: float = option(
        0.003, "Added to links round rims, so that paths prefer the sheet, m.", low=0.0, high=0.05
    )
    valley_m: float = option(
        0.001, "Deepest groove that a link round a rim may cross, m.", low=0.0, high=0.02
    )
    ramp: float = option(
        2.8e-4,
        "Height of a step (m) times tilt (rad) above which a sample may join two layers.",
        low=1e-6,
        high=0.1,
    )
    rim_length_m: float = option(
        0.12, "Length of rim that must agree for two pieces to be joined, m.", low=0.02, high=10.0
    )
    draw: int = option(
        0,
        "Which samples of the surface to begin with, of many alike; others show what is chance.",
        low=0,
        high=100000,
    )
    ways: int = option(
        7,
        "Most ways to lay the item flat that are tried; with fewer, hard items come out sooner, "
        "and more of them unknown or not to be trusted.",
        low=1,
        high=7,
    )
    landmarks: int = option(300, "Samples whose mutual distances are unfolded.", low=50, high=5000)
    local_m: float = option(
        0.25, "Nearer pairs on one sheet keep their distance both ways, m.", low=0.01, high=2.0
    )
    close_m: float = option(
        0.003,
        "Gaps between flattened samples narrower than twice this are closed, m.",
        low=0.002,
        high=0.1,
    )
    edge_blur_m: float = option(
        0.004, "Blur of the flattened samples' density, m.", low=0.001, high=0.05
    )
    edge_density: float = option(
        0.6, "Share of one layer's density at the outline.", low=0.05, high=1.0
    )
    uv_sigma_m: float = option(
        0.004, "Least standard deviation of a flattened point, m.", low=1e-4, high=0.1
    )
    outline_sigma_m: float = option(
        0.002,
        "Error that all of an outline shares, so that no length of it averages it out, m.",
        low=0.0,
        high=0.1,
    )
    high_stress_m: float = option(
        0.01, "Contradiction of distances above which the result says so, m.", low=1e-4, high=1.0
    )
    hidden_m: float = option(
        0.01,
        "Layers nearer than this hide one another's edges, where no camera tells, m.",
        low=0.001,
        high=0.1,
    )
    untrusted_overlap: float = option(
        0.1,
        "Share of the surface lying on more of its side above which the result says so.",
        low=0.0,
        high=1.0,
    )
    unfold_rounds: int = option(10, "Reweightings at each strength of spreading.", low=1, high=1000)


@dataclass(frozen=True)
class Config:
    """All settings of the method."""

    method: str = "rotation"
    joints: JointConfig = JointConfig()
    segmentation: SegmentationConfig = SegmentationConfig()
    buffer: BufferConfig = BufferConfig()
    surface: SurfaceConfig = SurfaceConfig()
    boundary: BoundaryConfig = BoundaryConfig()
    patches: PatchConfig = PatchConfig()
    geodesics: GeodesicConfig = GeodesicConfig()
    integration: IntegrationConfig = IntegrationConfig()
    correspondences: CorrespondenceConfig = CorrespondenceConfig()
    views: ViewsConfig = ViewsConfig()
    flattening: FlatteningConfig = FlatteningConfig()
    assembly: AssemblyConfig = AssemblyConfig()
    contour: ContourConfig = ContourConfig()
    recognition: RecognitionConfig = RecognitionConfig()
    measurement: MeasurementConfig = MeasurementConfig()
    rotation: RotationConfig = RotationConfig()

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise InvalidConfig(
                f"method: expected one of {', '.join(METHODS)}, got {self.method!r}"
            )


def sections() -> Iterator[tuple[str, type[Checked]]]:
    """Name and class of every section, in the order of Config."""
    types = get_type_hints(Config)
    for item in dataclasses.fields(Config):
        kind = types[item.name]
        if isinstance(kind, type) and issubclass(kind, Checked):
            yield item.name, kind


def flatten_config(config: Config) -> dict[str, Any]:
    """Every setting as 'section.name' -> value."""
    flat: dict[str, Any] = {"method": config.method}
    for name, _ in sections():
        for item in dataclasses.fields(getattr(config, name)):
            flat[f"{name}.{item.name}"] = getattr(getattr(config, name), item.name)
    return flat


def config_from(values: Mapping[str, Any], base: Config | None = None) -> Config:
    """A configuration from 'section.name' -> value (or nested mappings), other values from `base`.

    Raises
    ------
    InvalidConfig
        An unknown name, a wrong type or a value outside its range.
    """
    base = base or Config()
    known = flatten_config(base)
    given = dict(_walk(values))
    unknown = sorted(set(given) - set(known))
    if unknown:
        raise InvalidConfig(f"unknown setting {unknown[0]!r}; known are: {', '.join(known)}")
    changed: dict[str, Any] = {}
    if "method" in given:
        changed["method"] = given["method"]
    for name, _ in sections():
        changed[name] = changed_section(getattr(base, name), f"{name}.", given)
    return dataclasses.replace(base, **changed)


def changed_section(section: Section, prefix: str, values: Mapping[str, Any]) -> Section:
    """A section with those of the values, named with the prefix, that are its own.

    Raises
    ------
    InvalidConfig
        As the section itself does of a value, with the prefix before its name.
    """
    names = [item.name for item in dataclasses.fields(section)]
    own = {name: values[prefix + name] for name in names if prefix + name in values}
    if not own:
        return section
    types = get_type_hints(type(section))
    for name, value in own.items():
        if types[name] is float and type(value) is int:
            own[name] = float(value)
    try:
        return dataclasses.replace(section, **own)
    except InvalidConfig as error:
        raise InvalidConfig(f"{prefix}{error}") from error


def _walk(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _walk(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
