"""Training under Ray beside torchrun: equal losses, time, a killed rank, and how rooms keep up with the trainer.

Three parts, on this machine alone: ``equal`` (two ranks under torchrun and under Ray in turn), ``killed`` (two ranks
under Ray, one killed with SIGKILL), ``feeds`` (one rank, rooms rendered inline, by a process and by a Ray actor). The
config is recipes/cpu-rays.toml with fewer steps, rooms and rays of validation. Ray's processes get the priority of this
one: by itself Ray gives them niceness 15, so on a busy machine they would come last.

    python -m research.experiments.ray_training [equal] [killed] [feeds] [--steps 60] [--rounds 3] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import psutil
import ray
import torch
from msgspec.structs import replace
from safetensors import safe_open

from research.train.ray_ranks import train_on_ray
from research.train.room_actors import open_actor_feed
from research.train.room_feed import RoomFeed, open_feed
from research.train.train import STATE_FILE, TrainProgress, train
from research.train.train_config import TrainConfig
from semantic_mapper.config import convert_config, load_config, to_plain
from semantic_mapper.memory import keep_freed_memory
from semantic_mapper.nodes.process import prepare_process

PARTS = ("equal", "killed", "feeds")
RECIPE = Path(__file__).resolve().parents[1] / "recipes" / "cpu-rays.toml"
DRAWS_PER_ROOM = 2  # a new room every second step: four times as many as the recipe asks for
ROOMS = 30  # that a feed makes alone


def main() -> None:
    """Print one JSON document."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; all by default")
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--rank", nargs=2, metavar=("FOLDER", "WORKERS"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    config = small_config(args.steps)
    if args.rank:  # as ``semantic-mapper train`` does, and ranks under Ray
        prepare_process()
        keep_freed_memory()
        train(replace(config, workers=int(args.rank[1])), Path(args.rank[0]))
        return
    os.environ |= {"OMP_NUM_THREADS": "1", "RAY_worker_niceness": "0"}
    torch.set_num_threads(1)
    measures = {"equal": partial(compare, rounds=args.rounds), "killed": kill_a_rank, "feeds": compare_feeds}
    with tempfile.TemporaryDirectory() as folder:
        ray.init(num_cpus=4, include_dashboard=False, log_to_driver=False, object_store_memory=500 << 20)
        try:
            report = {part: measures[part](config, Path(folder)) for part in args.parts or PARTS}
        finally:
            ray.shutdown()
    text = json.dumps(report | {"load": os.getloadavg()}, indent=1)
    print(text)
    if args.json:
        args.json.write_text(text + "\n", encoding="utf-8")


def small_config(steps: int) -> TrainConfig:
    """The recipe, shortened."""
    plain = to_plain(load_config(RECIPE, TrainConfig))
    plain |= {"steps": steps, "log_steps": 5, "device": "cpu", "save_every_s": 5.0}
    plain["pool"] |= {"rooms": 12, "rooms_at_start": 4, "draws_per_room": DRAWS_PER_ROOM}
    plain["validation"] |= {"times": 1, "rooms": 2, "rays": 500}
    return convert_config(plain, TrainConfig, "benchmark")


def compare(config: TrainConfig, folder: Path, rounds: int) -> dict[str, Any]:
    """Both ways in turn, the other one first in every second round."""
    seconds: dict[str, list[dict[str, float]]] = {"torchrun": [], "ray": []}
    for number in range(rounds):
        ways = ("torchrun", "ray") if number % 2 == 0 else ("ray", "torchrun")
        for way in ways:
            out = folder / f"{way}-{number}"
            began = time.monotonic()
            if way == "ray":
                train_on_ray(config, out, ranks=2)
            else:
                under_torchrun(config, out, ranks=2)
            whole = time.monotonic() - began
            seconds[way].append({"whole": round(whole, 1), "loop": loop_seconds(out)})
    states = [contents(folder / f"{way}-{number}") for number in range(rounds) for way in seconds]
    ratios = [b["loop"] / a["loop"] for a, b in zip(seconds["torchrun"], seconds["ray"], strict=True)]
    return {
        "states": len(states),
        "equal_bit_for_bit": all(same(states[0], state) for state in states[1:]),
        "last_loss": [line["loss_total"] for line in states[0][1] if "loss_total" in line][-1],
        "seconds": seconds,
        "loop_ratio_ray_to_torchrun": {"median": round(statistics.median(ratios), 3), "all": ratios},
    }


def kill_a_rank(config: TrainConfig, folder: Path) -> dict[str, Any]:
    """One of two ranks is killed after a third of the steps."""
    out = folder / "killed"
    seen: list[tuple[float, int]] = []  # when, step; from the kill on

    def watch(progress: TrainProgress) -> None:
        if not seen and progress.step >= config.steps // 3:
            rank_processes()[0].send_signal(signal.SIGKILL)
            seen.append((time.monotonic(), progress.step))
        elif seen:
            seen.append((time.monotonic(), progress.step))

    train_on_ray(config, out, ranks=2, on_progress=watch)
    gap_s, again = max((later[0] - earlier[0], later[1]) for earlier, later in pairwise(seen))
    undisturbed = folder / "torchrun-0"
    if not undisturbed.exists():
        under_torchrun(config, undisturbed, ranks=2)
    equal = same(contents(out), contents(undisturbed))
    return {
        "killed_at_step": seen[0][1],
        "again_at_step": again,
        "seconds_without_a_step": round(gap_s, 1),
        "equal_bit_for_bit": equal,
    }


def compare_feeds(config: TrainConfig, folder: Path) -> dict[str, Any]:
    """Rooms a second that a feed makes by itself, and that one trainer asks for once it is under way."""
    report: dict[str, Any] = {}
    for name, workers in (("inline", 0), ("process", 1), ("actor", 1)):
        out = folder / f"feed-{name}"
        opener = open_actor_feed if name == "actor" else open_feed
        made = made_rate(opener(seeds(), config.pool, workers))
        asked = replace(config, workers=workers)
        if name == "actor":
            train_on_ray(asked, out)
        else:
            under_torchrun(asked, out, ranks=1)
        lines = [line for line in contents(out)[1] if "waited_s" in line]
        rooms, waited_s, loop_s = (lines[-1][key] - lines[0][key] for key in ("rooms", "waited_s", "seconds"))
        report[name] = {
            "rooms_a_second_made": round(made, 2),
            "rooms_a_second_asked": round(rooms / (loop_s - waited_s), 2),
            "waited_fraction": round(waited_s / loop_s, 3),
            "waited_s_at_start": lines[0]["waited_s"],
            "loop_s": round(loop_s, 1),
        }
    return report


def made_rate(feed: RoomFeed) -> float:
    """Rooms a second, after the first one."""
    try:
        feed.next()
        began = time.monotonic()
        for _ in range(ROOMS):
            feed.next()
        return ROOMS / (time.monotonic() - began)
    finally:
        feed.close()


def seeds() -> Iterator[int]:
    """Of training rooms, other ones than the trainer's."""
    return iter(range(500, 1000))


def under_torchrun(config: TrainConfig, out: Path, *, ranks: int) -> None:
    """This module's ``--rank`` in as many processes."""
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(ranks)]
    command += ["-m", "research.experiments.ray_training", "--steps", str(config.steps)]
    command += ["--rank", str(out), str(config.workers)]
    subprocess.run(command, check=True, env={**os.environ, "OMP_NUM_THREADS": "1"}, stdout=subprocess.DEVNULL)


def rank_processes() -> list[psutil.Process]:
    """Of the embedded cluster, by the title that Ray gives them."""
    return [p for p in psutil.Process().children(recursive=True) if "RayTrainWorker" in " ".join(p.cmdline())]


def contents(out: Path) -> tuple[dict[str, torch.Tensor], list[dict[str, Any]]]:
    """Tensors and history of a run's state."""
    with safe_open(out / STATE_FILE, framework="pt") as stored:
        tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118
        return tensors, json.loads(stored.metadata()["history"])


def same(a: tuple[dict[str, torch.Tensor], Any], b: tuple[dict[str, torch.Tensor], Any]) -> bool:
    """Whether weights, optimiser and history are equal but for what a clock says."""
    histories = [[{k: v for k, v in line.items() if k not in ("seconds", "waited_s")} for line in h] for _, h in (a, b)]
    return histories[0] == histories[1] and all(torch.equal(a[0][n], b[0][n]) for n in a[0].keys() | b[0].keys())


def loop_seconds(out: Path) -> float:
    """Time in the training loop up to the last line of the history, without start-up."""
    return contents(out)[1][-1]["seconds"]


if __name__ == "__main__":
    main()
