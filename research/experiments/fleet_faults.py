"""Break a fleet on purpose, and compare its store with what a serial run makes of the same logs.

    node      a Ray cluster of two nodes, as processes on loopback; one is killed (-9) in the middle
    driver    the process of `fleet run` is killed (-9); the same command goes on
    two       two `fleet run` at a time, into one store
    worker    processes that work on a log are killed (-9), one after the other

A round passes when every log has one result, each is equal to that of the serial run (figures, events, confusion
matrices; maps byte for byte), and nothing is quarantined.

Example: python -m research.experiments.fleet_faults --rounds 20 --out runs/fleet-faults
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import psutil

from research.experiments.ray_nodes import RayNodes, ray_nodes
from research.scenes import TRAIN_SEEDS, room_frames
from semantic_mapper.nodes.fleet.results import TaskResult, without_costs
from semantic_mapper.nodes.fleet.store import Store
from semantic_mapper.nodes.fleet.worker import file_digest
from semantic_mapper.replay.log.format import LogWriter
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics

CAMERA = CameraIntrinsics(66.0, 66.0, 47.5, 35.5, 96, 72)
LOGS, FRAMES = 10, 3
SETTINGS = ("--set", "quality=fast", "--set", "voxel_map.voxel_size_m=0.05", "--memory", "0.5")
TIMEOUT_S = 500.0
KINDS = ("node", "driver", "two", "worker")


def write_logs(folder: Path, count: int = LOGS, frames: int = FRAMES) -> list[Path]:
    """Small logs of rooms, one room each; those that are there stay."""
    from semantic_mapper.labels import ROOMS

    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for number in range(count):
        path = folder / f"room{number:03}.mcap"
        if not path.exists():
            draft = path.with_suffix(".part")
            info = StreamInfo("room", {"rooms": CAMERA}, ROOMS, frames)
            with LogWriter(draft, info) as log:
                for frame in room_frames(TRAIN_SEEDS[number], frames, CAMERA):
                    log.write_frame(frame)
            draft.rename(path)
        paths.append(path)
    return paths


def start_fleet(logs: Path, store: Path, nodes: RayNodes) -> subprocess.Popen[bytes]:
    """The command, as a user starts it."""
    command = [str(Path(sys.executable).parent / "semantic-mapper"), "fleet", "run", "replay", f"{logs}/*.mcap"]
    with (store.parent / f"{store.name}.log").open("ab") as file:
        return subprocess.Popen(
            [*command, "--out", str(store), "--ray", nodes.address, *SETTINGS],
            stdout=file,
            stderr=file,
            env={**os.environ, "OMP_NUM_THREADS": "1", **nodes.environment},
        )


def finish(process: subprocess.Popen[bytes], store: Path) -> None:
    """Wait for a fleet that has to end well."""
    if process.wait(TIMEOUT_S):
        log = (store.parent / f"{store.name}.log").read_text(errors="replace")
        raise RuntimeError(f"fleet run ended with {process.returncode}:\n{log[-3000:]}")


def wait_for(store: Path, results: int) -> None:
    """Until so many logs are done."""
    deadline = time.monotonic() + TIMEOUT_S
    while len(list(store.glob("results/*/result.json"))) < results:
        if time.monotonic() > deadline:
            raise RuntimeError(f"{store}: fewer than {results} results after {TIMEOUT_S:g} s")
        time.sleep(0.02)


def kill_node(nodes: RayNodes, logs: Path, store: Path, draw: random.Random) -> str:
    """One of two nodes dies."""
    node = nodes.start_worker(cpus=1)
    fleet = start_fleet(logs, store, nodes)
    after = draw.randrange(1, LOGS - 3)
    wait_for(store, after)
    time.sleep(draw.uniform(0, 0.3))
    nodes.kill(node)
    finish(fleet, store)
    return f"node killed after {after} logs"


def kill_driver(nodes: RayNodes, logs: Path, store: Path, draw: random.Random) -> str:
    """The driver dies and is started again; the cluster stays."""
    fleet = start_fleet(logs, store, nodes)
    after = draw.randrange(1, LOGS - 3)
    wait_for(store, after)
    time.sleep(draw.uniform(0, 0.3))
    fleet.send_signal(signal.SIGKILL)
    fleet.wait()
    finish(start_fleet(logs, store, nodes), store)
    return f"driver killed after {after} logs"


def two_drivers(nodes: RayNodes, logs: Path, store: Path, draw: random.Random) -> str:
    """Two fleets fill one store."""
    one = start_fleet(logs, store, nodes)
    time.sleep(draw.uniform(0, 2.0))
    other = start_fleet(logs, store, nodes)
    finish(one, store)
    finish(other, store)
    done = [status["done"] for status in _drivers(store)]
    return f"drivers did {' and '.join(map(str, done))} of {LOGS}"


def kill_workers(nodes: RayNodes, logs: Path, store: Path, draw: random.Random) -> str:
    """Processes that work on logs die, three in a round."""
    killed = 0
    fleet = start_fleet(logs, store, nodes)
    for after in sorted(draw.sample(range(1, LOGS - 3), 3)):
        wait_for(store, after)
        time.sleep(draw.uniform(0, 0.2))
        killed += _kill_worker(nodes, draw)
    finish(fleet, store)
    return f"{killed} workers killed"


def _kill_worker(nodes: RayNodes, draw: random.Random) -> int:
    busy = [p for p in nodes.processes() if _title(p).startswith("ray::") and "fleet replay" in _title(p)]
    if not busy:
        return 0
    draw.choice(busy).kill()
    return 1


def _title(process: psutil.Process) -> str:
    try:
        return " ".join(process.cmdline())
    except psutil.Error:
        return ""


ROUNDS: Mapping[str, Callable[[RayNodes, Path, Path, random.Random], str]] = {
    "node": kill_node,
    "driver": kill_driver,
    "two": two_drivers,
    "worker": kill_workers,
}


def _drivers(store: Path) -> list[dict[str, Any]]:
    return [json.loads(path.read_bytes()) for path in store.glob("drivers/*.json")]


def contents(store: Path) -> dict[str, tuple[Mapping[str, Any], str]]:
    """What a store says of each log, by the log's digest: all but costs, and the map's digest."""
    found: dict[str, tuple[Mapping[str, Any], str]] = {}
    for result in Store(str(store)).results():
        if result.log_digest in found:
            raise RuntimeError(f"{store}: two results of {result.log}")
        _check_files(store, result)
        found[result.log_digest] = (without_costs(result), file_digest(store / result.folder / "map.npz"))
    return found


def _check_files(store: Path, result: TaskResult) -> None:
    folder = store / result.folder
    sizes = {p.relative_to(folder).as_posix(): p.stat().st_size for p in folder.rglob("*") if p.is_file()}
    if sizes != {name: file.bytes for name, file in result.files.items()}:
        raise RuntimeError(f"{store}: the files of {result.log} are not those that its result names")


def serial(logs: Path, store: Path) -> None:
    """The same without Ray: one log after the other, in one process."""
    program = (
        "import sys\n"
        "from dataclasses import replace\n"
        "from pathlib import Path\n"
        "from semantic_mapper.nodes.fleet.start import make_template\n"
        "from semantic_mapper.nodes.fleet.worker import run_task\n"
        "from semantic_mapper.nodes.fleet.store import Store\n"
        "store = Store(sys.argv[2], create=True)\n"
        "sets = sys.argv[3:]\n"
        "template = make_template('replay', store, None, sets)\n"
        "for path in sorted(Path(sys.argv[1]).glob('*.mcap')):\n"
        "    run_task(replace(template, url=str(path)))\n"
    )
    sets = [word for word in SETTINGS if "=" in word]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    subprocess.run([sys.executable, "-c", program, str(logs), str(store), *sets], check=True, env=environment)


def play(kind: str, number: int, nodes: RayNodes, out: Path, wanted: object) -> dict[str, Any]:
    """One round; its store is kept where it did not pass."""
    store = out / f"{kind}-{number}"
    shutil.rmtree(store, ignore_errors=True)
    began = time.monotonic()
    what = ROUNDS[kind](nodes, out / "logs", store, random.Random(f"{kind} {number}"))
    passed = contents(store) == wanted and not list(store.glob("failed/*.json"))
    retries = sum(status["retries"] for status in _drivers(store))
    result = f"{kind} {number}: {'passed' if passed else 'FAILED'}; {what}; {retries} retries"
    print(f"{result}; {time.monotonic() - began:.0f} s", flush=True)
    if passed:
        shutil.rmtree(store)
    return {"passed": passed, "what": what, "retries": retries}


def main() -> None:
    """Run the rounds that are missing."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20, help="of each kind")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--out", type=Path, default=Path("runs/fleet-faults"), help="rounds that are in it are kept")
    arguments = parser.parse_args()
    out: Path = arguments.out
    logs = out / "logs"
    write_logs(logs)
    shutil.rmtree(out / "serial", ignore_errors=True)  # of this code
    serial(logs, out / "serial")
    wanted = contents(out / "serial")
    assert len(wanted) == LOGS
    journal = out / "rounds.jsonl"
    code = next(Store(str(out / "serial")).results()).code
    lines = [json.loads(line) for line in journal.read_text().splitlines()] if journal.exists() else []
    for kind in arguments.kinds:
        done = [line for line in lines if line["kind"] == kind and line["code"] == code]
        missing = range(len(done), arguments.rounds)
        if missing:
            with ray_nodes(head_cpus=1 if kind == "node" else 2) as nodes:
                for number in missing:
                    line = {"kind": kind, "round": number, **play(kind, number, nodes, out, wanted), "code": code}
                    lines.append(line)
                    with journal.open("a") as file:
                        file.write(json.dumps(line) + "\n")
    for kind in arguments.kinds:
        rounds = [line for line in lines if line["kind"] == kind and line["code"] == code]
        passed = sum(line["passed"] for line in rounds)
        print(f"{kind}: {passed} of {len(rounds)} rounds passed, {sum(line['retries'] for line in rounds)} retries")


if __name__ == "__main__":
    main()
