#!/usr/bin/env python3
"""Measures the live node: answers while it flattens, last cloud to result, memory over many clouds.

    source env.sh
    python3 benchmarks/node_bench.py RECORDING [--method rotation] [--clouds 10000]

The recording is published from this process, best effort; the node runs in its own processes.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.action import ActionClient
from rclpy.node import Node
from vflatten_ros.action import Flatten
from vflatten_ros.msg import Correspondence
from vflatten_ros.srv import AddCorrespondences, GetState

from vflatten_ros import transport
from vflatten_ros.bag import RecordedCloud, open_recording
from vflatten_ros.files import load_protocol
from vflatten_ros.messages import correspondence_fields, fill
from vflatten_ros.player import DISCOVERY_S, Player, rounds

COMPLETE = 2  # msg/ViewBufferState


class Bench(Node):
    """A planner that measures."""

    def __init__(self, recording: Path, method: str) -> None:
        super().__init__("bench")
        opened = open_recording(recording)
        self._messages = list(next(iter(rounds(opened, 2))))
        self._clouds = sum(isinstance(m, RecordedCloud) for m in self._messages)
        self._player = Player(self, opened, best_effort=True, clock=False)
        self._state = self.create_client(GetState, "vflatten/state")
        self._add = self.create_client(AddCorrespondences, "vflatten/add_correspondences")
        self._action = ActionClient(self, Flatten, "vflatten/flatten")
        self._method = method
        self._protocol: tuple[Any, Any] = ((), ())
        if method == "kita2019":
            self._protocol = load_protocol(recording / "protocol.json")

    def connect(self) -> None:
        while not (self._player.has_subscribers() and self._action.wait_for_server(0.1)):
            time.sleep(0.1)
        time.sleep(2 * DISCOVERY_S)

    def wait(self, future: Any) -> Any:
        while not future.done():
            rclpy.spin_once(self, timeout_sec=0.5)
        return future.result()

    def state(self) -> Any:
        return self.wait(self._state.call_async(GetState.Request()))

    def turn(self, rate: float) -> float:
        """Publish one rotation; when the last cloud went out (monotonic)."""
        last = max(i for i, m in enumerate(self._messages) if isinstance(m, RecordedCloud))
        self._player.play(self._messages[: last + 1], rate)
        at = time.monotonic()
        self._player.play(self._messages[last + 1 :], 1e6)
        return at

    def result_after_rotation(self, rate: float, pid: int) -> dict[str, Any]:
        """Latency of state calls while flattening; time from the last cloud to the result."""
        published = self.turn(rate)
        used = cpu_s(pid)
        while self.state().buffer.state != COMPLETE:
            if time.monotonic() - published > 20.0:
                raise TimeoutError("the rotation does not become complete")
        gathered = time.monotonic()
        views, pairs = self._protocol
        if pairs:
            fields = [fill(Correspondence(), correspondence_fields(pair, 0)) for pair in pairs]
            self.wait(self._add.call_async(AddCorrespondences.Request(pairs=fields)))
        goal = Flatten.Goal(method=self._method, view_ids=list(views))
        handle = self.wait(self._action.send_goal_async(goal))
        future = handle.get_result_async()
        latencies = []
        while not future.done():
            begin = time.perf_counter()
            self.state()
            latencies.append(time.perf_counter() - begin)
            time.sleep(0.01)
        answer = future.result().result
        total = time.monotonic() - published
        if answer.status.code:
            raise RuntimeError(answer.status.message)
        stages = dict(zip(answer.stages, answer.seconds, strict=True))
        return {
            "last_cloud_to_result_s": total,
            "gathered_s": gathered - published,
            "cpu_s": [after - before for after, before in zip(cpu_s(pid), used, strict=True)],
            "stages_s": stages,
            "state_ms": [1e3 * value for value in latencies],
        }

    def cancel_latency(self) -> float:
        """From the request to the result, s."""
        views = list(self._protocol[0])[::-1]  # another order: another task, not the last result
        goal = Flatten.Goal(method=self._method, view_ids=views or list(range(self._clouds - 1)))
        handle = self.wait(self._action.send_goal_async(goal))
        future = handle.get_result_async()
        while not self.state().flattening:  # its process may still start after the last cancel
            time.sleep(0.1)
        time.sleep(0.5)
        begin = time.perf_counter()
        handle.cancel_goal_async()
        self.wait(future)
        return time.perf_counter() - begin

    def memory(self, pid: int, clouds: int, rate: float) -> dict[str, Any]:
        """Resident memory of the node and its worker after each of many rotations."""
        series: list[tuple[int, float, float]] = []
        for turn in range(-(-clouds // self._clouds)):
            self.turn(rate)
            buffer = self.state().buffer
            series.append(((turn + 1) * self._clouds, *resident(pid)))
            if turn % 50 == 0:
                print(f"  {series[-1][0]} clouds: {series[-1][1]:.0f} + {series[-1][2]:.0f} MB, "
                      f"item {buffer.item}", flush=True)  # fmt: skip
        return {"clouds_node_mb_worker_mb": series}


def workers(pid: int) -> list[str]:
    """The node's flattening process."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [c for c in children if b"spawn_main" in Path(f"/proc/{c}/cmdline").read_bytes()]


def cpu_s(pid: int) -> tuple[float, float]:
    """CPU seconds so far of the node and of its flattening process."""
    return _cpu_s(str(pid)), sum(map(_cpu_s, workers(pid)))


def _cpu_s(pid: str) -> float:
    user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def resident(pid: int) -> tuple[float, float]:
    """MB of the node and of its flattening process."""
    return _resident(str(pid)), sum(map(_resident, workers(pid)))


def _resident(pid: str) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * 4096 / 1e6


def report(results: list[dict[str, Any]], cancels: list[float]) -> dict[str, Any]:
    """Print and return the figures."""
    state = np.concatenate([result["state_ms"] for result in results])
    totals = [result["last_cloud_to_result_s"] for result in results]
    middle = results[int(np.argsort(totals)[len(totals) // 2])]
    p50, p99 = np.percentile(state, [50, 99])
    print(f"state calls while flattening: {len(state)}, median {p50:.1f}, p99 {p99:.1f} ms, "
          f"longest {state.max():.1f} ms")  # fmt: skip
    print(f"last cloud to result: median {np.median(totals):.2f} s of {len(totals)}, of which")
    total = middle["last_cloud_to_result_s"]
    shares = {"gathering": middle["gathered_s"], **middle["stages_s"]}
    shares["asking and answering"] = total - sum(shares.values())
    for stage, seconds in shares.items():
        print(f"  {stage:22s} {seconds:6.3f} s {seconds / total:6.1%}")
    node, worker = middle["cpu_s"]
    print(f"CPU meanwhile: node {node:.2f} s, flattening process {worker:.2f} s; "
          f"load average {os.getloadavg()[0]:.1f}")  # fmt: skip
    print(f"cancel to answer: longest {1e3 * max(cancels):.0f} ms of {len(cancels)}")
    return {
        "state_p50_ms": p50,
        "state_p99_ms": p99,
        "last_cloud_to_result_s": float(np.median(totals)),
        "stages_s": shares,
        "cpu_s": {"node": node, "flattening process": worker},
        "cancel_ms": 1e3 * max(cancels),
    }


def draw(series: list[tuple[int, float, float]], path: Path) -> None:
    """The memory figure of docs/node.md."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    clouds, node, worker = np.array(series).T
    figure, axes = plt.subplots(figsize=(6.0, 2.6), layout="constrained")
    axes.plot(clouds, node, label="node", color="#0072b2")
    axes.plot(clouds, worker, label="flattening process", color="#e69f00")
    axes.set(xlabel="clouds", ylabel="resident memory, MB", ylim=(0, None), xlim=(0, None))
    axes.legend(frameon=False)
    figure.savefig(path, dpi=110)


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("recording", type=Path)
    options.add_argument("--method", default="kita2019", choices=("kita2019", "rotation"))
    options.add_argument("--rounds", type=int, default=3, help="rotations that are flattened")
    options.add_argument("--rate", type=float, default=4.0, help="of the recording")
    options.add_argument("--clouds", type=int, default=0, help="clouds of the memory run, 0: none")
    options.add_argument("--memory-rate", type=float, default=14.0)
    options.add_argument("--save", type=Path, metavar="JSON")
    options.add_argument("--figure", type=Path, metavar="PNG")
    args = options.parse_args()

    transport.use_profile()
    command = [sys.executable, "-m", "vflatten_ros.node"]
    command += ["--calibration", str(args.recording / "calibration.yaml")]
    command += ["--ros-args", "-p", "auto_flatten:=false"]
    command += ["-p", "no_data_warning_s:=600.0", "--log-level", "warn"]
    node = subprocess.Popen(command)
    rclpy.init()
    bench = Bench(args.recording, args.method)
    try:
        bench.connect()
        results = [bench.result_after_rotation(args.rate, node.pid) for _ in range(args.rounds)]
        cancels = [bench.cancel_latency() for _ in range(args.rounds)]
        figures = report(results, cancels)
        if args.clouds:
            figures |= bench.memory(node.pid, args.clouds, args.memory_rate)
            if args.figure:
                draw(figures["clouds_node_mb_worker_mb"], args.figure)
        if args.save:
            args.save.write_text(json.dumps(figures, indent=1) + "\n")
    finally:
        node.terminate()
        bench.destroy_node()
        rclpy.try_shutdown()
    return node.wait()


if __name__ == "__main__":
    sys.exit(main())
