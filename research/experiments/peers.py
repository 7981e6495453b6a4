"""Train S-Ray, its ablations and its peers with one budget, and compare them on the rooms of the test split.

Encoders learn from single images first: after a common start one goes on with colours, the other with measured depth
too, where there is any. Each field takes one of the two over and spends the same number of steps on rays
(recipes/cpu-images.toml and cpu-rays.toml, or gpu-*). The per-image U-Nets are those encoders themselves: the same
steps on images, none on rays, and the best of their validations is kept where a field keeps its last weights. On CPUs
two runs go on at a time and share the cores. A run that was ended goes on where it stopped when the same command comes
again.

    python -m research.experiments.peers --out runs/peers [NAME...]        train, all of them without names
    python -m research.experiments.peers --out runs/peers --eval [NAME...] compare them, with and without depth
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tomllib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event
from typing import Any

from research.train.train import STATE_FILE, WEIGHTS_FILE
from research.train.train_state import unfinished_step

RECIPES = Path(__file__).resolve().parent.parent / "recipes"
COMMAND = str(Path(sys.executable).with_name("semantic-mapper-research"))


@dataclass(frozen=True)
class Run:
    """One training.

    Args:
        kind: Of field.
        depth: Whether its encoder sees depth.
        encoder: The run whose encoder it starts from; empty = random weights.
        images: Trained on single images, not on rays.
        fraction: Of the recipe's steps.
    """

    kind: str
    depth: bool
    encoder: str = ""
    images: bool = False
    fraction: float = 1.0


@dataclass(frozen=True)
class Budget:
    """What all runs of one comparison have in common.

    Args:
        seed: Of every run.
        steps: Of every run, instead of the recipes'; 0 = the recipes'.
        tier: "cpu" or "gpu".
        jobs: Runs at a time.
        encoder: Settings of the image encoder other than the default ones.
    """

    seed: int = 0
    steps: int = 0
    tier: str = "cpu"
    jobs: int = 2
    encoder: dict[str, Any] = field(default_factory=dict[str, Any])

    @property
    def cores(self) -> int:
        """CPU cores of one run."""
        return max((os.cpu_count() or 1) // self.jobs, 1)


START = "start"  # what both encoders have in common; nothing to compare
RUNS = {
    START: Run("unet", depth=False, images=True),
    "unet-depth": Run("unet", depth=True, encoder=START, images=True, fraction=0.5),
    "unet": Run("unet", depth=False, encoder=START, images=True, fraction=0.5),
    "sray": Run("sray", depth=True, encoder="unet-depth"),
    "neuray": Run("neuray", depth=False, encoder="unet"),
    "sray-none": Run("sray-none", depth=True, encoder="unet-depth"),
    "sray-cross": Run("sray-cross", depth=True, encoder="unet-depth"),
    "sray-intra": Run("sray-intra", depth=True, encoder="unet-depth"),
    "sray-colours": Run("sray", depth=False, encoder="unet"),
    "neuray-depth": Run("neuray", depth=True, encoder="unet-depth"),
    "sray-paper": Run("sray-paper", depth=True, encoder="unet-depth"),
}


def recipe(name: str, budget: Budget) -> str:
    """The recipe of a run as TOML."""
    run = RUNS[name]
    file = RECIPES / f"{budget.tier}-{'images' if run.images else 'rays'}.toml"
    plain: dict[str, Any] = tomllib.loads(file.read_text(encoding="utf-8"))
    steps = budget.steps or round(run.fraction * plain["steps"])
    plain |= {"kind": run.kind, "seed": budget.seed, "steps": steps}
    plain["field"] = {"encoder": {"depth": run.depth} | budget.encoder}
    return "\n".join(_lines(plain, "")) + "\n"


def finished(folder: Path) -> bool:
    """Whether a run has used up its budget; its weights lie there long before."""
    state = folder / STATE_FILE
    return state.is_file() and unfinished_step(state) is None


def train(name: str, out: Path, budget: Budget) -> int:
    """Train one run, or go on with it; returns the exit code of the command."""
    folder = out / name
    state, config, wanted = folder / STATE_FILE, folder / "recipe.toml", recipe(name, budget)
    if state.is_file() and tomllib.loads(config.read_text(encoding="utf-8")) != tomllib.loads(wanted):
        print(f"{name}: {config} differs from what is requested (--seed, --steps?); take another --out", flush=True)
        return 1
    if finished(folder):
        print(f"{name}: done", flush=True)
        return 0
    folder.mkdir(parents=True, exist_ok=True)
    config.write_text(wanted, encoding="utf-8")
    command = [COMMAND, "train", "--config", str(config), "--out", str(folder)]
    if RUNS[name].encoder:
        command += ["--encoder", str(out / RUNS[name].encoder / WEIGHTS_FILE)]
    if state.is_file():
        command += ["--resume"]
    print(f"{name}: {' '.join(command)}", flush=True)
    one_thread = {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive"}
    limits = one_thread if budget.tier == "cpu" else {}
    if budget.tier == "cpu" and budget.cores > 1:
        # One core trains and the others render rooms ahead: more threads for the training itself gain little.
        command += ["--workers", str(budget.cores - 1)]
    with (folder / "train.log").open("ab") as log:
        code = subprocess.run(command, env=os.environ | limits, stdout=log, stderr=log, check=False).returncode
    print(f"{name}: ended with {code}", flush=True)
    return code


def train_all(names: list[str], out: Path, budget: Budget) -> int:
    """Encoders first, then the fields that start from them."""
    encoders = {name for name in names if RUNS[name].images} | {RUNS[name].encoder for name in names} - {""}
    encoders |= {RUNS[name].encoder for name in encoders} - {""}
    groups = (
        [name for name in RUNS if name in encoders and not RUNS[name].encoder],
        [name for name in RUNS if name in encoders and RUNS[name].encoder],
        [name for name in names if name not in encoders],
    )
    failed = Event()

    def train_unless_failed(name: str) -> int:
        """Ctrl-C ends the runs at hand; the ones that wait must not begin."""
        code = 0 if failed.is_set() else train(name, out, budget)
        if code:
            failed.set()
        return code

    for group in groups:
        with ThreadPoolExecutor(budget.jobs) as pool:
            codes = list(pool.map(train_unless_failed, group))
        if any(codes):
            return max(codes)
    return 0


def compare(names: list[str], out: Path, tier: str = "cpu") -> int:
    """All figures of these runs, with and without depth; nothing where one of them is not finished."""
    missing = [name for name in names if not finished(out / name)]
    if missing:
        print(f"not trained to the end in {out}: {', '.join(missing)}; train them, or name the others", flush=True)
        return 1
    weights = [out / name / WEIGHTS_FILE for name in names]
    for depth in ("on", "off"):
        command = [COMMAND, "suite", "rooms", "--no-own-image", "--depth", depth, "--tier", tier]
        command += ["--out", str(out / f"depth-{depth}.json")]
        for file in weights:
            command += ["--weights", str(file)]
        code = subprocess.run(command, check=False).returncode
        if code:
            return code
    return 0


def main() -> int:
    """Run the verb that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(RUNS)}")
    parser.add_argument("--out", type=Path, required=True, help="folder of all runs")
    parser.add_argument("--eval", action="store_true", help="compare instead of train")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=0, help="of every run, instead of the recipes'")
    parser.add_argument(
        "--encoder",
        default="",
        metavar="TOML",
        help='settings of every image encoder, e.g. "channels = [32]; blocks = [2]"',
    )
    parser.add_argument("--jobs", type=int, default=0, help="runs at a time, which share the cores [cpu: 2; gpu: 1]")
    parser.add_argument(
        "--tier", choices=("cpu", "gpu"), default="cpu", help="160x120 on CPU cores, or 320x240 on a GPU"
    )
    given = parser.parse_args()
    unknown = sorted(set(given.names) - set(RUNS))
    if unknown:
        parser.error(f"no run {', '.join(unknown)}; there are {', '.join(RUNS)}")
    names = given.names or [name for name in RUNS if not (given.eval and name == START)]
    if given.eval:
        return compare(names, given.out, given.tier)
    jobs = given.jobs or (2 if given.tier == "cpu" else 1)
    try:
        encoder = tomllib.loads(given.encoder.replace(";", "\n"))
    except tomllib.TOMLDecodeError as error:
        parser.error(f"--encoder: {error}")
    return train_all(names, given.out, Budget(given.seed, given.steps, given.tier, jobs, encoder))


def _lines(table: dict[str, Any], path: str) -> list[str]:
    """Lines of a table: its plain values first, then the tables in it."""
    plain = [f"{key} = {_toml(value)}" for key, value in table.items() if not isinstance(value, dict)]
    head = ["", f"[{path}]"] if path and plain else []
    inner = [
        line
        for key, value in table.items()
        if isinstance(value, dict)
        for line in _lines(value, f"{path}.{key}" if path else key)
    ]
    return head + plain + inner


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list):
        return f"[{', '.join(_toml(v) for v in value)}]"
    return f'"{value}"' if isinstance(value, str) else repr(value)


if __name__ == "__main__":
    sys.exit(main())
