"""Launch file, layouts and DDS profile fit the node."""

import ast
import json
import re
from pathlib import Path
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


def test_the_launch_file_starts_the_installed_node():
    text = (ROOT / "launch" / "vflatten.launch.py").read_text()
    ast.parse(text)
    assert 'executable="vflatten_node"' in text
    remapped = ast.literal_eval(re.search(r"for name in (\(.+?\))", text)[1])
    assert set(remapped) == set(SHOWN)  # a namespace moves what RViz shows, too
    assert len(text.splitlines()) < 80  # one page


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
