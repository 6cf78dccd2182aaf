"""ROS parameters, declared from the dataclasses of the settings; also writes their reference."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, get_type_hints

from vflatten_ros.core.config import (
    METHODS,
    Checked,
    Config,
    changed_section,
    config_from,
    flatten_config,
    option,
    sections,
)
from vflatten_ros.core.errors import InvalidConfig

if TYPE_CHECKING:
    from rclpy.node import Node

NO_VECTOR = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class NodeOptions(Checked):
    """What the node does by itself (names without a prefix)."""

    autostart: bool = option(
        True, "Configure and activate at start, without a lifecycle manager.", read_only=True
    )
    auto_flatten: bool = option(True, "Flatten by itself when a rotation is complete.")
    look_early_deg: float = option(
        0.0,
        "Flatten every so many degrees before the rotation is complete, to say when the views are "
        "enough, deg; 0: not. Each look is a flattening; with method rotation only.",
        low=0.0,
        high=360.0,
    )
    categories: str = option(
        "", "Folder of the category files; empty: those that come with the package.", read_only=True
    )
    no_data_warning_s: float = option(
        5.0, "Warn when no cloud or joint state has come for so long, s.", low=0.5, high=3600.0
    )
    max_queued_goals: int = option(
        4,
        "Goals that may wait for the one being worked on; further ones get BUSY.",
        low=0,
        high=100,
    )
    worker_processes: int = option(
        2,
        "Processes that flatten; with 2, and more than one core, one tries other ways of laying "
        "the item flat meanwhile (method rotation). The result is the same.",
        low=1,
        high=2,
        read_only=True,
    )
    worker_nice: int = option(
        5,
        "How far the flattening process gives way to others (nice).",
        low=0,
        high=19,
        read_only=True,
    )


@dataclass(frozen=True)
class CloudInput(Checked):
    """Where the clouds come from."""

    topic: str = option("rig/points", "Topic of the PointCloud2.", read_only=True)
    reliability: str = option(
        "best_effort",
        "'best_effort' (sensor data) accepts every publisher, 'reliable' only reliable ones.",
        choices=("best_effort", "reliable"),
        read_only=True,
    )
    durability: str = option(
        "volatile",
        "'transient_local' also asks for what was published before the node came.",
        choices=("volatile", "transient_local"),
        read_only=True,
    )
    depth: int = option(20, "Clouds held while the node is busy.", low=1, high=1000, read_only=True)


@dataclass(frozen=True)
class JointInput(Checked):
    """Where the joint states come from."""

    topic: str = option("gripper/joint_states", "Topic of the JointState.", read_only=True)
    reliability: str = option(
        "best_effort",
        "'best_effort' (sensor data) accepts every publisher, 'reliable' only reliable ones.",
        choices=("best_effort", "reliable"),
        read_only=True,
    )
    durability: str = option(
        "volatile",
        "'transient_local' also asks for what was published before the node came.",
        choices=("volatile", "transient_local"),
        read_only=True,
    )
    depth: int = option(
        500, "Joint states held while the node is busy.", low=1, high=10000, read_only=True
    )


@dataclass(frozen=True)
class CalibrationOptions(Checked):
    """Where the wrist axis is, as seen by the rig. A file, or the numbers themselves, or TF."""

    file: str = option(
        "", "calibration.yaml; empty: the other calibration parameters hold.", read_only=True
    )
    frame: str = option("", "frame_id of the clouds.", read_only=True)
    axis_point: tuple[float, ...] = option(
        NO_VECTOR, "A point of the wrist axis, rig frame, m.", read_only=True
    )
    axis_direction: tuple[float, ...] = option(
        NO_VECTOR, "Direction of the wrist axis, upwards, rig frame.", read_only=True
    )
    gripper_tip: tuple[float, ...] = option(
        NO_VECTOR, "Where the item is held, rig frame, m.", read_only=True
    )
    joint: str = option("", "Name of the wrist joint in the joint states.", read_only=True)
    joint_sign: float = option(
        1.0,
        "+1 or -1: +1 where the item angle grows with the joint.",
        read_only=True,
    )
    joint_zero: float = option(0.0, "Joint position at item angle 0, rad.", read_only=True)
    tf_frame: str = option(
        "",
        "Take axis and tip from TF (needs tf2_ros): a frame with its origin at the gripper tip and "
        "z up along the wrist axis. Frame, joint, sign and zero are still given.",
        read_only=True,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.joint_sign not in (1.0, -1.0):
            raise InvalidConfig(
                f"joint_sign: expected +1 or -1, got {self.joint_sign:g}; "
                "+1 where the item angle grows with the joint"
            )


@dataclass(frozen=True)
class OutputOptions(Checked):
    """What is published beside the flattened view and the estimate."""

    markers: bool = option(True, "Publish the MarkerArray.")
    image: bool = option(True, "Publish the Image of the flattened item.")
    points: bool = option(True, "Publish the PointCloud2 of the used points with u, v.")


@dataclass(frozen=True)
class NodeConfig:
    """All settings of the node that are not the method's."""

    node: NodeOptions = NodeOptions()
    clouds: CloudInput = CloudInput()
    joint_states: JointInput = JointInput()
    calibration: CalibrationOptions = CalibrationOptions()
    outputs: OutputOptions = OutputOptions()


@dataclass(frozen=True)
class Entry:
    """One parameter."""

    name: str
    kind: Any  # bool, int, float, str, tuple[float, ...] or tuple[str, ...]
    default: Any
    doc: str
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    read_only: bool = False  # while the node is active


def node_sections() -> Iterator[tuple[str, str, type[Checked]]]:
    """Field of NodeConfig, prefix of the parameter names, class."""
    types = get_type_hints(NodeConfig)
    for item in dataclasses.fields(NodeConfig):
        yield item.name, "" if item.name == "node" else f"{item.name}.", types[item.name]


def entries() -> list[Entry]:
    """Every parameter of the node, the node's own first."""
    found: list[Entry] = []
    for _, prefix, kind in node_sections():
        found += _entries_of(prefix, kind)
    doc = "Which method flattens, unless a goal names one."
    found.append(Entry("method", str, Config().method, doc, choices=METHODS))
    for name, kind in sections():
        found += _entries_of(f"{name}.", kind)
    return found


def _entries_of(prefix: str, section: type[Checked]) -> Iterator[Entry]:
    types = get_type_hints(section)
    for item in dataclasses.fields(section):
        about = item.metadata
        yield Entry(
            name=prefix + item.name,
            kind=types[item.name],
            default=item.default,
            doc=about["doc"],
            low=about["low"],
            high=about["high"],
            choices=about["choices"],
            read_only=about["read_only"],
        )


@dataclass(frozen=True)
class Settings:
    """The method's and the node's settings of one moment."""

    core: Config = Config()
    node: NodeConfig = NodeConfig()

    def changed(self, values: Mapping[str, Any]) -> Settings:
        """The same with other values; raises InvalidConfig with the reason."""
        core_names = flatten_config(self.core)
        core = config_from({k: v for k, v in values.items() if k in core_names}, self.core)
        node = {
            name: changed_section(getattr(self.node, name), prefix, values)
            for name, prefix, _ in node_sections()
        }
        return Settings(core, dataclasses.replace(self.node, **node))


class Parameters:
    """The parameters of a running node: declared, checked on every change, read as Settings."""

    def __init__(
        self,
        node: Node,
        is_active: Callable[[], bool],
        on_change: Callable[[Settings], None],
    ) -> None:
        """Declare all parameters with their values from files and command line.

        Raises
        ------
        InvalidConfig
            A given value has the wrong type or is out of range.
        """
        self._is_active, self._on_change = is_active, on_change
        self._entries = {entry.name: entry for entry in entries()}
        self.settings = Settings()
        self._warn_unknown(node)
        for entry in self._entries.values():
            self._declare(node, entry)
        _check_together(self.settings)
        node.add_on_set_parameters_callback(self._on_set)

    def _declare(self, node: Node, entry: Entry) -> None:
        from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException

        try:
            given = node.declare_parameter(entry.name, _to_ros(entry.default), _descriptor(entry))
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            raise InvalidConfig(f"parameter {entry.name}: {error}; {entry.doc}") from error
        self.settings = self.settings.changed({entry.name: _from_ros(given.value)})

    def _warn_unknown(self, node: Node) -> None:
        known = set(self._entries) | {"use_sim_time", "start_type_description_service"}
        given = getattr(node, "_parameter_overrides", {})
        unknown = [n for n in given if n not in known and not n.startswith("qos_overrides.")]
        for name in sorted(unknown):
            node.get_logger().warning(
                f"parameter {name} is not known and has no effect; see docs/parameters.md"
            )

    def _on_set(self, changes: list[Any]) -> Any:
        from rcl_interfaces.msg import SetParametersResult

        try:
            self.settings = self._checked(changes)
        except InvalidConfig as error:
            return SetParametersResult(successful=False, reason=str(error))
        self._on_change(self.settings)
        return SetParametersResult(successful=True)

    def _checked(self, changes: list[Any]) -> Settings:
        values: dict[str, Any] = {}
        for change in changes:
            entry = self._entries.get(change.name)
            if entry is None:
                continue
            value = _from_ros(change.value)
            if value is None:
                raise InvalidConfig(f"{change.name} cannot be removed")
            if entry.read_only and self._is_active():
                raise InvalidConfig(
                    f"{change.name} cannot change while the node is active; deactivate it first"
                )
            values[change.name] = value
        settings = self.settings.changed(values)
        if settings.core.buffer != self.settings.core.buffer:
            _check_together(settings)
        return settings


def _check_together(settings: Settings) -> None:
    """What each setting's own range does not say; raises InvalidConfig."""
    buffer = settings.core.buffer
    if buffer.max_views < buffer.min_views:
        raise InvalidConfig(
            f"buffer.max_views {buffer.max_views} is below buffer.min_views {buffer.min_views}: no "
            "rotation would ever be complete; raise the one, or first lower the other"
        )


def _to_ros(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _from_ros(value: Any) -> Any:
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    return tuple(value)


def _descriptor(entry: Entry) -> Any:
    from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

    rules = [f"One of: {', '.join(entry.choices)}."] if entry.choices else []
    rules += ["Not while the node is active."] if entry.read_only else []
    about = ParameterDescriptor(description=entry.doc, additional_constraints=" ".join(rules))
    if entry.kind is float and (entry.low is not None or entry.high is not None):
        low = -1e300 if entry.low is None else float(entry.low)
        high = 1e300 if entry.high is None else float(entry.high)
        about.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    if entry.kind is int and (entry.low is not None or entry.high is not None):
        low_int = -(2**62) if entry.low is None else int(entry.low)
        high_int = 2**62 if entry.high is None else int(entry.high)
        about.integer_range = [IntegerRange(from_value=low_int, to_value=high_int)]
    return about


REFERENCE_HEAD = """# Parameters of the node

Written by `python3 -m vflatten_ros.parameters > docs/parameters.md`; do not edit.

All can be given in a file (`config/vflatten.yaml` shows the usual ones), on the command line
(`--ros-args -p name:=value`) and, unless marked, be changed while the node runs; a change takes
effect with the next cloud or goal. "stopped": only while the node is not active. A change out of
range or of another type is refused with the reason. The same names without those of the first
part are the settings of `vflatten replay --config`.
"""


def reference() -> str:
    """The text of docs/parameters.md."""
    lines = [REFERENCE_HEAD, "## The node", ""]
    for _, prefix, kind in node_sections():
        lines += _table(_title(prefix or "general", kind), list(_entries_of(prefix, kind)))
    lines += ["## The method", ""]
    method = [entry for entry in entries() if entry.name == "method"]
    lines += _table("`method`", method)
    for name, kind in sections():
        lines += _table(_title(name, kind), list(_entries_of(f"{name}.", kind)))
    return "\n".join(lines).rstrip() + "\n"


def _title(prefix: str, kind: type[Checked]) -> str:
    return f"`{prefix.rstrip('.')}`: {(kind.__doc__ or '').splitlines()[0]}"


def _table(title: str, rows: list[Entry]) -> list[str]:
    if not rows:
        return []
    head = [
        "| name | type | default | range | change | description |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    return [f"### {title}", "", *head, *map(_row, rows), ""]


def _row(entry: Entry) -> str:
    kind = {bool: "bool", int: "int", float: "double", str: "string"}.get(entry.kind)
    if kind is None:
        kind = "string[]" if entry.kind == tuple[str, ...] else "double[]"
    default = (
        ", ".join(map(repr, entry.default))
        if isinstance(entry.default, tuple)
        else repr(entry.default)
    )
    change = "stopped" if entry.read_only else "live"
    cells = [f"`{entry.name}`", kind, f"`{default}`", _range(entry), change, entry.doc]
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _range(entry: Entry) -> str:
    if entry.choices:
        return ", ".join(entry.choices)
    if entry.low is None and entry.high is None:
        return ""
    low = "" if entry.low is None else f"{entry.low:g}"
    high = "" if entry.high is None else f"{entry.high:g}"
    return f"{low} to {high}".strip()


if __name__ == "__main__":
    print(reference(), end="")
