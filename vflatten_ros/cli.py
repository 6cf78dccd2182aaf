"""The command `vflatten`: replay a recording, flatten one cloud, find the axis, run the node, play.

Exit codes: 0 done, 1 failed (one line on stderr says why), 2 wrong usage, 130 interrupted.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import re
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from importlib import import_module, metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vflatten_ros import resources, threads
from vflatten_ros.core.config import METHODS, Config
from vflatten_ros.core.errors import InvalidInput, VFlattenError
from vflatten_ros.helper import helper_for
from vflatten_ros.progress import Stages

if TYPE_CHECKING:
    from vflatten_ros.replay import Replayed

OK, FAILED, INTERRUPTED = 0, 1, 130
PASSED_ON = {"node": "vflatten_ros.node", "play": "vflatten_ros.player"}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; gives the exit code."""
    threads.use_one()
    arguments = list(sys.argv[1:] if argv is None else argv)
    _forgive(sys.stdout, sys.stderr)
    try:
        if arguments and arguments[0] in PASSED_ON:
            return _pass_on(arguments[0], arguments[1:])
        args = _parser().parse_args(arguments)
        args.run(args)
        sys.stdout.flush()
    except KeyboardInterrupt:
        return _fail("cancelled", INTERRUPTED)
    except BrokenPipeError:  # the reader of our output has gone, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except VFlattenError as error:
        return _fail(str(error), FAILED)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _fail(where + (error.strerror or str(error)), FAILED)
    return OK


def _pass_on(command: str, arguments: list[str]) -> int:
    """Run a command that needs ROS; its module is only loaded here."""
    try:
        module = import_module(PASSED_ON[command])
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("vflatten_ros.") and error.name != "vflatten_ros.msg":
            raise
        return _fail(
            f"{command} needs ROS 2 and the built package ({error}); "
            "run 'make bootstrap && source env.sh', or source your ROS workspace",
            FAILED,
        )
    code: int | None = module.main(arguments)
    return code or OK


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="vflatten",
        description="Flatten a hanging garment, seen by a depth camera, virtually.",
        epilog="Exit codes: 0 done, 1 failed, 2 wrong usage, 130 interrupted.",
    )
    parser.add_argument("--version", action="version", version=f"vflatten {_version()}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    replay = commands.add_parser("replay", help="flatten the item of a recorded rotation")
    replay.set_defaults(run=_replay)
    replay.add_argument(
        "--protocol", type=Path, metavar="FILE",
        help="views and corresponding points given by hand; method kita2019 unless told otherwise",
    )  # fmt: skip
    replay.add_argument("--views", type=_view_ids, metavar="I,J", help="use these views only")
    _add_recorded(replay)
    replay.add_argument(
        "--processes", type=int, choices=(1, 2), default=2,
        help="with 2 (default), one tries other ways of laying the item flat meanwhile (method "
        "rotation); the result is the same",
    )  # fmt: skip
    _add_common(replay)

    flatten = commands.add_parser("flatten", help="flatten what one cloud shows, without a robot")
    flatten.set_defaults(run=_flatten)
    flatten.add_argument("cloud", type=Path, help=".npz, .npy or .ply")
    flatten.add_argument(
        "--up", type=_numbers(3), metavar="X,Y,Z", default=(0.0, -1.0, 0.0),
        help="upwards in the cloud's frame, as --up=0,-1,0 (default: optical frame)",
    )  # fmt: skip
    flatten.add_argument(
        "--crop", type=_numbers(6), metavar="X0,Y0,Z0,X1,Y1,Z1", help="use this box of the cloud, m"
    )
    _add_common(flatten)

    calibrate = commands.add_parser(
        "calibrate", help="find the wrist axis by a recorded rotation of any cloth"
    )
    calibrate.set_defaults(run=_calibrate, method=None)
    _add_recorded(calibrate)
    calibrate.add_argument(
        "--config", type=Path, metavar="FILE", help="settings, as config/vflatten.yaml"
    )
    calibrate.add_argument(
        "--output", type=Path, metavar="OUT", help="write the calibration there (default: print it)"
    )
    calibrate.add_argument("--figures", type=Path, metavar="DIR", help="draw axis.png")
    calibrate.add_argument("--quiet", action="store_true", help="no progress bar")

    commands.add_parser("node", help="run the live node (needs ROS 2); see vflatten node --help")
    commands.add_parser("play", help="publish a recording (needs ROS 2); see vflatten play --help")
    return parser


def _add_recorded(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=Path, help="rosbag2 folder or .mcap file")
    parser.add_argument(
        "--calibration",
        type=Path,
        metavar="FILE",
        help="default: calibration.yaml of the recording",
    )
    parser.add_argument("--cloud-topic", metavar="TOPIC", help="default: the only one")
    parser.add_argument("--joint-topic", metavar="TOPIC", help="default: the only one")


def _add_common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--method",
        choices=METHODS,
        help="default: kita2019 for one cloud and with --protocol, else the settings' method",
    )
    parser.add_argument(
        "--config", type=Path, metavar="FILE", help="settings, as config/vflatten.yaml"
    )
    parser.add_argument("--json", type=Path, metavar="OUT", help="write the result as JSON")
    parser.add_argument("--mcap", type=Path, metavar="OUT", help="write the node's messages")
    parser.add_argument("--figures", type=Path, metavar="DIR", help="draw the figures")
    parser.add_argument("--quiet", action="store_true", help="no table, no progress bar")


def _replay(args: argparse.Namespace) -> None:
    from vflatten_ros.replay import replay_recording

    _prepare_outputs(args)
    config = _config(args, "kita2019" if args.protocol else None)
    helper = helper_for(args.processes) if config.method == "rotation" else None
    with helper or nullcontext(), Stages(_show_bar(args)) as stages:
        replayed = replay_recording(
            args.recording,
            config,
            calibration=args.calibration,
            protocol=args.protocol,
            view_ids=args.views or (),
            cloud_topic=args.cloud_topic,
            joint_topic=args.joint_topic,
            progress=stages,
            warn=stages.warn,
            helper=helper,
        )
        _write(args, replayed, stages)
    _report(args, replayed, stages)


def _flatten(args: argparse.Namespace) -> None:
    from vflatten_ros.replay import flatten_file

    _prepare_outputs(args)
    if args.method == "rotation":
        raise InvalidInput(
            "--method rotation: one cloud is no rotation; leave the option away, or replay a "
            "recording"
        )
    config = _config(args, "kita2019")
    with Stages(_show_bar(args)) as stages:
        replayed = flatten_file(args.cloud, config, up=args.up, crop=args.crop, progress=stages)
        _write(args, replayed, stages)
    _report(args, replayed, stages)


def _calibrate(args: argparse.Namespace) -> None:
    from vflatten_ros.calibrate import calibrate_recording, calibration_text
    from vflatten_ros.output_files import make_folder, make_room, whole_file

    if args.output:
        make_room(args.output)
    if args.figures:
        make_folder(args.figures)
    with Stages(_show_bar(args)) as stages:
        found = calibrate_recording(
            args.recording,
            _config(args, "rotation"),
            calibration=args.calibration,
            cloud_topic=args.cloud_topic,
            joint_topic=args.joint_topic,
            progress=stages,
            warn=stages.warn,
        )
        if args.figures:
            from vflatten_ros.figures import draw_axis

            stages("figures", 0.0)
            draw_axis(found.given, found.views, args.figures / "axis.png")
    text = calibration_text(found.axis)
    if args.output is None:
        print(text, end="")
        return
    with whole_file(args.output) as partial:
        partial.write_text(text, encoding="utf-8")


def _prepare_outputs(args: argparse.Namespace) -> None:
    """What cannot be written fails before the work, not after it."""
    from vflatten_ros.output_files import make_folder, make_room

    for path in filter(None, (args.json, args.mcap)):
        make_room(path)
    if args.figures:
        make_folder(args.figures)


def _write(args: argparse.Namespace, replayed: Replayed, stages: Stages) -> None:
    """The files asked for; JSON last, as it tells the time of the others."""
    garment, views = replayed.garment, replayed.views
    if args.mcap:
        from vflatten_ros.mcap_output import write_mcap
        from vflatten_ros.outputs import result_messages

        stages("mcap", 0.0)
        write_mcap(args.mcap, result_messages(garment, views))
    if args.figures:
        from vflatten_ros.figures import draw_figures

        stages("figures", 0.0)
        draw_figures(garment, views, args.figures, replayed.templates)
    stages.stop()
    if args.json:
        from vflatten_ros.results import garment_result, write_json

        result = garment_result(garment, views)
        result["clouds"] = {"received": replayed.clouds, "dropped": dict(replayed.drops)}
        result["timing_s"] = stages.seconds
        write_json(args.json, result)


def _report(args: argparse.Namespace, replayed: Replayed, stages: Stages) -> None:
    """The table, unless told not to."""
    if not args.quiet:
        from vflatten_ros.summary import summary

        print(summary(replayed, stages.seconds))


def _show_bar(args: argparse.Namespace) -> bool:
    return not args.quiet and sys.stderr.isatty()


def _config(args: argparse.Namespace, default_method: str | None) -> Config:
    """Settings of --config, with the method of --method or else the command's own."""
    from vflatten_ros.files import load_config

    config = load_config(args.config) if args.config else Config()
    method = args.method or default_method
    return dataclasses.replace(config, method=method) if method else config


def _view_ids(text: str) -> tuple[int, ...]:
    try:
        ids = tuple(int(part) for part in text.split(","))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"expected view ids as 3,11; got {text!r}") from error
    if min(ids) < 0 or len(set(ids)) < len(ids):
        raise argparse.ArgumentTypeError(f"expected different ids from 0, got {text!r}")
    return ids


def _numbers(count: int) -> Any:
    """An argparse type: so many finite numbers, by commas."""

    def parse(text: str) -> tuple[float, ...]:
        try:
            values = tuple(float(part) for part in text.split(","))
        except ValueError:
            values = ()
        if len(values) != count or not all(abs(value) < 1e9 for value in values):
            raise argparse.ArgumentTypeError(f"expected {count} numbers by commas, got {text!r}")
        return values

    return parse


def _version() -> str:
    try:
        return metadata.version("vflatten_ros")
    except metadata.PackageNotFoundError:
        return re.findall(r"<version>(.+)</version>", resources.manifest())[0]


def _fail(text: str, code: int) -> int:
    print(f"vflatten: {' '.join(text.split())}", file=sys.stderr)
    return code


def _forgive(*streams: Any) -> None:
    """A terminal that cannot show a sign gets a question mark, not an error."""
    for stream in streams:
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")


if __name__ == "__main__":
    sys.exit(main())
