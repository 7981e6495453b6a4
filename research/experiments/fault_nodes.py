"""Faults of a running launch: nodes killed or frozen, a stepped clock, a killed launcher."""

from __future__ import annotations

import itertools
import os
import re
import signal
import struct
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from research.experiments.fault_table import Outcome
from research.experiments.live_launch import NODES, PATIENCE_S, LiveLaunch, is_alive

ROUNDS_A_LAUNCH = 1  # two failures a node: the pause before the second restart is 0.2 s instead of 0.1 s
SETTLE_S = 1.5  # between two faults
STATUS_S = 2.5  # until a restarted recorder has published a status
STEPS_S = (3600, -3600)  # where the clock is set, from the true time
WATCH_S = 3.0  # after each step
CLOCK_SOURCE = Path(__file__).with_name("stepped_clock.c")


def node_faults(settings: Sequence[str], out: Path, rounds: int) -> Iterator[Outcome]:
    """kill -9 and SIGSTOP of each node; several rounds in each launch."""
    for begun in range(0, rounds, ROUNDS_A_LAUNCH):
        yield from _node_faults(settings, out / f"launch-{begun}", min(ROUNDS_A_LAUNCH, rounds - begun))


def _node_faults(settings: Sequence[str], out: Path, rounds: int) -> list[Outcome]:
    outcomes: list[tuple[float, float, Outcome]] = []
    with LiveLaunch(settings, out) as launch:
        launch.listen()
        launch.told.wait("map_saved")
        for count in range(rounds):
            for fault in (_kill, _freeze):
                for node in NODES:
                    time.sleep(SETTLE_S)
                    began_s = time.monotonic()
                    outcome = _hit(launch, node, fault)
                    outcomes.append((began_s, time.monotonic(), outcome))
            print(f"nodes: round {count + 1} of {rounds} in {out.name}", flush=True)
        time.sleep(SETTLE_S)
        ended_s = time.monotonic() - 1.0  # what came since may be on its way to the disk
        logged = launch.logged()
        ends = [began for began, _, _ in outcomes[1:]] + [ended_s]
        found = [
            replace(o, lost_messages=launch.not_logged(began, end, logged))
            for (began, _, o), end in zip(outcomes, ends, strict=True)
        ]
    left = sum(map(is_alive, launch.all_pids()))
    return [replace(o, left=left) for o in found]


def _kill(pid: int, launch: LiveLaunch) -> str:
    os.kill(pid, signal.SIGKILL)
    return "kill -9"


def _freeze(pid: int, launch: LiveLaunch) -> str:
    os.kill(pid, signal.SIGSTOP)
    return "SIGSTOP"


def _hit(launch: LiveLaunch, node: str, fault: Callable[[int, LiveLaunch], str]) -> Outcome:
    assert launch.camera is not None and launch.mapper is not None and launch.recorder is not None
    pids = launch.pids()
    told = launch.told
    began_s = time.monotonic()
    saved = told.last(r"map_saved .*blocks=(\d+).* frames=(\d+)")
    name = fault(pids[node], launch)
    told.wait(rf"node_ended .*node={node} ", began_s)
    started_s, _ = told.wait(rf"node_started .*node={node} ", began_s)
    lost_frames = lost_blocks = 0
    counts: dict[str, int] = {}
    if node == "recorder":
        back_s = told.wait(r"\[recorder\].* recording ", started_s)[0]
        time.sleep(STATUS_S)
        counts = {"frames counted as missed": launch.recorder.counters["missed"]}
    elif node == "camera":
        back_s, lost_frames = launch.camera.first_after("frame", started_s)
    else:
        back_s, lost_frames = launch.mapper.first_after("map", started_s)
        taken = re.findall(r"blocks=(\d+) frames=(\d+)", told.wait("map_resumed|empty_map_begun", began_s)[1])
        if saved is not None:
            lost_blocks = max(0, int(saved[1][1]) - int(taken[0][0] if taken else 0))
            counts = {"blocks had been saved": int(saved[1][1])}
    now = launch.pids()
    others = sum(now[n] != pids[n] for n in NODES if n != node)
    return Outcome(f"{name} {node}", back_s - began_s, lost_frames, 0, lost_blocks, others, 0, counts)


def clock_steps(settings: Sequence[str], out: Path, rounds: int) -> list[Outcome]:
    """In one launch: CLOCK_REALTIME jumps by an hour forward, then back to an hour before (see ``stepped_clock.c``)."""
    out.mkdir(parents=True, exist_ok=True)
    offset, library = out / "offset", out / "stepped_clock.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-O1", "-o", library, CLOCK_SOURCE, "-ldl"], check=True)
    offset.write_bytes(bytes(4096))
    fake = {"LD_PRELOAD": str(library), "STEPPED_CLOCK": str(offset)}
    windows: list[tuple[float, float]] = []
    with LiveLaunch(settings, out, fake) as launch:
        camera, mapper = launch.listen()
        launch.told.wait("map_saved")
        pids = launch.pids()
        for _ in range(rounds):
            for step in STEPS_S:
                began_s = time.monotonic()
                with offset.open("r+b") as file:  # the same file, which all have mapped
                    file.write(struct.pack("<q", step))
                time.sleep(WATCH_S)
                windows.append((began_s, began_s + WATCH_S))
        time.sleep(SETTLE_S)
        others = sum(launch.pids()[n] != pids[n] for n in NODES)
        logged = launch.logged()
        found: list[Outcome] = []
        for began_s, ended_s in windows:
            frames = [(at, seq) for at, seq in camera.numbers("frame") if began_s - 0.5 <= at < ended_s]
            maps = [at for at, _ in mapper.numbers("map") if began_s - 0.5 <= at < ended_s]
            missing = frames[-1][1] - frames[0][1] + 1 - len(frames)
            pause = max(b - a for a, b in itertools.pairwise(maps))
            lost = launch.not_logged(began_s, ended_s, logged)
            found.append(Outcome("clock step (longest pause of the map)", pause, missing, lost, 0, others))
        shown = {text[:2] for text in launch.told.all(r"\[mapper\] (\d\d:\d\d:\d\d).*map_saved")}
        if len(shown) < 2:
            raise SystemExit("the nodes' clock did not follow: nothing was shown")
    return found


def launcher_freezes(settings: Sequence[str], out: Path, rounds: int) -> Iterator[Outcome]:
    """In one launch: SIGSTOP of the launcher for a while; its nodes go on, and it finds them alive."""
    with LiveLaunch(settings, out) as launch:
        camera, mapper = launch.listen()
        launch.told.wait("map_saved")
        for _ in range(rounds):
            pids, began_s = launch.all_pids(), time.monotonic()
            launch.process.send_signal(signal.SIGSTOP)
            time.sleep(WATCH_S)
            launch.process.send_signal(signal.SIGCONT)
            time.sleep(SETTLE_S)
            maps = [at for at, _ in mapper.numbers("map") if at >= began_s - 0.5]
            numbers = [seq for at, seq in camera.numbers("frame") if at >= began_s - 0.5]
            yield Outcome(
                f"SIGSTOP launcher for {WATCH_S:g} s (longest pause of the map)",
                max(b - a for a, b in itertools.pairwise(maps)),
                numbers[-1] - numbers[0] + 1 - len(numbers),
                others=len(set(launch.all_pids()) ^ set(pids)),
            )


def launcher_kills(settings: Sequence[str], out: Path, rounds: int, frozen: bool) -> Iterator[Outcome]:
    """Launch after launch: kill -9 of the launcher; nothing may stay, and results are written.

    Args:
        settings, out: See ``LiveLaunch``.
        rounds: Launches.
        frozen: One node is frozen before.
    """
    how = "one node frozen" if frozen else "its nodes well"
    for count in range(rounds):
        with LiveLaunch(settings, out / f"launch-{count}-{frozen}") as launch:
            launch.told.wait("map_saved")
            time.sleep(SETTLE_S)
            if frozen:
                os.kill(launch.pids()[NODES[count % len(NODES)]], signal.SIGSTOP)
            began_s = time.monotonic()
            launch.process.kill()
            launch.process.wait()
            pids = launch.all_pids()
            while any(map(is_alive, pids)) and time.monotonic() - began_s < PATIENCE_S:
                time.sleep(0.02)
            gone_s = time.monotonic() - began_s
            unwritten = int(not (launch.out / "summary.json").exists())
            yield Outcome(
                f"kill -9 launcher, {how} (until all are gone)",
                gone_s,
                lost_blocks=unwritten,
                left=sum(map(is_alive, pids)),
                counts={"processes ended": len(pids)},
            )
        print(f"launcher, {how}: round {count + 1} of {rounds}", flush=True)
