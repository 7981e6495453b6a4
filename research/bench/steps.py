"""Whole steps of a log by this revision and by another, in turns: how many times as fast is it?

git worktree add ../before 3f2412f1 && make -C ../before setup
python -m research.bench.steps kitchen.mcap --against ../before/.venv/bin/python [--busy 2]
"""

import argparse
import json
import subprocess
import sys

import numpy as np

WARM_UP = 5  # frames that do not count
RESAMPLED = 5000  # for the interval of a median
# By itself, so that each revision runs its own package.
STEPS = f"""
import itertools, json, sys, time
from semantic_mapper import Mapper, open_log
mapper, ms = Mapper.load(), []
with open_log(sys.argv[1]) as log:
    frames = list(itertools.islice(log, int(sys.argv[2])))
for frame in frames:
    start = time.perf_counter()
    mapper.step(frame)
    ms.append(1e3 * (time.perf_counter() - start))
print(json.dumps(ms[{WARM_UP}:]))
"""


def steps_ms(python: str, log: str, frames: int) -> list[float]:
    """Milliseconds of each step by the package of an interpreter."""
    command = [python, "-I", "-c", STEPS, log, str(frames)]
    found: list[float] = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    return found


def main() -> None:
    """Read the command line, and print each pair, and medians with their 95 % intervals."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log")
    parser.add_argument("--against", default=sys.executable, help="Python of the other revision")
    parser.add_argument("--frames", type=int, default=80)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--busy", type=int, default=0, help="processes that compute beside this revision's steps")
    options = parser.parse_args()
    ratios: dict[str, list[float]] = {"frames/s": [], "p50": [], "p95 / other p50": []}
    for _ in range(options.runs):
        other = np.array(steps_ms(options.against, options.log, options.frames))
        beside = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(options.busy)]
        try:
            own = np.array(steps_ms(sys.executable, options.log, options.frames))
        finally:
            for process in beside:
                process.kill()
                process.wait()
        ratios["frames/s"].append(other.mean() / own.mean())
        ratios["p50"].append(float(np.median(other) / np.median(own)))
        ratios["p95 / other p50"].append(float(np.percentile(own, 95) / np.median(other)))
        print(f"{1e3 / other.mean():.1f} -> {1e3 / own.mean():.1f} frames/s", flush=True)
    rng = np.random.default_rng(0)
    for name, values in ratios.items():
        drawn = np.array(values)[rng.integers(0, len(values), (RESAMPLED, len(values)))]
        low, high = np.percentile(np.median(drawn, axis=1), (2.5, 97.5))
        print(f"{name}: {np.median(values):.2f} ({low:.2f} to {high:.2f})")


if __name__ == "__main__":
    main()
