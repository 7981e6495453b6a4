"""What the bridges to Foxglove and Zenoh cost a mapper's step: the same frames in laps, with and without them.

A mapper, both bridges and a client that receives all that either has run as processes of their own. In every other lap
bridges and client are frozen, which leaves the mapper as it is without them. A frame is sent at its time, or when the
mapper has answered the one before. What counts is a lap's frames from ``--skip`` seconds on: for a quarter of a second
after a request for changes a mapper makes snapshots for the next one.

Example: python -m benchmarks.bridges kitchen.mcap --laps 13 --frames 100 --hz 5
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from numpy.typing import NDArray

from benchmarks.foxglove_client import FoxgloveClient
from semantic_mapper.nodes.bridge.feed import lower_priority
from semantic_mapper.nodes.launcher.liveness import end_with_launcher
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.transport.codec import encode, encode_frame
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.transport.sockets import LosslessSubscriber, Publisher
from semantic_mapper.types import MapUpdate, PosedFrame

PATIENCE_S = 300.0
DRAWS = 1000
Steps = dict[tuple[bool, int, int], tuple[float, float]]  # by whether bridges work, pair of laps, place of the frame
NODES = ("camera", "mapper", "query", "foxglove", "zenoh")


def main() -> None:
    """Print the cost as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("log", type=Path)
    parser.add_argument("--laps", type=int, default=13, help="the first one only builds the map")
    parser.add_argument("--frames", type=int, default=100, help="of a lap")
    parser.add_argument("--hz", type=float, default=5.0)
    parser.add_argument("--skip", type=float, default=1.0, help="seconds at the beginning of a lap that do not count")
    parser.add_argument("--voxel-size", type=float, default=0.0)
    parser.add_argument("--client", nargs=2, metavar=("PORT", "ADDRESS"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.client:
        receive_all(int(args.client[0]), args.client[1])
        return
    with open_log(args.log) as reader:
        info = reader.info
        frames = [item for item in reader.frames_or_errors(args.frames) if isinstance(item, PosedFrame)]
    with tempfile.TemporaryDirectory(prefix="sm-") as folder:
        report = measure(Path(folder), info, frames, args)
    print(json.dumps(report | {"load": os.getloadavg()}, indent=1))


def measure(folder: Path, info: StreamInfo, frames: list[PosedFrame], args: argparse.Namespace) -> dict[str, Any]:
    """Map the frames in laps."""
    endpoints = {name: f"ipc://{folder}/{name}" for name in NODES}
    port, zenoh_port = _free_ports(2)
    address = f"tcp/127.0.0.1:{zenoh_port}"
    mapper = {"out": str(folder / "out"), "delivery": "all", "voxel_size_m": args.voxel_size}
    with ExitStack() as stack:
        camera = stack.enter_context(Publisher(endpoints["camera"]))
        mapping = stack.enter_context(_node("mapper", mapper, endpoints))
        beside = [
            stack.enter_context(_node("foxglove", {"port": port}, endpoints)),
            stack.enter_context(_node("zenoh", {"listen": address}, endpoints)),
        ]
        camera.wait_for_subscribers("frame", 3, PATIENCE_S)
        command = [sys.executable, "-m", "benchmarks.bridges", str(args.log), "--client", str(port), address]
        client = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, preexec_fn=end_with_launcher)
        stack.callback(_end, client)
        beside.append(client)
        answers = stack.enter_context(LosslessSubscriber(endpoints["mapper"], ("map", "refused")))
        answers.wait_until_heard(PATIENCE_S)
        camera.publish(encode(info))
        steps, cpu = _drive(camera, answers, frames, mapping.pid, beside, args)
        for process in beside:
            os.kill(process.pid, signal.SIGCONT)
        used = {name: _cpu_s(process.pid) for name, process in zip(("foxglove", "zenoh"), beside, strict=False)}
        client.send_signal(signal.SIGINT)
        received, _ = client.communicate(timeout=PATIENCE_S)
    working_frames = sum(map(_working, range(args.laps))) * len(frames)
    return (
        _compare(steps)
        | _compare_cpu(cpu)
        | {f"{name}_cpu_ms_a_frame": round(1e3 * s / working_frames, 1) for name, s in used.items()}
        | {"frames": args.frames, "laps": args.laps, "hz": args.hz, "received": json.loads(received)}
    )


def _drive(
    camera: Publisher,
    answers: LosslessSubscriber,
    frames: list[PosedFrame],
    mapper: int,
    beside: list[subprocess.Popen[str]],
    args: argparse.Namespace,
) -> tuple[Steps, dict[bool, list[float]]]:
    """Step and turnaround in ms of frames; and by whether bridges were at work, the mapper's processor ms a frame."""
    steps: Steps = {}
    cpu: dict[bool, list[float]] = {True: [], False: []}
    seq, due = 0, time.monotonic()
    for lap in range(args.laps):
        working = _working(lap)
        for process in beside:
            os.kill(process.pid, signal.SIGCONT if working else signal.SIGSTOP)
        used_s = 0.0
        for place, frame in enumerate(frames):
            if place == round(args.skip * args.hz):
                used_s = _cpu_s(mapper)
            due = max(due + 1 / args.hz, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))
            stamped = encode_frame(dataclasses.replace(frame, seq=seq, stamp_ns=time.monotonic_ns()))
            began = time.monotonic()
            camera.publish(stamped)
            answer = answers.receive(PATIENCE_S)
            if isinstance(answer, MapUpdate) and lap and place >= args.skip * args.hz:
                turnaround = 1e3 * (time.monotonic() - began)
                steps[working, (lap - 1) // 2, place] = sum(answer.stage_ms.values()), turnaround
            seq += 1
        if lap:
            cpu[working].append(1e3 * (_cpu_s(mapper) - used_s) / (len(frames) - round(args.skip * args.hz)))
    return steps, cpu


def _working(lap: int) -> bool:
    """Whether bridges work in a lap: after the first, with, without, without, with, ..."""
    return lap % 4 in (0, 1)


def _cpu_s(pid: int) -> float:
    times = psutil.Process(pid).cpu_times()
    return times.user + times.system


def _compare_cpu(cpu: dict[bool, list[float]]) -> dict[str, Any]:
    without, with_them = (float(np.mean(cpu[working])) for working in (False, True))
    row = {"without": round(without, 1), "with": round(with_them, 1), "ratio": round(with_them / without, 3)}
    return {"mapper_cpu_ms_a_frame": row}


def _compare(steps: Steps) -> dict[str, Any]:
    both = [(pair, place) for working, pair, place in steps if working and (False, pair, place) in steps]
    table = {working: np.array([steps[working, pair, place] for pair, place in both]) for working in (False, True)}
    laps = np.array([pair for pair, _ in both])
    found: dict[str, Any] = {"pairs": len(both)}
    for column, name in enumerate(("step_ms", "turnaround_ms")):
        for percent in (50, 95, 99):
            without, with_them = (float(np.percentile(table[w][:, column], percent)) for w in (False, True))
            row = {"without": round(without, 1), "with": round(with_them, 1), "ratio": round(with_them / without, 3)}
            found[f"{name}_p{percent}"] = row | {"interval": _interval(laps, table, column, percent)}
        ratios = table[True][:, column] / table[False][:, column]
        found[f"{name}_ratio_median"] = round(float(np.median(ratios)), 3)
    return found


def _interval(
    laps: NDArray[np.int64], table: dict[bool, NDArray[np.float64]], column: int, percent: int
) -> list[float]:
    """95 % interval of a ratio of percentiles, pairs of laps drawn with replacement."""
    rng, names = np.random.default_rng(0), np.unique(laps)
    rows = [np.flatnonzero(laps == name) for name in names]
    ratios: list[float] = []
    for _ in range(DRAWS):
        drawn = np.concatenate([rows[i] for i in rng.integers(len(rows), size=len(rows))])
        without, with_them = (np.percentile(table[w][drawn, column], percent) for w in (False, True))
        ratios.append(float(with_them / without))
    return np.percentile(ratios, (2.5, 97.5)).round(3).tolist()


def receive_all(port: int, address: str) -> None:
    """Receive all that both bridges have until SIGINT, then print how much that was."""
    import zenoh

    lower_priority()
    came: Counter[str] = Counter()
    stop = threading.Event()
    signal.signal(signal.SIGINT, lambda *_: stop.set())
    config = zenoh.Config()
    settings = {"mode": "client", "connect/endpoints": [address], "scouting/multicast/enabled": False}
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))

    def count(sample: zenoh.Sample) -> None:
        came["zenoh messages"] += 1
        came["zenoh MB"] += len(sample.payload)

    with zenoh.open(config) as session, FoxgloveClient(f"ws://127.0.0.1:{port}") as client:
        subscriber = session.declare_subscriber("semantic_mapper/**", count)
        while not stop.is_set():
            message = client.receive(0.2)
            if message is not None:
                came["foxglove messages"] += 1
                came["foxglove MB"] += len(message.data)
        subscriber.undeclare()
    print(json.dumps({name: n // 10**6 if name.endswith("MB") else n for name, n in came.items()}))


@contextmanager
def _node(kind: str, options: dict[str, Any], endpoints: dict[str, str]) -> Iterator[subprocess.Popen[str]]:
    """A node process that ends with us."""
    job = {"name": kind, "options": options, "endpoints": endpoints}
    process = subprocess.Popen(
        [sys.executable, "-I", "-m", f"semantic_mapper.nodes.{kind}", json.dumps(job)],
        stdout=sys.stderr,
        text=True,
        preexec_fn=end_with_launcher,  # frozen ones, too
    )
    try:
        yield process
    finally:
        _end(process)


def _end(process: subprocess.Popen[str]) -> None:
    if process.poll() is None:
        process.send_signal(signal.SIGCONT)
        process.terminate()
        try:
            process.wait(60)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _free_ports(count: int) -> list[int]:
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [one.getsockname()[1] for one in sockets]


if __name__ == "__main__":
    main()
