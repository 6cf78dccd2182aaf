"""Runs the node: `vflatten node`, `ros2 run vflatten_ros vflatten_node`."""

# ruff: noqa: E402  (threads must be limited before numpy is imported)
from __future__ import annotations

from vflatten_ros import threads

threads.use_one()  # the flattening process inherits it

import argparse
import json
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from vflatten_ros import transport
from vflatten_ros.core.errors import VFlattenError
from vflatten_ros.flatten_node import FlattenNode
from vflatten_ros.parameters import NodeOptions
from vflatten_ros.worker import Load

MAX_ERRORS = 1000  # in a row
ANSWERS_S = 1.0  # longest that the last answers may take to be written
LEAVE_S = 0.2  # and then to leave


class EndAsked:
    """Whether SIGINT or SIGTERM came. Callable.

    In place of rclpy's handlers, which shut the context down from a thread of their own and raise
    KeyboardInterrupt wherever the node is: of nodes that were busy a few in a hundred ended with a
    traceback, or not at all. With a flag the callback at hand is finished, and the node
    taken down in order; its timers wake it 20 times a second.
    """

    def __init__(self) -> None:
        self.name = "the context was shut down"
        self._came = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._note)

    def _note(self, number: int, _: object) -> None:
        self.name = signal.Signals(number).name
        self._came = True

    def __call__(self) -> bool:
        return self._came


def spin(node: FlattenNode, end_asked: EndAsked) -> None:
    """Serve until the end is asked for or the context is shut down; then answer who waits.

    A mistake of ours costs one callback, not the node.
    """
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    in_a_row = 0
    while rclpy.ok() and not end_asked():
        try:
            executor.spin_once()
            in_a_row = 0
        except ExternalShutdownException:
            break
        except Exception:
            if not rclpy.ok():
                break
            node.errors += 1
            in_a_row += 1
            text = f"internal error, please report it:\n{traceback.format_exc()}"
            node.log.warning(text, cause="spin")
            if in_a_row == MAX_ERRORS:  # nothing works any more: better to be started anew
                raise
    if node.end(end_asked.name) and rclpy.ok():
        _let_answers_leave(node, executor)


def _let_answers_leave(node: FlattenNode, executor: SingleThreadedExecutor) -> None:
    """Who waits for a result has been told that none will come; that must be sent, too."""
    with suppress(Exception):  # it ends anyway
        end = time.monotonic() + ANSWERS_S
        while node.answering and time.monotonic() < end:
            executor.spin_once(timeout_sec=0.02)
        end = time.monotonic() + LEAVE_S
        while time.monotonic() < end:
            executor.spin_once(timeout_sec=0.02)


def main(
    argv: Sequence[str] | None = None, loader: Callable[[NodeOptions], Load] | None = None
) -> int:
    """Run the node.

    Parameters
    ----------
    argv : sequence of str, optional
        Options, and ROS arguments after `--ros-args`; by default those of the command line.
    loader : callable, optional
        What flattens instead of the method; for tests.

    Returns
    -------
    int
        0 after SIGINT, SIGTERM or a shutdown, 1 where a parameter is wrong.
    """
    transport.use_profile()
    try:
        rclpy.init(
            args=[sys.argv[0], *_ros_arguments(sys.argv[1:] if argv is None else argv)],
            signal_handler_options=SignalHandlerOptions.NO,
        )
    except RuntimeError as error:  # of rcl, which parses the arguments
        print(f"vflatten node: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    end_asked = EndAsked()
    try:
        node = FlattenNode(loader=loader)
    except VFlattenError as error:
        print(f"vflatten node: {error}", file=sys.stderr)
        rclpy.try_shutdown()
        return 1
    try:
        if node.settings.node.node.autostart:
            node.autostart()
        spin(node, end_asked)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


def parser() -> argparse.ArgumentParser:
    """Options of the command."""
    options = argparse.ArgumentParser(
        prog="vflatten node",
        description="Run the live node; docs/node.md describes it.",
        epilog="ROS arguments (parameters, remapping, namespace) follow after --ros-args.",
        allow_abbrev=False,
    )
    options.add_argument("--params-file", metavar="FILE", help="settings, as config/vflatten.yaml")
    options.add_argument(
        "--calibration", metavar="FILE", help="calibration.yaml of rig and gripper"
    )
    options.add_argument("--name", help="name of the node (default vflatten)")
    return options


def _ros_arguments(argv: Sequence[str]) -> list[str]:
    """Our own options as ROS arguments; everything from --ros-args on stays as it is.

    What comes later wins: a parameter given on the command line over one in a file.
    """
    given = list(argv)
    at = given.index("--ros-args") if "--ros-args" in given else len(given)
    args = parser().parse_args(given[:at])
    first = ["--params-file", args.params_file] if args.params_file else []
    last = ["-r", f"__node:={args.name}"] if args.name else []
    if args.calibration:
        # quoted: a name may look like a number
        last += ["-p", f"calibration.file:={json.dumps(args.calibration)}"]
    return [*_group(first), *given[at:], *_group(last)]


def _group(arguments: list[str]) -> list[str]:
    return ["--ros-args", *arguments, "--"] if arguments else []


if __name__ == "__main__":
    sys.exit(main())
