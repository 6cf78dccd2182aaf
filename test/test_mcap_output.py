"""Messages in an mcap file: read back with two libraries, same bytes twice."""

import numpy as np
import pytest
from garments import FIRST_NS, example_garment, example_views
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from vflatten_ros.mcap_output import full_definition, write_mcap
from vflatten_ros.outputs import result_messages

VIEWS = example_views()
GARMENT = example_garment(VIEWS)
EXPECTED = {
    "/vflatten/flattened_view": "vflatten_ros/msg/FlattenedView",
    "/vflatten/garment": "vflatten_ros/msg/GarmentEstimate",
    "/vflatten/contour": "geometry_msgs/msg/PolygonStamped",
    "/vflatten/markers": "visualization_msgs/msg/MarkerArray",
    "/vflatten/points": "sensor_msgs/msg/PointCloud2",
    "/vflatten/image": "sensor_msgs/msg/Image",
}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("out") / "result.mcap"
    write_mcap(path, result_messages(GARMENT, VIEWS))
    return path


def alike(value, fields):
    """Whether a decoded message holds what was written, of whatever library it is."""
    if isinstance(fields, dict):
        return all(alike(getattr(value, key), item) for key, item in fields.items())
    if isinstance(fields, list) and fields and isinstance(fields[0], dict):
        return len(value) == len(fields) and all(map(alike, value, fields))
    if isinstance(fields, np.ndarray) and fields.dtype == np.uint8:
        return bytes(value) == fields.tobytes()
    if isinstance(fields, (list, np.ndarray)):
        return list(value) == list(fields)
    return value == fields


def test_mcap_ros2_support_reads_every_number_back(written):
    with written.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        found = {
            channel.topic: (schema.name, message.log_time, decoded)
            for schema, channel, message, decoded in reader.iter_decoded_messages()
        }
    assert {topic: name for topic, (name, _, _) in found.items()} == EXPECTED
    assert {stamp for _, stamp, _ in found.values()} == {FIRST_NS + 5 * 500_000_000}
    for message in result_messages(GARMENT, VIEWS):
        assert alike(found[message.topic][2], message.fields), message.topic


def test_rosbags_reads_every_number_back(written):
    from rosbags.highlevel import AnyReader

    with AnyReader([written]) as reader:
        found = {c.topic: reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages()}
    assert set(found) == set(EXPECTED)
    for message in result_messages(GARMENT, VIEWS):
        assert alike(found[message.topic], message.fields), message.topic


def test_the_same_result_gives_the_same_bytes(written, tmp_path):
    again = tmp_path / "again.mcap"
    write_mcap(again, result_messages(example_garment(), example_views()))
    assert again.read_bytes() == written.read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == ["again.mcap"]


def test_a_definition_holds_every_nested_type_once():
    text = full_definition("vflatten_ros/GarmentEstimate")
    parts = [line[5:] for line in text.splitlines() if line.startswith("MSG: ")]
    assert len(parts) == len(set(parts))
    assert set(parts) == {
        "std_msgs/Header",
        "builtin_interfaces/Time",
        "geometry_msgs/Point",
        "vflatten_ros/CategoryHypothesis",
        "vflatten_ros/Measurement",
        "vflatten_ros/Landmark",
    }
