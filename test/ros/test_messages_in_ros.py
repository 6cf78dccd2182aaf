"""Our fields in real message classes: the same numbers by rclpy as in the mcap file."""

from importlib import import_module

import pytest
from garments import example_garment, example_views
from mcap.reader import make_reader
from rclpy.serialization import deserialize_message, serialize_message

from vflatten_ros import displays, mcap_output, messages, outputs

VIEWS = example_views()
GARMENT = example_garment(VIEWS)
RESULTS = outputs.result_messages(GARMENT, VIEWS)


def class_of(name):
    package, message = name.split("/")
    return getattr(import_module(f"{package}.msg"), message)


@pytest.mark.parametrize("name", mcap_output.STANDARD)
def test_standard_definitions_are_those_of_ros(name):
    ours = {}
    for line in mcap_output.STANDARD[name].splitlines():
        kind, field = line.split()[:2]
        base = kind.removesuffix("[]")
        if base[0].isupper():
            base = f"{name.split('/')[0]}/{base}"
        base = {"float64": "double", "float32": "float", "bool": "boolean"}.get(base, base)
        ours[field] = f"sequence<{base}>" if kind.endswith("[]") else base
    assert class_of(name).get_fields_and_field_types() == ours


@pytest.mark.parametrize("message", RESULTS, ids=lambda message: message.topic)
def test_the_mcap_file_holds_what_the_node_publishes(message, tmp_path):
    path = tmp_path / "one.mcap"
    mcap_output.write_mcap(path, [message])
    with path.open("rb") as stream:
        (_, _, record), *_ = make_reader(stream).iter_messages()
    kind = class_of(message.type)
    published = messages.fill(kind(), message.fields)
    assert deserialize_message(record.data, kind) == published
    # padding between numbers is not set by all writers: compare lengths, not bytes
    assert len(record.data) == len(serialize_message(published))


@pytest.mark.parametrize("message", RESULTS, ids=lambda message: message.topic)
def test_read_gives_back_what_was_filled(message):
    kind = class_of(message.type)
    fields = messages.read(messages.fill(kind(), message.fields))
    assert messages.fill(kind(), fields) == messages.fill(kind(), message.fields)


def test_diagnostics_take_their_level():
    kind = class_of("diagnostic_msgs/DiagnosticArray")
    fields = displays.diagnostic_fields(5, [(1, "node: clouds", "late", "rig", {"age": 2})])
    status = messages.fill(kind(), fields).status[0]
    assert status.level == b"\x01"
    assert (status.values[0].key, status.values[0].value) == ("age", "2")
