"""The command as a user runs it: a process, its output, its exit code."""

import contextlib
import fcntl
import json
import os
import pty
import re
import shutil
import signal
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from vflatten_ros.cli import main

ROOT = Path(__file__).parent.parent
BAG = ROOT / "bags" / "LS1_1"
SHORTS = ROOT / "bags" / "SH1_1"
SKIRT = ROOT / "bags" / "SK2_1"
CLOUDS, JOINTS = "/rig/points", "/gripper/joint_states"
START = [sys.executable, "-c", "import sys; from vflatten_ros.cli import main; sys.exit(main())"]


def vflatten(*arguments, **options):
    """Run the command; gives the finished process."""
    command = [*START, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, **options)


def copy(target: Path, edit=lambda topic, index, data: data, bag: Path = BAG) -> Path:
    """A carried recording with its messages edited; None leaves a message out."""
    target.mkdir()
    shutil.copy(bag / "calibration.yaml", target)
    counts: dict[str, int] = {}
    with next(bag.glob("*.mcap")).open("rb") as source, (target / "bag.mcap").open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start("ros2")
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(source).iter_messages():
            index = counts[channel.topic] = counts.get(channel.topic, -1) + 1
            data = edit(channel.topic, index, message.data)
            if data is None:
                continue
            if channel.id not in channels:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, "cdr", schema_id)
            writer.add_message(channels[channel.id], message.log_time, data, message.publish_time)
        writer.finish()
    return target


def without_points(data: bytes) -> bytes:
    """A PointCloud2 of zero points: height and width 0, no data."""
    from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic

    with next(BAG.glob("*.mcap")).open("rb") as source:
        schemas = make_reader(source).get_summary().schemas.values()
    schema = next(s for s in schemas if s.name.endswith("PointCloud2"))
    text = schema.data.decode()
    message = generate_dynamic(schema.name, text)[schema.name](data)
    message.height, message.width, message.row_step, message.data = 0, 0, 0, b""
    return serialize_dynamic(schema.name, text)[schema.name](message)


def edited_calibration(tmp_path: Path, **changes) -> Path:
    values = yaml.safe_load((BAG / "calibration.yaml").read_text())
    values.update(changes)
    path = tmp_path / "calibration.yaml"
    path.write_text(yaml.safe_dump({k: v for k, v in values.items() if v is not None}))
    return path


def edited_protocol(tmp_path: Path, pairs, bag: Path = BAG) -> Path:
    values = json.loads((bag / "protocol.json").read_text())
    path = tmp_path / "protocol.json"
    path.write_text(json.dumps({"views": values["views"], "pairs": pairs(values["pairs"])}))
    return path


@pytest.fixture(scope="module")
def outputs(tmp_path_factory):
    """Two runs of the paper's protocol, everything written."""
    folder = tmp_path_factory.mktemp("replay")
    runs = []
    for name, quiet in (("first", []), ("second", ["--quiet"])):
        out = folder / name
        wanted = ["--json", out / "result.json", "--mcap", out / "result.mcap"]
        wanted += [] if quiet else ["--figures", out]
        run = vflatten("replay", BAG, "--protocol", BAG / "protocol.json", *wanted, *quiet)
        assert run.returncode == 0, run.stderr
        runs.append((run, out))
    return runs


def test_replay_finds_category_and_sizes_from_two_views(outputs):
    """Sizes of the paper's shirt: its own errors were up to 8.7 % on shirts."""
    result = json.loads((outputs[0][1] / "result.json").read_text())
    assert result["category"] == "long_sleeve_shirt"
    assert result["method"] == "kita2019"
    assert [view["id"] for view in result["views"]] == [17, 23]
    assert result["width_m"] == pytest.approx(0.36, rel=0.1)
    assert result["length_m"] == pytest.approx(0.35, rel=0.1)
    assert result["clouds"] == {"received": 24, "dropped": {}}


def test_every_point_of_the_result_is_a_pixel_on_the_item(outputs):
    """The recording's truth lists the pixels of the item, flying ones included."""
    points = json.loads((outputs[0][1] / "result.json").read_text())["points"]
    truth = np.load(BAG / "truth.npz")
    item = set(zip(*(truth[k].tolist() for k in ("view", "row", "col")), strict=True))
    given = list(zip(points["view"], points["row"], points["col"], strict=True))
    assert len(given) > 50
    assert len(set(given) & item) >= 0.98 * len(given)


def test_same_input_gives_the_same_bytes(outputs):
    texts = [(out / "result.json").read_text().splitlines() for _, out in outputs]
    first, second = ([line for line in t if not line.startswith(' "timing_s"')] for t in texts)
    assert first == second
    assert len(texts[0]) == len(first) + 1
    first, second = ((out / "result.mcap").read_bytes() for _, out in outputs)
    assert first == second


def test_a_rotation_gives_the_same_bytes_whatever_the_threads(tmp_path):
    """BLAS splits its sums by the number of threads, by default that of the machine's cores."""
    results = []
    for threads in ("1", "3"):
        out = tmp_path / f"{threads}.json"
        many = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), threads)
        run = vflatten(
            *("replay", SKIRT, "--method", "rotation", "--json", out, "--quiet"),
            env=os.environ | many,
        )
        assert run.returncode == 0, run.stderr
        lines = out.read_text().splitlines()
        results.append([line for line in lines if not line.startswith(' "timing_s"')])
    assert results[0] == results[1]


def test_the_table_says_what_was_found_used_and_dropped(outputs):
    run, _ = outputs[0]
    expected = (
        r"category +long_sleeve_shirt",
        r"width +\d\d\.\d ± \d",
        r"views 17, 23",
        r"5 corresponding points",
        r"24 read, 0 dropped",
        r"time +\d+\.\d\d s, \d+\.\d\d s after the last view: ",
    )
    for part in expected:
        assert re.search(part, run.stdout), part
    assert run.stderr == ""


def test_figures_are_written(outputs):
    names = {path.name for path in outputs[0][1].glob("*.png")}
    assert names == {
        "views.png", "geodesics.png", "flattening.png", "category.png", "summary.png",
    }  # fmt: skip


def test_quiet_prints_nothing(outputs):
    run, _ = outputs[1]
    assert (run.stdout, run.stderr) == ("", "")


def test_a_setting_that_is_unknown_is_refused(tmp_path):
    settings = tmp_path / "settings.yaml"
    settings.write_text("/**:\n  ros__parameters:\n    geodesics: {nodez: 40}\n")
    run = vflatten("replay", BAG, "--config", settings)
    assert_one_line(run, "unknown setting 'geodesics.nodez'; did you mean 'geodesics.nodes'?")


def test_flatten_takes_one_cloud(tmp_path):
    truth = np.load(BAG / "truth.npz")
    chosen = (truth["view"] == 17) & ~truth["flying"]
    rows, cols, depth = (truth[k][chosen] for k in ("row", "col", "depth"))
    camera = (
        json.loads((BAG / "truth.json").read_text()).get("camera")
        or yaml.safe_load((BAG / "calibration.yaml").read_text())["camera"]
    )
    cloud = np.full((camera["height"], camera["width"], 3), np.nan, np.float32)
    x = (cols - camera["cx"]) / camera["fx"] * depth
    y = (rows - camera["cy"]) / camera["fy"] * depth
    cloud[rows, cols] = np.stack([x, y, depth], axis=1)
    np.savez(tmp_path / "cloud.npz", xyz=cloud)
    out = tmp_path / "result.json"
    run = vflatten("flatten", tmp_path / "cloud.npz", "--json", out)
    assert run.returncode == 0, run.stderr
    result = json.loads(out.read_text())
    used = cloud[result["points"]["row"], result["points"]["col"]]
    assert len(used) > 300
    assert np.isfinite(used).all()
    # cloth that bends is longer than it hangs high, by no more than a third here
    ends = used[:, 1].argmin(), used[:, 1].argmax()
    flat = np.column_stack([result["points"]["u"], result["points"]["v"]])
    apart, apart_flat = (np.linalg.norm(x[ends[0]] - x[ends[1]]) for x in (used, flat))
    assert 0.99 < apart_flat / apart < 1.33


def test_one_cloud_is_no_rotation(tmp_path):
    np.savez(tmp_path / "cloud.npz", xyz=np.ones((9, 9, 3), np.float32))
    run = vflatten("flatten", tmp_path / "cloud.npz", "--method", "rotation")
    assert_one_line(run, "one cloud is no rotation")


def assert_one_line(run, *parts):
    assert run.returncode == 1
    assert run.stdout == ""
    assert run.stderr.count("\n") == 1, run.stderr
    assert run.stderr.startswith("vflatten: ")
    assert "Traceback" not in run.stderr
    for part in parts:
        assert part in run.stderr, run.stderr


def test_a_recording_that_does_not_exist(tmp_path):
    assert_one_line(vflatten("replay", tmp_path / "none"), "none: no such recording")


def test_a_recording_without_a_calibration(tmp_path):
    bag = copy(tmp_path / "bag")
    (bag / "calibration.yaml").unlink()
    assert_one_line(vflatten("replay", bag), "calibration.yaml: no such file", "--calibration")


def test_a_truncated_recording_without_any_cloud(tmp_path):
    bag = copy(tmp_path / "bag")
    whole = (bag / "bag.mcap").read_bytes()
    (bag / "bag.mcap").write_bytes(whole[:3000])
    assert_one_line(vflatten("replay", bag), "bag.mcap", "(EndOfFile)")


def test_a_recording_without_clouds(tmp_path):
    bag = copy(tmp_path / "bag", lambda topic, i, data: None if topic == CLOUDS else data)
    assert_one_line(vflatten("replay", bag), "PointCloud2", JOINTS)


def test_a_recording_without_joint_states(tmp_path):
    bag = copy(tmp_path / "bag", lambda topic, i, data: None if topic == JOINTS else data)
    assert_one_line(vflatten("replay", bag), "JointState", CLOUDS)


def test_a_recording_without_the_named_joint(tmp_path):
    calibration = edited_calibration(tmp_path, joint="elbow")
    run = vflatten("replay", BAG, "--calibration", calibration)
    assert_one_line(run, "elbow", "wrist_roll")


def test_clouds_outside_the_time_of_the_joint_states(tmp_path):
    bag = copy(tmp_path / "bag", lambda topic, i, data: None if topic == JOINTS and i > 3 else data)
    assert_one_line(vflatten("replay", bag), "clouds gave a view", "too_old")


def test_only_empty_clouds(tmp_path):
    def edit(topic, index, data):
        return (without_points(data) if index < 3 else None) if topic == CLOUDS else data

    assert_one_line(vflatten("replay", copy(tmp_path / "bag", edit)), "empty_after_segmentation 3")


def test_what_can_be_worked_round_is_counted_and_the_rest_goes_on(tmp_path):
    """One cloud is empty, the end is missing, one corresponding point lies beside the item."""

    def edit(topic, index, data):
        return without_points(data) if topic == CLOUDS and index == 5 else data

    bag = copy(tmp_path / "bag", edit, SHORTS)
    whole = (bag / "bag.mcap").read_bytes()
    (bag / "bag.mcap").write_bytes(whole[: int(0.8 * len(whole))])
    protocol = edited_protocol(tmp_path, lambda pairs: [*pairs, {"a": [2, 2], "b": [3, 3]}], SHORTS)
    out = tmp_path / "result.json"
    run = vflatten("replay", bag, "--protocol", protocol, "--json", out)
    assert run.returncode == 0, run.stderr
    clouds = json.loads(out.read_text())["clouds"]
    assert 15 <= clouds["received"] < 24
    assert clouds["dropped"] == {"empty_after_segmentation": 1}
    assert f"{clouds['received']} read, 1 dropped" in run.stdout
    lines = run.stderr.splitlines()
    assert [line.split(": ")[:2] for line in lines] == [["vflatten", "warning"]] * 2
    assert "bag.mcap: ends early or is damaged" in lines[0]
    assert "corresponding point 5 left out" in lines[1]


@pytest.mark.parametrize(
    ("pairs", "says"),
    [
        (lambda pairs: [], "0 of 0 corresponding points are usable, at least 2"),
        (lambda pairs: pairs[:1], "1 of 1 corresponding points are usable, at least 2"),
        (lambda pairs: [{"a": [2, 2], "b": [3, 3]}] * 3, "not on the item"),
        (lambda pairs: [{"a": [2, 2], "b": [3, 3]}] * 3, "; and 2 more"),
        (lambda pairs: [{"a": [2000, 2], "b": [3, 3]}] * 3, "outside view 17"),
        (lambda pairs: [{"a": "x"}], "expected 'views'"),
    ],
)
def test_correspondences_that_do_not_serve(tmp_path, pairs, says):
    protocol = edited_protocol(tmp_path, pairs)
    assert_one_line(vflatten("replay", BAG, "--protocol", protocol), f"{protocol}: ", says)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"axis_direction": [0.0, 0.0, 0.0]}, "axis_direction"),
        ({"gripper_tip": None}, "gripper_tip"),
        ({"joint_sign": 0.5}, "joint_sign"),
    ],
)
def test_calibrations_that_describe_no_rig(tmp_path, changes, says):
    run = vflatten("replay", BAG, "--calibration", edited_calibration(tmp_path, **changes))
    assert_one_line(run, says, "calibration.yaml")


def test_a_view_that_does_not_exist():
    run = vflatten("replay", BAG, "--views", "3,99", "--method", "kita2019")
    assert_one_line(run, "cloud 99 is not in the recording; there are views 0, 1, 2")


def test_a_view_that_is_asked_for_but_was_dropped_says_why(tmp_path):
    def edit(topic, index, data):
        return without_points(data) if (topic, index) == (CLOUDS, 3) else data

    run = vflatten("replay", copy(tmp_path / "bag", edit), "--views", "3,9")
    assert_one_line(run, "cloud 3 gave no view, empty_after_segmentation: ")


def test_one_view_is_too_few_for_the_automatic_method():
    run = vflatten("replay", BAG, "--views", "3")
    assert_one_line(run, "needs two views or more, got 1", "--method kita2019")


def test_an_output_that_cannot_be_written(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    run = vflatten("replay", BAG, "--protocol", BAG / "protocol.json", "--json", blocked / "x.json")
    assert_one_line(run, str(blocked))


@pytest.mark.parametrize("arguments", [[], ["bogus"], ["replay"], ["replay", BAG, "--views", "a"]])
def test_wrong_usage_exits_with_2(arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        main([str(a) for a in arguments])
    assert stop.value.code == 2
    assert "usage: vflatten" in capsys.readouterr().err


def test_version_is_the_package_s():
    declared = re.search(r"<version>(.+)</version>", (ROOT / "package.xml").read_text())
    assert declared is not None
    assert vflatten("--version").stdout == f"vflatten {declared[1]}\n"


def test_interrupt_ends_cleanly_and_leaves_no_file(tmp_path):
    out = tmp_path / "result.json"
    process = subprocess.Popen(
        [*START, "replay", str(BAG), "--json", str(out)],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    time.sleep(1.5)  # in the midst of it, wherever that is
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=30)
    if process.returncode != 0:  # it was not done yet
        assert (process.returncode, stdout, stderr) == (130, "", "vflatten: cancelled\n")
        assert list(tmp_path.iterdir()) == []


def test_a_terminal_gets_a_progress_bar():
    primary, secondary = pty.openpty()
    fcntl.ioctl(secondary, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    command = [*START, "replay", str(BAG), "--views", "99"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=secondary)
    os.close(secondary)
    shown = b""
    with contextlib.suppress(OSError):  # the other end closes
        while part := os.read(primary, 4096):
            shown += part
    os.close(primary)
    assert process.wait(timeout=60) == 1
    assert b"views" in shown
    last = shown.split(b"\r")[-2].strip()
    assert last.startswith(b"vflatten: "), "the bar is gone before the message"


def test_calibrate_finds_the_axis_by_what_hangs_there(tmp_path):
    """From a guess 5 cm and 4 degrees off, with the sign of the joint wrong."""
    true = yaml.safe_load((SKIRT / "calibration.yaml").read_text())
    guess = edited_calibration(
        tmp_path,
        **true
        | {
            "axis_point": np.add(true["axis_point"], [0.04, 0.0, 0.03]).tolist(),
            "gripper_tip": np.add(true["gripper_tip"], [0.04, 0.0, 0.03]).tolist(),
            "axis_direction": [0.05, -1.0, 0.03],
            "joint_sign": -true["joint_sign"],
        },
    )
    refused = vflatten("replay", SKIRT, "--calibration", guess)
    assert refused.returncode == 1
    assert f"set joint_sign to {true['joint_sign']}" in refused.stderr
    found = tmp_path / "found" / "calibration.yaml"
    wanted = ["--output", found, "--figures", tmp_path]
    run = vflatten("calibrate", SKIRT, "--calibration", guess, *wanted)
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")
    assert (tmp_path / "axis.png").stat().st_size > 10_000
    values = yaml.safe_load(found.read_text())
    assert {k: values[k] for k in ("frame", "joint", "joint_sign", "joint_zero")} == {
        k: true[k] for k in ("frame", "joint", "joint_sign", "joint_zero")
    }
    up = np.array(true["axis_direction"])
    lean = np.linalg.norm(np.cross(up, values["axis_direction"]))
    away = np.cross(np.array(values["axis_point"]) - true["axis_point"], up)
    assert lean < np.radians(0.15)
    assert np.linalg.norm(away) < 0.0015
    again = vflatten("calibrate", SKIRT, "--calibration", found)
    said = re.match(
        r"# By vflatten calibrate. The axis was (.*) mm and (.*) degrees off", again.stdout
    )
    assert float(said[1]) < 0.5
    assert float(said[2]) < 0.05


def test_calibrate_says_what_is_missing(tmp_path):
    run = vflatten("calibrate", SKIRT, "--calibration", tmp_path / "none.yaml")
    assert run.returncode == 1
    assert "no such file; give one with --calibration" in run.stderr
    run = vflatten("calibrate", BAG, "--output", tmp_path)
    assert run.returncode == 1
    assert "is a folder, expected a file" in run.stderr
