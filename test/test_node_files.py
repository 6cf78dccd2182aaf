"""Launch file, layouts and DDS profile fit the node."""

import json
import re
import sys
from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree

import pytest
import yaml

ROOT = Path(__file__).parents[1]
SHOWN = ["points", "markers", "contour", "image"]


def test_rviz_shows_every_drawable_output():
    layout = yaml.safe_load((ROOT / "config" / "vflatten.rviz").read_text())
    displays = layout["Visualization Manager"]["Displays"]
    topics = {d["Topic"]["Value"]: d["Topic"] for d in displays if "Topic" in d}
    assert set(topics) == {"/rig/points", *(f"/vflatten/{name}" for name in SHOWN)}
    for name in SHOWN:
        assert topics[f"/vflatten/{name}"]["Durability Policy"] == "Transient Local"


def test_foxglove_shows_every_output():
    layout = json.loads((ROOT / "config" / "foxglove.json").read_text())
    text = json.dumps(layout)
    for name in [*SHOWN, "garment", "flattened_view", "views"]:
        assert f"/vflatten/{name}" in text
    assert "/diagnostics" in text
    panels = set(re.findall(r'"([A-Za-z0-9]+![a-z]+)"', json.dumps(layout["layout"])))
    assert panels == set(layout["configById"])


class Noted:
    """Stands for anything of launch and launch_ros: notes how it was made."""

    def __init__(self, *args, **named):
        self.args, self.named = args, named


LAUNCH = {
    "launch": ["LaunchDescription"],
    "launch.actions": ["DeclareLaunchArgument"],
    "launch.conditions": ["IfCondition"],
    "launch.substitutions": ["LaunchConfiguration", "PathJoinSubstitution"],
    "launch_ros": [],
    "launch_ros.actions": ["Node", "SetParameter"],
    "launch_ros.substitutions": ["FindPackageShare"],
}


@pytest.fixture
def launched(monkeypatch):
    """What the launch file describes; launch itself is not on PyPI."""
    for name, kinds in LAUNCH.items():
        module = ModuleType(name)
        for kind in kinds:
            setattr(module, kind, type(kind, (Noted,), {}))
        monkeypatch.setitem(sys.modules, name, module)
    text = (ROOT / "launch" / "vflatten.launch.py").read_text()
    assert len(text.splitlines()) < 80  # one page
    space = {}
    exec(compile(text, "vflatten.launch.py", "exec"), space)
    return space["generate_launch_description"]().args[0]


def everything(thing):
    """All that was noted, however deep."""
    if isinstance(thing, Noted):
        yield thing
        yield from everything([*thing.args, *thing.named.values()])
    elif isinstance(thing, (list, tuple)):
        for part in thing:
            yield from everything(part)


def test_the_launch_file_starts_the_installed_node_with_all_that_it_declares(launched):
    kinds = [(type(thing).__name__, thing) for thing in everything(launched)]
    declared = {thing.args[0] for kind, thing in kinds if kind == "DeclareLaunchArgument"}
    used = {thing.args[0] for kind, thing in kinds if kind == "LaunchConfiguration"}
    assert used == declared
    node, rviz, _ = (thing.named for kind, thing in kinds if kind == "Node")
    assert (ROOT / "scripts" / node["executable"]).is_file()
    assert {old for old, _ in rviz["remappings"]} == {
        "/rig/points",  # a namespace moves what RViz shows, too
        *(f"/vflatten/{name}" for name in SHOWN),
    }
    files = {thing.args[0][-1] for kind, thing in kinds if kind == "PathJoinSubstitution"}
    for name in files - {"config"}:
        assert (ROOT / "config" / name).is_file()


def test_the_node_takes_the_launch_files_arguments():
    pytest.importorskip("rclpy")
    from vflatten_ros.node import _ros_arguments

    theirs = ["--ros-args", "-r", "__node:=vflatten", "--params-file", "/a.yaml"]
    assert _ros_arguments(["--calibration=", *theirs]) == theirs
    # the last one counts: a calibration over the file's
    given = _ros_arguments(["--calibration=/c.yaml", *theirs])
    assert given == [*theirs, "--ros-args", "-p", 'calibration.file:="/c.yaml"', "--"]
    # what is given by itself over the file
    given = _ros_arguments(["--params-file", "/b.yaml", *theirs])
    assert given == ["--ros-args", "--params-file", "/b.yaml", "--", *theirs]


def test_the_dds_profile_has_room_for_the_largest_cloud():
    root = ElementTree.parse(ROOT / "config" / "fastdds.xml").getroot()
    (size,) = [e for e in root.iter() if e.tag.endswith("segment_size")]
    assert int(size.text) >= 3 * 20e6  # three clouds of 20 MB


@pytest.mark.parametrize("page", ["node.md"])
def test_parameters_that_the_docs_name_exist(page):
    from vflatten_ros.parameters import entries, node_sections

    known = {entry.name for entry in entries()}
    prefixes = {name.split(".")[0] for name in known if "." in name}
    prefixes |= {prefix.rstrip(".") for _, prefix, _ in node_sections()}
    text = (ROOT / "docs" / page).read_text()
    named = set(re.findall(r"`([a-z_]+\.[a-z_]+)`", text))
    wrong = {name for name in named if name.split(".")[0] in prefixes - {""} and name not in known}
    assert not {name for name in wrong if not name.endswith("_")}
