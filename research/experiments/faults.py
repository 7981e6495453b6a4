"""Breaks a live launch in every way we know, again and again: how long until it is back, and what was lost.

Nodes are killed and frozen in a long launch (launch/camera.toml: a log in the time of its recording, with camera,
mapper and recorder), a finetuner in another (launch/learning.toml); the clock is stepped in a third; each kill
of the launcher has one of its own; floods of garbage hit a mapper node; a small disk is filled; camera and frames are
spoiled in process; a camera comes back in another world in launches of its own.

Example: python -m research.experiments.faults --rounds 20 --out runs/faults
"""

from __future__ import annotations

import argparse
import itertools
import os
import platform
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path

from research.experiments import (
    fault_disk,
    fault_finetuner,
    fault_frames,
    fault_inputs,
    fault_nodes,
    fault_table,
    fault_worlds,
)
from research.experiments.long_log import write_long_log

HZ = 15.0
LOG_S = 2400.0
CASES = ("nodes", "finetuner", "launcher", "clock", "disk", "floods", "keys", "unplugged", "frames", "worlds")


def main() -> None:
    """See the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20, help="of each case")
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--messages", type=int, default=5_000_000, help="of garbage, in all rounds together")
    parser.add_argument("--log", type=Path, help="an hour's log to play; made where it is not given")
    parser.add_argument("--weights", default="", help="as of `semantic-mapper up --set`")
    parser.add_argument("--config", default="", help="as of `semantic-mapper up --set`")
    parser.add_argument("--out", type=Path, default=Path("runs/faults"), help="OUT.json and OUT.md are written")
    arguments = parser.parse_args()
    outcomes: list[fault_table.Outcome] = []
    about = {
        "machine": f"{os.cpu_count()} cores, {platform.machine()}, Linux {platform.release()}",
        "load before (1, 5, 15 min)": _load(),
    }
    with tempfile.TemporaryDirectory(prefix="faults-") as name:
        folder = Path(name)
        for case in arguments.cases:
            began = time.monotonic()
            for outcome in _run(case, arguments, folder):
                outcomes.append(outcome)
                about[f"{case}: minutes, load"] = f"{(time.monotonic() - began) / 60:.1f}, {_load()}"
                fault_table.write(outcomes, arguments.out, about)
            print(fault_table.markdown(outcomes), flush=True)


def _run(case: str, arguments: argparse.Namespace, folder: Path) -> Iterable[fault_table.Outcome]:
    rounds, weights, config = arguments.rounds, arguments.weights, arguments.config
    if case in ("nodes", "finetuner", "launcher", "clock"):
        log = arguments.log or folder / "long.mcap"
        if not log.exists():
            write_long_log(log, LOG_S, HZ)
        settings = [f"camera.log={log.absolute()}", "mapper.save_every_s=2"]
        settings += [f"mapper.{name}={value}" for name, value in (("weights", weights), ("config", config)) if value]
        if case == "nodes":
            return fault_nodes.node_faults(settings, folder / "nodes", rounds)
        if case == "finetuner":
            return fault_finetuner.finetuner_faults(settings, folder / "finetuner", rounds)
        if case == "launcher":
            kills = (
                fault_nodes.launcher_kills(settings, folder / "launcher", rounds, frozen) for frozen in (False, True)
            )
            return itertools.chain(*kills, fault_nodes.launcher_freezes(settings, folder / "frozen", rounds))
        return fault_nodes.clock_steps(settings, folder / "clock", rounds)
    cases: dict[str, Callable[[], Iterable[fault_table.Outcome]]] = {
        "disk": lambda: fault_disk.full_disks(rounds),
        "floods": lambda: fault_inputs.floods(weights, config, rounds, arguments.messages),
        "keys": lambda: fault_inputs.wrong_keys(rounds),
        "unplugged": lambda: fault_frames.unplugged_cameras(rounds),
        "worlds": lambda: fault_worlds.other_worlds(folder / "worlds", rounds),
        "frames": lambda: fault_frames.scrambled_streams(weights, config, rounds),
    }
    return cases[case]()


def _load() -> str:
    return ", ".join(f"{value:.1f}" for value in os.getloadavg())


if __name__ == "__main__":
    main()
