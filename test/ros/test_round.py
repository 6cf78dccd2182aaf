"""A planner's whole round gives what `vflatten replay` gives, number for number."""

import os
import struct
import subprocess
import sys

import numpy as np
import pytest
from mcap.reader import make_reader
from rclpy.serialization import deserialize_message
from ros_rig import CALIBRATION, REAL, RECORDING, ROOT, Process, Rig
from running import gone
from vflatten_ros.msg import FlattenedView, GarmentEstimate, Status

from vflatten_ros import messages

ACTIVE = 3  # of lifecycle_msgs
KINDS = {"flattened_view": FlattenedView, "garment": GarmentEstimate}


def same(a, b):
    """Equal fields, numbers bit for bit."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.tobytes() == b.tobytes()
    if isinstance(a, float):
        return struct.pack("d", a) == struct.pack("d", b)
    return a == b


def replayed(path):
    """Our two messages in the file that `vflatten replay --mcap` writes."""
    with path.open("rb") as stream:
        found = {
            schema.name.split("/")[-1]: message.data
            for schema, _, message in make_reader(stream).iter_messages()
        }
    return {kind: deserialize_message(found[kind.__name__], kind) for kind in KINDS.values()}


PROTOCOL = ["--protocol", str(RECORDING / "protocol.json")]
ROTATION = ["--method", "rotation", "--processes", "1"]  # the node has two


@pytest.mark.parametrize(
    "method, rate, options",
    [("kita2019", 1.0, PROTOCOL), ("rotation", 4.0, ROTATION)],
    ids=["kita2019", "rotation"],
)
def test_the_planners_round_gives_what_replay_gives(ros, tmp_path, method, rate, options):
    """The recording is played, once at its own rate; meanwhile it is replayed without ROS."""
    arguments = ["--calibration", str(CALIBRATION), "--ros-args", "-p", "worker_nice:=0"]
    arguments += ["-p", f"worker_processes:={1 if method == 'kita2019' else 2}"]
    rig = Rig(tmp_path, kind=REAL, arguments=[*arguments, "-p", "auto_flatten:=false"])
    try:
        planner = Process(
            [
                "examples/planner.py",
                str(RECORDING),
                *("--node", f"{rig.namespace}/vflatten", "--namespace", rig.namespace),
                *("--method", method, "--rate", str(rate), "--save", str(tmp_path / "live")),
            ],
            tmp_path / "planner.log",
        )
        command = [sys.executable, "-m", "vflatten_ros.cli", "replay", str(RECORDING), "--quiet"]
        subprocess.run(
            [*command, *options, "--mcap", str(tmp_path / "replay.mcap")], check=True, cwd=ROOT
        )
        assert planner.wait(180) == 0, planner.log() + rig.node.log()
        helpers = rig.node.helpers()
        cores = len(os.sched_getaffinity(0))
        assert len(helpers) == (method == "rotation" and cores > 1)
        assert rig.node.stop() == 0
        assert all(gone(helper) for helper in helpers)
        assert "helper" not in rig.node.log()  # it had no trouble
        assert "border of the image" not in rig.node.log()  # the item is within it
    finally:
        rig.close()

    log = planner.log()
    assert "views: 24, 360 degrees covered" in log
    assert ("corresponding points: 5 of 5 accepted" in log) == (method == "kita2019")
    assert "flattening: " in log
    assert "long_sleeve_shirt" in log
    assert "item 3 begins" in log  # the round is over: the next item

    recorded = replayed(tmp_path / "replay.mcap")
    for name, kind in KINDS.items():
        live = deserialize_message((tmp_path / "live" / f"{name}.cdr").read_bytes(), kind)
        ours, theirs = messages.read(live), messages.read(recorded[kind])
        assert (ours.pop("item"), theirs.pop("item")) == (2, 0)  # of a node, of a recording
        differing = [field for field in ours if not same(ours[field], theirs[field])]
        assert not differing, f"{name}: {differing}"
        assert len(live.view_ids if name == "flattened_view" else live.measurements) > 1


def test_a_joint_that_turns_the_other_way_is_told_and_the_node_goes_on(ros, tmp_path):
    """The likeliest mistake of an installation: joint_sign is wrong."""
    wrong = tmp_path / "calibration.yaml"
    wrong.write_text(CALIBRATION.read_text().replace("joint_sign: -1", "joint_sign: 1"))
    parameters = ["method:=rotation", "auto_flatten:=false", "worker_nice:=0"]
    given = [text for parameter in parameters for text in ("-p", parameter)]
    rig = Rig(tmp_path, kind=REAL, arguments=["--calibration", str(wrong), "--ros-args", *given])
    try:
        rig.turn()
        buffer = rig.until(rig.complete, "the rotation")
        result = rig.flatten().result
        assert result.status.code == Status.FAILED
        assert "set joint_sign to -1" in result.status.message
        assert [view.id for view in rig.buffer().views] == [view.id for view in buffer.views]
        assert rig.lifecycle_state() == ACTIVE
    finally:
        rig.close()
