"""Recordings are read whatever their storage, and bad ones are refused in words."""

import dataclasses
import json

import numpy as np
import pytest
import zstandard
from recordings import (
    BAGS,
    CALIBRATION,
    CLOUD_TYPE,
    JOINT_TYPE,
    Message,
    S,
    cloud,
    in_log_order,
    joints,
    turn,
    write_bag,
    write_mcap,
)

from vflatten_ros import mcap_files
from vflatten_ros.bag import (
    RecordedCloud,
    RecordedJoints,
    Recording,
    gather_views,
    open_recording,
)
from vflatten_ros.core.calibration import calibration_from
from vflatten_ros.core.config import Config
from vflatten_ros.core.errors import (
    InvalidCalibration,
    InvalidCorrespondence,
    InvalidRecording,
)
from vflatten_ros.files import calibration_beside, load_calibration, load_protocol

RIG = calibration_from(CALIBRATION)


def gather(path, **topics):
    recording = open_recording(path, **topics)
    return gather_views(recording, RIG, Config()), recording


def contents(path):
    return [(type(m), m.log_ns, m.topic, m.cdr) for m in open_recording(path).messages()]


@pytest.mark.parametrize("name", ["LS1_1", "TR1_1", "SH1_1"])
def test_every_cloud_of_the_carried_recordings_becomes_a_view_at_its_angle(name):
    folder = BAGS / name
    recording = open_recording(folder)
    assert recording.guessed == (
        "cloud-topic /rig/points (the only one of type sensor_msgs/msg/PointCloud2)",
        "joint-topic /gripper/joint_states (the only one of type sensor_msgs/msg/JointState)",
    )
    heard = []
    buffer = gather_views(
        recording,
        load_calibration(calibration_beside(folder)),
        Config(),
        lambda *p: heard.append(p),
    )
    views = buffer.views()
    assert [view.view_id for view in views] == list(range(24))
    assert (buffer.state().drops, recording.warnings, heard[-1]) == ({}, [], ("views", 1.0))
    truth = json.loads((folder / "truth.json").read_text())["views"]
    assert [view.stamp_ns for view in views] == [view["stamp_ns"] for view in truth]
    angles = np.array([view.angle_rad for view in views])
    error = (angles - [view["wrist_angle"] for view in truth] + np.pi) % (2 * np.pi) - np.pi
    assert np.degrees(np.abs(error).max()) < 0.25  # five sigma of the encoder
    assert all(view.rgb is not None and len(view.points_rig) > 1000 for view in views)


def test_storage_makes_no_difference(tmp_path):
    messages = in_log_order(turn())
    parts = [messages[:100], messages[100:101], messages[101:]]
    want = contents(write_mcap(tmp_path / "plain.mcap", messages))
    assert len(want) == 408
    others = [
        write_mcap(tmp_path / "lz4.mcap", messages, compression="lz4"),
        write_mcap(tmp_path / "none.mcap", messages, compression="none"),
        write_mcap(tmp_path / "unchunked.mcap", messages, chunked=False),
        write_bag(tmp_path / "bag", [messages]),
        write_bag(tmp_path / "split", parts),
        write_bag(tmp_path / "metadata", [messages]) / "metadata.yaml",
    ]
    (others[3] / "other.mcap").write_bytes(b"not of this bag")  # the metadata lists the files
    for path in others:
        assert contents(path) == want, path


def test_split_files_without_metadata_are_read_in_order_of_number(tmp_path):
    messages = in_log_order(turn())
    folder = tmp_path / "split"
    write_bag(folder, [messages[k * 34 : (k + 1) * 34] for k in range(12)])
    (folder / "metadata.yaml").unlink()
    assert contents(folder) == contents(write_mcap(tmp_path / "one.mcap", messages))


@pytest.mark.parametrize("options", [{}, {"chunked": False}])
def test_files_that_overlap_in_time_are_read_side_by_side(tmp_path, options):
    """As where clouds and joint states were recorded by two processes."""
    messages = in_log_order(turn())
    both = [[m for m in messages if (m.kind == CLOUD_TYPE) == clouds] for clouds in (False, True)]
    assert [len(part) for part in both] == [400, 8]
    folder = write_bag(tmp_path / "split", both, **options)
    assert contents(folder) == contents(write_mcap(tmp_path / "one.mcap", messages))


def test_a_file_is_not_opened_before_its_first_message_is_due(tmp_path, monkeypatch):
    messages = in_log_order(turn())
    recording = open_recording(write_bag(tmp_path / "split", [messages[:200], messages[200:]]))
    opened, read = [], Recording._messages_of
    monkeypatch.setattr(
        Recording, "_messages_of", lambda self, path: (opened.append(path), read(self, path))[1]
    )
    stream = recording.messages()
    for _ in range(200):
        next(stream)
    assert opened == [recording.files[0]]
    assert len(list(stream)) == len(messages) - 200 and opened == list(recording.files)


def test_a_file_that_counts_nothing_leaves_the_count_of_all_unknown(tmp_path, monkeypatch):
    """A recorder that was killed wrote no statistics; the next file knows of its own only."""
    told = {"0": None, "1": 0, "2": 7}
    topics = {name: [mcap_files.Topic("/points", CLOUD_TYPE, n)] for name, n in told.items()}
    monkeypatch.setattr(mcap_files, "_topics_of", lambda path: topics[path.name])

    def counted(*names):
        (topic,) = mcap_files.recorded_topics(tuple(tmp_path / name for name in names))
        return topic.messages

    assert counted("0", "1", "2") is counted("1", "0") is counted("2", "1", "0") is None
    assert counted("1", "2", "2") == 14


def test_messages_come_in_log_order_whatever_their_order_in_the_file(tmp_path):
    messages = in_log_order(turn())
    shuffled = [messages[k] for k in np.random.default_rng(0).permutation(len(messages))]
    path = write_mcap(tmp_path / "shuffled.mcap", shuffled, chunk_size=20_000)
    times = [message.log_ns for message in open_recording(path).messages()]
    assert times == sorted(times) and len(times) == len(messages)


def test_messages_are_typed(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", [joints(5, 0.25), cloud(7)])
    state, points = open_recording(path).messages()
    assert isinstance(state, RecordedJoints) and isinstance(points, RecordedCloud)
    assert (state.stamp_ns, state.names, state.positions) == (5, ("wrist", "finger"), (0.25, 0.0))
    assert points.decode().stamp_ns == 7
    assert points.decode().xyz.shape == (40, 20, 3)


def test_topics_are_chosen_by_name_where_there_are_several(tmp_path):
    messages = in_log_order([*turn(), *turn(topic="/other", frame="elsewhere")])
    path = write_mcap(tmp_path / "two.mcap", messages)
    with pytest.raises(
        InvalidRecording, match=r"several .* \(/other, /points\); give --cloud-topic"
    ):
        open_recording(path)
    buffer, recording = gather(path, cloud_topic="/points")
    assert len(buffer.views()) == 8
    assert len(recording.guessed) == 1  # the joint topic only
    with pytest.raises(InvalidRecording, match=r"no topic '/nope'; topics: .*/points"):
        open_recording(path, cloud_topic="/nope")
    with pytest.raises(
        InvalidRecording, match="'/points' is sensor_msgs/msg/PointCloud2, expected"
    ):
        open_recording(path, cloud_topic="/points", joint_topic="/points")


# ---- what can go wrong


def test_a_truncated_recording_gives_what_comes_before_and_a_warning(tmp_path):
    whole = write_mcap(tmp_path / "whole.mcap", in_log_order(turn()), chunk_size=20_000)
    short = tmp_path / "short.mcap"
    short.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    buffer, recording = gather(short)
    assert 1 <= len(buffer.views()) < 8
    (warning,) = recording.warnings
    assert "short.mcap: ends early" in warning and "mcap recover" in warning
    assert contents(short) == contents(whole)[: len(contents(short))]


def test_a_recording_of_a_killed_recorder_is_read(tmp_path):
    messages = in_log_order(turn())
    path = write_mcap(tmp_path / "killed.mcap", messages, end=False, chunk_size=20_000)
    buffer, recording = gather(path)
    assert len(buffer.views()) >= 6
    assert len(recording.warnings) == 1


@pytest.mark.parametrize("size", [0, 5, 8, 60, 200])
def test_a_recording_cut_before_its_first_message_is_refused(tmp_path, size):
    whole = write_mcap(tmp_path / "whole.mcap", in_log_order(turn()))
    path = tmp_path / "stub.mcap"
    path.write_bytes(whole.read_bytes()[:size])
    with pytest.raises(InvalidRecording, match=r"stub\.mcap") as refusal:
        gather(path)
    assert "\n" not in str(refusal.value)


def test_messages_that_are_compressed_one_by_one_are_told_with_a_remedy(tmp_path):
    squeeze = zstandard.ZstdCompressor().compress
    messages = [dataclasses.replace(m, fields=squeeze(bytes(99))) for m in in_log_order(turn())]
    with pytest.raises(InvalidRecording, match="compressed one by one; write the bag anew"):
        gather(write_bag(tmp_path / "bag", [messages]))


def test_damaged_bytes_end_the_recording_there(tmp_path):
    whole = write_mcap(tmp_path / "whole.mcap", in_log_order(turn()), chunk_size=20_000)
    data = bytearray(whole.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 2000] = bytes(2000)
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    buffer, recording = gather(path)
    assert 1 <= len(buffer.views()) < 8
    assert len(recording.warnings) == 1


REFUSED = {
    "no clouds": (
        [m for m in turn() if m.topic != "/points"],
        r"no messages of type sensor_msgs/msg/PointCloud2; topics: /joint_states",
    ),
    "no joint states": (
        [m for m in turn() if m.topic == "/points"],
        r"no messages of type sensor_msgs/msg/JointState; topics: /points",
    ),
    "another joint": (
        [joints(k * S // 50, 0.0, names=("elbow", "knee")) for k in range(100)] + [cloud(S)],
        r"no joint 'wrist' on /joint_states \(joints: elbow, knee\)",
    ),
    "clouds before the joint states": (
        [joints((k + 500) * S // 50, 0.0) for k in range(100)] + [cloud(S)],
        r"none of 1 clouds gave a view \(too_old 1\); check that joint states cover",
    ),
    "clouds after the joint states": (
        [joints(k * S // 50, 0.0) for k in range(100)] + [cloud(60 * S)],
        r"none of 1 clouds gave a view \(too_old 1\)",
    ),
    "empty clouds": (turn(rows=0), r"none of 8 clouds gave a view \(empty_after_segmentation 8\)"),
    "lying clouds": (turn(data=b"short"), r"none of 8 clouds gave a view \(invalid_cloud 8\)"),
    "another frame": (turn(frame="map"), r"none of 8 clouds gave a view \(wrong_frame 8\)"),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_a_recording_that_gives_no_view_says_why(tmp_path, fault):
    messages, words = REFUSED[fault]
    path = write_mcap(tmp_path / "bad.mcap", in_log_order(messages))
    with pytest.raises(InvalidRecording, match=words) as refusal:
        gather(path)
    assert str(path) in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_one_bad_cloud_is_counted_and_the_rest_goes_on(tmp_path):
    bad = [
        cloud(S + 1, data=b"1"),
        cloud(S + 2, frame="map"),
        cloud(S + 3, rows=0),
        cloud(S + 4, height=2**32 - 1, width=2**32 - 1),
        cloud(90 * S),
        Message(S + 5, "/points", CLOUD_TYPE, b"\0\1\0\0garbage"),
        Message(S + 6, "/joint_states", JOINT_TYPE, b"\0\1\0\0garbage"),
    ]
    buffer, recording = gather(write_mcap(tmp_path / "a.mcap", in_log_order([*turn(), *bad])))
    state = buffer.state()
    assert len(state.view_ids) == 8
    assert state.drops == {
        "empty_after_segmentation": 1,
        "invalid_cloud": 3,
        "too_old": 1,
        "wrong_frame": 1,
    }
    assert len(recording.warnings) == 1
    assert "left out 1 joint states" in recording.warnings[0]


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.mcap", b"SQLite format 3\x00", "SQLite bag; convert"),
        ("a.mcap", b"\x28\xb5\x2f\xfd....", "compressed as a whole; unpack"),
        ("a.mcap", b"#ROSBAG V2.0", "not an mcap file"),
        ("a.mcap", b"", "is empty"),
        ("metadata.yaml", b"rosbag2_bagfile_information: {}", "not a rosbag2 metadata file"),
        ("metadata.yaml", b"[1, 2", "not a rosbag2 metadata file"),
        (
            "metadata.yaml",
            b"rosbag2_bagfile_information: {relative_file_paths: [gone.mcap]}",
            "gone.mcap: no such file",
        ),
        ("metadata.yaml", b"rosbag2_bagfile_information: {relative_file_paths: []}", "no files"),
    ],
)
def test_what_is_no_recording_is_named(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    for path in (tmp_path, tmp_path / name):
        with pytest.raises(InvalidRecording, match=words):
            open_recording(path)


def test_missing_paths_are_named(tmp_path):
    with pytest.raises(InvalidRecording, match="no such file or folder"):
        open_recording(tmp_path / "nothing")
    with pytest.raises(InvalidRecording, match=r"no metadata\.yaml and no \.mcap"):
        open_recording(tmp_path)


# ---- calibration and protocol


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("axis_direction: [0, 0", "cannot be read as YAML"),
        ("- 1", "expected keys and values"),
        ("", "expected keys and values"),
        ("frame: rig", "axis_point is missing"),
        (json.dumps({**CALIBRATION, "axis_direction": [0, 0, 0]}), "axis_direction: .* no length"),
    ],
)
def test_a_bad_calibration_names_file_and_key(tmp_path, text, words):
    path = tmp_path / "calibration.yaml"
    path.write_text(text)
    with pytest.raises(InvalidCalibration, match=words) as refusal:
        load_calibration(path)
    assert str(path) in str(refusal.value) and "\n" not in str(refusal.value)
    with pytest.raises(InvalidCalibration, match="no such file; give one with --calibration"):
        load_calibration(tmp_path / "gone.yaml")


def test_a_protocol_is_two_views_and_pairs_of_pixels():
    views, pairs = load_protocol(BAGS / "LS1_1" / "protocol.json")
    assert views == (17, 23)
    assert len(pairs) == 5
    assert (pairs[0].view_a, pairs[0].pixel_a, pairs[0].pixel_b) == (17, (85, 184), (88, 183))
    assert all(pair.manual for pair in pairs)


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        "{}",
        '{"views": [1], "pairs": []}',
        '{"views": [1, 2], "pairs": [{"a": [1, 2]}]}',
        '{"views": [1, -2], "pairs": []}',
        '{"views": [1, 2], "pairs": [{"a": [1.5, 2], "b": [1, 2]}]}',
        '{"views": [1, 2], "pairs": [{"a": [1e400, 2], "b": [1, 2]}]}',
        '{"views": [1, Infinity], "pairs": []}',
    ],
)
def test_a_bad_protocol_is_named(tmp_path, text):
    path = tmp_path / "protocol.json"
    path.write_text(text)
    with pytest.raises(InvalidCorrespondence, match=r"protocol\.json"):
        load_protocol(path)
