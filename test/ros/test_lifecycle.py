"""Lifecycle and parameters: every request is answered, and a refusal says why."""

import time
from types import SimpleNamespace

import pytest
import rclpy
import slow_work
from lifecycle_msgs.msg import Transition
from rcl_interfaces.msg import ParameterType
from rclpy.parameter import Parameter
from ros_rig import CALIBRATION, REAL, ROOT, Process, Rig
from sensor_msgs.msg import JointState
from vflatten_ros.msg import Status

from vflatten_ros import flatten_node
from vflatten_ros.flatten_node import FlattenNode

UNCONFIGURED, INACTIVE, ACTIVE, FINALIZED = 1, 2, 3, 4
CONFIGURE, CLEANUP, ACTIVATE, DEACTIVATE = 1, 2, 3, 4
# state -> valid transitions and where they lead; every other one is to be refused
VALID = {
    UNCONFIGURED: {CONFIGURE: INACTIVE, 5: FINALIZED},
    INACTIVE: {CLEANUP: UNCONFIGURED, ACTIVATE: ACTIVE, 6: FINALIZED},
    ACTIVE: {DEACTIVATE: INACTIVE, 7: FINALIZED},
    FINALIZED: {},
}
ALL = [*range(9), 10, 20, 30, 40, 50, 60, 99, 255]


@pytest.fixture(scope="module")
def rig(ros, tmp_path_factory):
    """A node that starts nothing by itself."""
    arguments = ["--ros-args", "-p", "autostart:=false"]
    rig = Rig(tmp_path_factory.mktemp("lifecycle"), arguments=arguments, wait=False)
    yield rig
    rig.close()


def change(rig, transition, label=""):
    answer = rig.ask("change_state", transition=Transition(id=transition, label=label))
    return answer.success


def bring(rig, state):
    """To a state, from whatever state an earlier test left."""
    way_down = {INACTIVE: CLEANUP, ACTIVE: DEACTIVATE}
    while (now := rig.lifecycle_state()) != UNCONFIGURED:
        assert change(rig, way_down[now])
    for transition in (CONFIGURE, ACTIVATE)[: state - 1]:
        assert change(rig, transition)


def active_in_silence(rig, setting, clouds):
    """With one setting changed and nobody publishing, until the node has said so."""
    bring(rig, UNCONFIGURED)
    rig.set_parameter("calibration.file", str(CALIBRATION))
    for name, value in (setting, ("no_data_warning_s", 0.5)):
        assert rig.set_parameter(name, value).successful
    bring(rig, ACTIVE)
    rig.until(lambda: f"no cloud on {rig.namespace}/{clouds}" in rig.node.log(), "a warning")


def test_every_transition_in_every_state_gets_an_answer(rig):
    rig.until(lambda: rig.lifecycle_state() == UNCONFIGURED, "the node")
    assert rig.set_parameter("calibration.file", str(CALIBRATION)).successful
    for state, way in ((UNCONFIGURED, None), (INACTIVE, CONFIGURE), (ACTIVE, ACTIVATE)):
        if way is not None:
            assert change(rig, way)
        for transition in ALL:
            if transition not in VALID[state]:
                assert not change(rig, transition), (state, transition)
                assert rig.lifecycle_state() == state
        assert not change(rig, 0, "no such transition")
    item = rig.buffer().item
    assert change(rig, 0, "deactivate")
    assert change(rig, ACTIVATE)
    assert rig.buffer().item == item + 1  # numbers are not used twice
    assert change(rig, 0, "deactivate")
    assert change(rig, 0, "cleanup")
    assert rig.lifecycle_state() == UNCONFIGURED
    for text in (
        "refused: cleanup (2) is not possible while active; possible: deactivate, shutdown",
        "inactive: clouds and joint states are no longer taken",
        "unconfigured: the flattening process has ended",
    ):
        assert text in rig.node.log()


def test_services_answer_in_every_state_and_say_what_is_missing(rig):
    bring(rig, UNCONFIGURED)
    for name in ("list_views", "add_correspondences", "clear_views", "select_views"):
        answer = rig.ask(name)
        assert answer.status.code == Status.NOT_ACTIVE
        assert "unconfigured; activate it first" in answer.status.message
    for name in ("flatten", "new_item", "clear"):
        answer = rig.ask(name)
        assert not answer.success and "activate it first" in answer.message
    assert rig.flatten().result.status.code == Status.NOT_ACTIVE
    assert rig.ask("state").status.code == Status.OK


@pytest.mark.parametrize(
    "text, reason",
    [
        (None, "no such file"),
        ("frame: rig\n", "axis_point is missing"),
        ("[1, 2", "cannot be read as YAML"),
        (CALIBRATION.read_text().replace("joint_sign: -1", "joint_sign: 5"), "expected 1 or -1"),
    ],
)
def test_a_wrong_calibration_refuses_activation_with_a_message(rig, tmp_path, text, reason):
    file = tmp_path / "calibration.yaml"
    if text is not None:
        file.write_text(text)
    rig.set_parameter("calibration.file", str(file))
    assert change(rig, CONFIGURE)
    assert not change(rig, ACTIVATE)
    assert rig.lifecycle_state() == INACTIVE
    assert reason in rig.node.log()
    assert reason in rig.ask("new_item").message
    rig.set_parameter("calibration.file", str(CALIBRATION))
    assert change(rig, ACTIVATE)
    assert change(rig, DEACTIVATE)
    assert change(rig, CLEANUP)


def test_a_calibration_may_be_given_by_numbers(rig):
    rig.set_parameter("calibration.file", "")
    bring(rig, INACTIVE)
    assert not change(rig, ACTIVATE)
    assert "no calibration" in rig.ask("new_item").message
    for name, value in (
        ("frame", "rig_optical"),
        ("axis_point", [0.0, -0.5, 1.3]),
        ("axis_direction", [0.0, -1.0, 0.0]),
        ("gripper_tip", [0.0, -0.5, 1.3]),
        ("joint", "wrist_roll"),
    ):
        assert rig.set_parameter(f"calibration.{name}", value).successful
    assert change(rig, ACTIVATE)
    assert change(rig, DEACTIVATE)
    rig.set_parameter("calibration.tf_frame", "tool0")
    assert change(rig, ACTIVATE) is False
    message = rig.ask("new_item").message
    assert "tf2_ros is not installed" in message or "no transform" in message
    rig.set_parameter("calibration.tf_frame", "")
    assert change(rig, CLEANUP)


def test_parameters_are_described_and_changes_refused_with_a_reason(rig):
    rig.set_parameter("calibration.file", str(CALIBRATION))
    bring(rig, ACTIVE)
    (about,) = rig.ask("describe_parameters", names=["geodesics.nodes"]).descriptors
    assert about.type == ParameterType.PARAMETER_INTEGER
    assert "Nodes" in about.description and about.integer_range[0].from_value == 3
    for name, value, reason in (
        ("geodesics.nodes", 2, "range"),
        ("geodesics.nodes", "many", "type"),
        ("method", "magic", "one of rotation, kita2019"),
        ("clouds.topic", "elsewhere", "deactivate it first"),
        ("buffer.max_views", -5, "range"),
        ("buffer.max_views", 5, "no rotation would ever be complete"),
        ("segmentation.radius_m", float("nan"), ""),
    ):
        answer = rig.set_parameter(name, value)
        assert not answer.successful, name
        assert reason in answer.reason.lower(), answer.reason
    assert rig.set_parameter("geodesics.nodes", 40).successful
    (value,) = rig.ask("get_parameters", names=["geodesics.nodes"]).values
    assert value.integer_value == 40


def test_a_publisher_that_cannot_reach_the_node_is_named_with_the_remedy(rig):
    active_in_silence(rig, ("joint_states.reliability", "reliable"), "rig/points")
    publishers = [
        rig.planner.create_publisher(
            JointState, "gripper/joint_states", rclpy.qos.qos_profile_sensor_data
        )
        for _ in range(3)
    ]
    remedy = "set joint_states.reliability to best_effort"
    rig.until(lambda: remedy in rig.node.log(), "the cause")
    rig.until(
        lambda: "QoS does not match" in rig.diagnostics()["joint states"][""], "it in diagnostics"
    )
    (line,) = [line for line in rig.node.log().splitlines() if "cannot reach this node" in line]
    assert f"{rig.namespace}/gripper/joint_states" in line and remedy in line
    for publisher in publishers:
        rig.planner.destroy_publisher(publisher)


def test_a_topic_of_another_type_is_told_with_the_type(rig):
    active_in_silence(rig, ("clouds.topic", "somewhere"), "somewhere")
    publisher = rig.planner.create_publisher(JointState, "somewhere", 1)
    found = f"{rig.namespace}/somewhere is published as sensor_msgs/msg/JointState, expected"
    rig.until(lambda: found in rig.node.log(), "the type")
    rig.until(lambda: found in rig.diagnostics()["clouds"][""], "it in diagnostics")
    rig.planner.destroy_publisher(publisher)
    bring(rig, INACTIVE)
    assert rig.set_parameter("clouds.topic", "rig/points").successful


def test_settings_from_a_file_and_over_it_those_given_by_themselves(ros, tmp_path):
    values = "{method: kita2019, buffer.max_views: 50, calibration.file: elsewhere.yaml}"
    file = tmp_path / "settings.yaml"
    file.write_text("/**: {ros__parameters: " + values + "}\n")
    arguments = ["--params-file", str(file), "--calibration", str(CALIBRATION)]
    rig = Rig(tmp_path, arguments=[*arguments, "--ros-args", "-p", "buffer.max_views:=60"])
    try:
        names = ["method", "buffer.max_views", "calibration.file"]
        method, views, calibration = rig.ask("get_parameters", names=names).values
        assert method.string_value == "kita2019"
        assert views.integer_value == 60
        assert calibration.string_value == str(CALIBRATION)
    finally:
        rig.close()


@pytest.mark.parametrize("command", ["vflatten_node", "vflatten node"])
def test_the_installed_commands_start_one_node_that_can_flatten(ros, tmp_path, command):
    """The flattening process imports the file of the command again: it must not run it."""
    program, *words = command.split()
    rig = Rig(
        tmp_path,
        kind=[str(ROOT / "scripts" / program), *words],
        arguments=["--name=mine"],
        wait=False,
    )
    try:
        me = ("mine", rig.namespace)
        rig.until(lambda: "cannot activate" in rig.node.log(), "the node")
        rig.until(
            lambda: rig.diagnostics("mine")["flattening"][""] == "idle", "the flattening process"
        )
        # names arrive by themselves, maybe after the topics
        names = rig.planner.get_node_names_and_namespaces
        rig.until(lambda: me in names(), "the node's name")
        assert names().count(me) == 1
        assert "Traceback" not in rig.node.log()
        assert rig.node.stop() == 0
    finally:
        rig.close()


@pytest.mark.parametrize("state, shutdown", [(UNCONFIGURED, 5), (ACTIVE, 7), (INACTIVE, 6)])
def test_a_finalized_node_still_answers(rig, state, shutdown):
    if not rig.node.running():
        rig.start(wait=False)
        rig.until(lambda: rig.lifecycle_state() == UNCONFIGURED, "the node")
    rig.set_parameter("calibration.file", str(CALIBRATION))
    bring(rig, state)
    assert change(rig, shutdown)
    for transition in ALL:
        assert not change(rig, transition)
    assert rig.lifecycle_state() == FINALIZED
    assert "finalized: the node does nothing any more" in rig.node.log()
    assert not rig.node.children()  # the flattening process is gone
    assert rig.ask("new_item").message.startswith("the node is finalized")
    assert rig.node.stop() == 0


def test_who_waits_for_a_result_is_answered_when_the_node_is_taken_down(ros, tmp_path):
    rig = Rig(tmp_path, arguments=["--calibration", str(CALIBRATION)])
    try:
        rig.set_parameter("auto_flatten", False)
        rig.set_parameter("geodesics.nodes", slow_work.STUBBORN)
        for transitions in ([DEACTIVATE], [DEACTIVATE, CLEANUP]):
            rig.turn()
            rig.until(lambda: rig.buffer().views, "views")
            goals = [rig.send_goal(view_ids=ids) for ids in ([1, 2], [3, 4])]
            rig.until(lambda: rig.ask("state").flattening, "the work to begin")
            for transition in transitions:
                assert change(rig, transition)
            for goal in goals:
                answer = rig.result_of(goal.get_result_async())
                assert answer.result.status.code == Status.CANCELLED
                assert "deactivated" in answer.result.status.message
            bring(rig, ACTIVE)
            rig.reconnect()
        rig.set_parameter("geodesics.nodes", slow_work.GOOD)
        rig.serves_a_good_rotation()
    finally:
        rig.close()


def test_a_node_that_is_left_over_is_noticed(ros, monkeypatch):
    monkeypatch.setattr(flatten_node, "NAMESAKE_S", 0.0)
    nodes = [FlattenNode("twin"), FlattenNode("twin"), FlattenNode("single")]
    lines = []
    for node in nodes:
        monkeypatch.setattr(node.log, "_logger", SimpleNamespace(warning=lines.append))
    try:
        end = time.monotonic() + 30.0
        while not lines and time.monotonic() < end:
            for node in nodes[1:]:
                rclpy.spin_once(node, timeout_sec=0.1)
        (line,) = lines
        assert line.startswith("another node is named /twin and answers the same calls")
    finally:
        for node in nodes:
            node.destroy_node()


def test_a_mistake_of_ours_in_a_transition_leads_back_to_unconfigured(ros):
    trouble = [ZeroDivisionError("a mistake of ours")]

    def loader(folder):
        if trouble:
            raise trouble.pop()
        return slow_work.load

    node = FlattenNode("mistaken", loader=loader)
    try:
        node.trigger_configure()
        assert node.lifecycle_state()[0] == UNCONFIGURED
        node.trigger_configure()
        assert node.lifecycle_state()[0] == INACTIVE
    finally:
        node.destroy_node()


def test_settings_of_the_flattening_process_count_until_the_activation(ros, tmp_path):
    given = []

    def loader(options):
        given.append((options.categories, options.worker_processes))
        return slow_work.load

    node = FlattenNode("changed", loader=loader)
    try:
        node.set_parameters([Parameter("calibration.file", value=str(CALIBRATION))])
        node.trigger_configure()
        categories = str(ROOT / "config" / "categories")
        for name, value in (("categories", categories), ("worker_processes", 1)):
            (answer,) = node.set_parameters([Parameter(name, value=value)])
            assert answer.successful
        node.trigger_activate()
        assert given == [("", 2), (categories, 1)]
        node.trigger_deactivate()
        node.trigger_activate()
        assert len(given) == 2  # nothing has changed
        node.trigger_deactivate()
        node.set_parameters([Parameter("categories", value=str(tmp_path / "nowhere"))])
        node.trigger_activate()
        assert node.lifecycle_state()[0] == INACTIVE
        assert "nowhere" in node.trouble
    finally:
        node.destroy_node()


@pytest.mark.parametrize(
    "arguments, code, reason",
    [
        (["--ros-args", "-p", "geodesics.nodes:=1"], 1, "geodesics.nodes"),
        (["--ros-args", "-p", "method:=5"], 1, "method"),
        (["--ros-args", "-p", "buffer.max_views:=5"], 1, "buffer.min_views 6"),
        (["--nonsense"], 2, "--nonsense"),
        (["--params-file", "nowhere.yaml"], 1, "nowhere.yaml"),
        (["--params-file", "README.md"], 1, "README.md"),
    ],
)
def test_a_wrong_start_ends_with_one_line(tmp_path, arguments, code, reason):
    process = Process([*REAL, *arguments], tmp_path / "log")
    assert process.wait() == code
    (line,) = [line for line in process.log().splitlines() if "vflatten node: " in line]
    assert reason in line
    assert "Traceback" not in process.log()
