"""What a fleet costs beside a serial run, and how far one driver goes.

    overhead     tiny logs by a fleet with one worker: milliseconds a log in the operation, and beside it
    many         10,000 tiny files through scheduler and store with an operation that only counts bytes: rate, memory
    workers      replay by one process, by two independent processes, and by a fleet of two workers

Example: python -m research.experiments.fleet_scaling overhead many workers --out runs/fleet-scaling
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import psutil

from research.experiments.fleet_faults import write_logs
from semantic_mapper.config import Config
from semantic_mapper.nodes.fleet import operations, worker
from semantic_mapper.nodes.fleet.cluster import connected
from semantic_mapper.nodes.fleet.inputs import LogInput, find_inputs
from semantic_mapper.nodes.fleet.operations import Job, Operation
from semantic_mapper.nodes.fleet.results import Findings
from semantic_mapper.nodes.fleet.runner import DriverStatus, FleetRun, Resources
from semantic_mapper.nodes.fleet.start import make_template
from semantic_mapper.nodes.fleet.store import Store
from semantic_mapper.nodes.fleet.worker import Outcome, Task, run_task

TINY_LOGS, TINY_FRAMES = 20, 2
WORKER_LOGS, WORKER_FRAMES = 8, 40
MANY = 10_000
REPEATS = 2
SETTINGS = ("quality=fast", "voxel_map.voxel_size_m=0.05")
TIMES = "FLEET_SCALING_TIMES"  # environment variable: folder of what ``timed_task`` measures
_OPERATE = worker._operate  # pyright: ignore[reportPrivateUsage]
SMALL = Resources(cpus=1.0, memory_bytes=500_000_000)


def count_bytes(task: Task) -> Outcome:
    """``run_task`` with an operation that takes no time; everything else is as always."""

    def run(job: Job) -> Findings:
        return Findings(metrics={"bytes": float(job.log.stat().st_size)})

    counting = {"replay": Operation(Config, "", run, 0.1)}
    with patch.object(operations, "OPERATIONS", counting):
        return run_task(task)


def timed_task(task: Task) -> Outcome:
    """``run_task``, which adds the seconds of its operation alone to a file of this process."""

    def operate(*arguments: Any) -> Findings:
        began = time.monotonic()
        found = _OPERATE(*arguments)
        with Path(os.environ[TIMES], f"{os.getpid()}.txt").open("a") as file:
            file.write(f"{time.monotonic() - began}\n")
        return found

    with patch.object(worker, "_operate", operate):
        return run_task(task)


def overhead(out: Path) -> dict[str, object]:
    """Milliseconds of each log that one worker does not spend in its operation, from hand-out to commit.

    Differences to a serial run of the same logs would say the same, but for how much the machine drifts between runs.
    """
    logs = write_logs(out / "tiny", TINY_LOGS, TINY_FRAMES)
    times = out / "times"
    os.environ[TIMES] = str(times.absolute())
    found: list[tuple[float, float]] = []
    with connected(None, cpus=1) as cluster:
        for _ in range(1 + REPEATS):  # the first one loads packages and is not counted
            for folder in (out / "fleet", times):
                shutil.rmtree(folder, ignore_errors=True)
            times.mkdir()
            store = Store(str(out / "fleet"), create=True)
            template = make_template("replay", store, None, SETTINGS)
            inputs = find_inputs([str(log) for log in logs], ".mcap")
            began = time.monotonic()
            run = FleetRun(store, template, inputs, SMALL, cluster, function=timed_task)
            status = run.run(lambda: False, lambda now: None)
            seconds = time.monotonic() - began
            operations_s = [float(line) for file in times.iterdir() for line in file.read_text().split()]
            assert status.done == len(operations_s) == len(logs)
            found.append((1e3 * sum(operations_s) / len(logs), 1e3 * (seconds - sum(operations_s)) / len(logs)))
    return {
        "logs": len(logs),
        "operation_ms_a_log": [round(operation, 1) for operation, _ in found[1:]],
        "added_ms_a_log": [round(added, 1) for _, added in found[1:]],
    }


def many(out: Path) -> dict[str, object]:
    """10,000 files: rate and memory of the driver."""
    folder = out / "many"
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(MANY):
        (folder / f"{number:05}.mcap").write_bytes(f"log {number}".encode())
    shutil.rmtree(out / "many-store", ignore_errors=True)
    store = Store(str(out / "many-store"), create=True)
    template = replace(make_template("replay", store), settings={})
    driver = psutil.Process()
    samples: list[tuple[int, float]] = []

    def watch(status: DriverStatus) -> None:
        over = status.done + status.existing + status.failed
        if not samples or over >= samples[-1][0] + MANY // 20:
            samples.append((over, driver.memory_info().rss / 1e6))

    inputs = [LogInput(item.url) for item in find_inputs([f"{folder}/*.mcap"], ".mcap")]
    with connected(None, cpus=2) as cluster:
        began = time.monotonic()
        status = FleetRun(store, template, inputs, SMALL, cluster, function=count_bytes).run(lambda: False, watch)
        seconds = time.monotonic() - began
        began = time.monotonic()
        again = FleetRun(store, template, inputs, SMALL, cluster, function=count_bytes).run(lambda: False, watch)
        again_s = time.monotonic() - began
    assert (status.done, again.existing) == (MANY, MANY)
    first = next(mb for over, mb in samples if over >= MANY // 10)
    return {
        "files": MANY,
        "logs_a_second": round(MANY / seconds, 1),
        "logs_a_second_when_done": round(MANY / again_s, 1),
        "driver_mb_after_a_tenth": round(first, 1),
        "driver_mb_most": round(max(mb for _, mb in samples), 1),
        "driver_mb": [(over, round(mb, 1)) for over, mb in samples],
    }


def workers(out: Path) -> dict[str, object]:
    """Rate of two workers as a multiple of that of one process."""
    logs = write_logs(out / "rooms", WORKER_LOGS, WORKER_FRAMES)
    rates: dict[str, list[float]] = {"one process": [], "two processes": [], "fleet, two workers": []}
    with connected(None, cpus=2) as cluster:
        for repeat in range(-1, REPEATS):
            found = {
                "one process": len(logs) / _processes(out, [logs]),
                "two processes": len(logs) / _processes(out, [logs[::2], logs[1::2]]),
            }
            shutil.rmtree(out / "fleet", ignore_errors=True)
            store = Store(str(out / "fleet"), create=True)
            template = make_template("replay", store, None, SETTINGS)
            inputs = find_inputs([str(log) for log in logs], ".mcap")
            began = time.monotonic()
            FleetRun(store, template, inputs, SMALL, cluster).run(lambda: False, lambda now: None)
            found["fleet, two workers"] = len(logs) / (time.monotonic() - began)
            if repeat >= 0:
                for name, rate in found.items():
                    rates[name].append(round(rate, 3))
    one = statistics.median(rates["one process"])
    ratios = {f"{name}, of two times one": round(statistics.median(r) / (2 * one), 3) for name, r in rates.items()}
    return {"logs": len(logs), "logs_a_second": rates, **ratios}


def _processes(out: Path, parts: list[list[Path]]) -> float:
    """Seconds that processes take, each on a core of its own for each part, once all have loaded their packages.

    One thread each would not do: numba and OpenCV start as many as there are cores.
    """
    program = (
        "import os, sys, time\n"
        "os.sched_setaffinity(0, {int(sys.argv[3])})\n"
        "from pathlib import Path\n"
        "from semantic_mapper.nodes.cli.run_replay import ReplayRequest, replay_log\n"
        "from semantic_mapper.nodes.fleet.operations import read_settings\n"
        "from semantic_mapper.nodes.process import StopRequest\n"
        "settings = read_settings('replay', sys.argv[2].split())\n"
        "def work(paths):\n"
        "    for path in map(Path, paths):\n"
        "        request = ReplayRequest(path, Path(sys.argv[1]) / path.stem, None, settings.mapper)\n"
        "        replay_log(request, StopRequest(), lambda count: None, lambda count: None)\n"
        "work(sys.argv[4:5])\n"
        "print('ready', flush=True)\n"
        "input()\n"
        "work(sys.argv[4:])\n"
    )
    shutil.rmtree(out / "serial", ignore_errors=True)
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    started = [
        subprocess.Popen(
            [sys.executable, "-c", program, str(out / "serial"), " ".join(SETTINGS), str(core), *map(str, part)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=environment,
        )
        for core, part in zip(sorted(os.sched_getaffinity(0)), parts, strict=False)
    ]
    for process in started:
        assert process.stdout is not None
        while (line := process.stdout.readline()) != "ready\n":  # after log lines
            assert line, "a process ended before it was ready"
    began = time.monotonic()
    for process in started:  # all at once
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
    for process in started:
        process.communicate()
        assert process.returncode == 0
    return time.monotonic() - began


def main() -> None:
    """Measure the parts that are named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = {"overhead": overhead, "many": many, "workers": workers}
    parser.add_argument("parts", nargs="+", choices=parts)
    parser.add_argument("--out", type=Path, default=Path("runs/fleet-scaling"))
    arguments = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    for name in arguments.parts:
        arguments.out.mkdir(parents=True, exist_ok=True)
        found = parts[name](arguments.out)
        (arguments.out / f"{name}.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        print(name, json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
