"""What small uses of the command cost: processor seconds and peak memory of a process, for one checkout or two.

python -m research.experiments.start_up
python -m research.experiments.start_up --rounds 5 --beside ../before/.venv/bin/python

Each round runs every use once in each checkout, one after the other. Figures are medians over the rounds; one more
round before them, in which Python compiles what it imports, does not count.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

# LOG and MAP are made by `demo` with 8 frames: 320x240, 2 cm voxels; NEW is a name that is not there yet.
USES = (
    "--help",
    "replay --help",
    "info LOG",
    "info MAP",
    "info none.mcap",
    "replay none.mcap --out new-run",
    "map none.mp4 --out new-run",
    "eval none.mcap",
    "fleet run replay none.mcap --out new-store",
    "query MAP info",
    "query MAP at 0 0 1",
    "query MAP nearest chair 0 0 1",
    "query MAP instances",
    "query MAP graph",
    "query live info",
    "export LOG --out NEW",
    "export LOG --out NEW.mcap",
    "export LOG --out NEW.txt",
    "export MAP --out NEW.ply",
    "import FOLDER NEW.mcap",
    "recover LOG NEW.mcap",
    "top --once",
    "keys make --keys NEW",
    "launch list",
    "up none.toml",
    "cameras",
    "doctor",
)
IMPORTS = ("MapClient", "open_log")  # of ``semantic_mapper``, in a program of one's own


def main() -> None:
    """Measure, and print one row a use."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--beside", type=Path, help="python of another checkout, measured first in each round")
    parser.add_argument("--rounds", type=int, default=3)
    given = parser.parse_args()
    pythons = [*([given.beside.absolute()] if given.beside else []), Path(sys.executable)]
    with tempfile.TemporaryDirectory() as folder:
        _make_inputs(Path(folder))
        found: dict[str, list[list[tuple[float, float]]]] = {}
        for number in range(given.rounds + 1):
            for use in (*USES, *(f"import {name}" for name in IMPORTS)):
                rows = found.setdefault(use, [[] for _ in pythons])
                for n, python in enumerate(pythons):
                    command = _command(python, use, f"new-{number}-{n}-{len(found)}")
                    cost = _cost(command, Path(folder))
                    if number > 0:
                        rows[n].append(cost)
    columns = ["before", "now"] if given.beside else ["now"]
    print(f"| use | {' | '.join(f'{name}: CPU s; MB' for name in columns)} |")
    print("|---" * (len(columns) + 1) + "|")
    for use, rows in found.items():
        medians = [[statistics.median(values) for values in zip(*row, strict=True)] for row in rows]
        print(f"| `{use}` | {' | '.join(f'{seconds:.2f}; {mb:.0f}' for seconds, mb in medians)} |")


def _make_inputs(folder: Path) -> None:
    command = str(Path(sys.executable).with_name("semantic-mapper"))
    subprocess.run([command, "demo", "--frames", "8", "--out", "demo"], cwd=folder, capture_output=True, check=True)
    export = [command, "export", "demo/demo.mcap", "--out", "frames"]
    subprocess.run(export, cwd=folder, capture_output=True, check=True)


def _command(python: Path, use: str, new: str) -> list[str]:
    if use.removeprefix("import ") in IMPORTS:
        return [str(python), "-c", f"from semantic_mapper {use}"]
    names = {"LOG": "demo/demo.mcap", "MAP": "demo/map.npz", "FOLDER": "frames"}
    words = [names.get(word, word.replace("NEW", new)) for word in use.split()]
    return [str(python.with_name("semantic-mapper")), *words]


def _cost(command: list[str], folder: Path) -> tuple[float, float]:
    """Processor seconds and peak MB of a process and of those that it has waited for."""
    compiles = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    nowhere = subprocess.DEVNULL
    process = subprocess.Popen(command, cwd=folder, env=compiles, stdout=nowhere, stderr=nowhere)
    _, _, usage = os.wait4(process.pid, 0)
    process.returncode = 0  # waited for already
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024


if __name__ == "__main__":
    main()
