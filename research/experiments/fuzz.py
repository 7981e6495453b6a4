"""Coverage-guided fuzzing of all that reads what unknown clients send: messages, logs, questions, answers, poses.

Each target runs in a process of its own under atheris (libFuzzer), which is no dependency of the project: `uv pip
install atheris`. Whatever is raised beside ``SemanticMapperError`` ends it with a crash, as does more than --memory-mb.

Example: python -m research.experiments.fuzz --minutes 10 --out runs/fuzz

With --frames, values instead of bytes are spoiled: this many frames go through the whole step of the mapper, in this
process and without atheris; see ``fuzz_values``.

Example: python -m research.experiments.fuzz --frames 100000 --out runs/fuzz
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import random
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import msgspec

INPUT_SECONDS = 10  # for one input; more counts as a hang
MAX_BYTES = 1 << 16
INSTRUMENTED = ("semantic_mapper.transport", "semantic_mapper.errors", "semantic_mapper.labels", "replay", "mcap")


def fuzz_one(name: str, words: list[str]) -> None:
    """In a process of its own: hand one target to libFuzzer, which ends the process."""
    atheris = importlib.import_module("atheris")
    with atheris.instrument_imports(include=list(INSTRUMENTED)):
        targets = importlib.import_module("research.experiments.fuzz_targets")
    errors = importlib.import_module("semantic_mapper.errors")
    target = targets.TARGETS[name]

    def read(data: bytes) -> None:
        try:
            target.read(data)
        except errors.SemanticMapperError:
            return

    def mutate(data: bytes, max_size: int, seed: int) -> bytes:
        def spoil(part: bytes) -> bytes:
            return bytes(atheris.Mutate(part, len(part) + 64))

        return target.mutate(data, random.Random(seed), spoil)[:max_size]

    atheris.Setup([sys.argv[0], *words], read, custom_mutator=mutate)
    atheris.Fuzz()


def start(name: str, seconds: int, memory_mb: int, out: Path) -> subprocess.Popen[bytes]:
    """One target in the background; its corpus grows in ``out``, crashes are left beside it."""
    from research.experiments.fuzz_targets import TARGETS

    corpus = out / name / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(TARGETS[name].seeds()):
        (corpus / f"seed-{number:02d}").write_bytes(seed)
    words = [
        f"-max_total_time={seconds}",
        f"-rss_limit_mb={memory_mb}",
        f"-timeout={INPUT_SECONDS}",
        f"-max_len={MAX_BYTES}",
        f"-artifact_prefix={out / name}/",
        "-len_control=0",
        "-print_final_stats=1",
        str(corpus),
    ]
    with (out / name / "log.txt").open("wb") as told:
        return subprocess.Popen(
            [sys.executable, "-m", "research.experiments.fuzz", "--one", name, *words],
            stdout=told,
            stderr=subprocess.STDOUT,
            cwd=Path(__file__).resolve().parents[2],
            env={**os.environ, "PYTHONHASHSEED": "0"},
        )


def result(name: str, code: int, out: Path) -> dict[str, Any]:
    """What one target's process told."""
    told = (out / name / "log.txt").read_text(errors="replace")

    def last(pattern: str) -> int:
        return int((re.findall(pattern, told) or ["0"])[-1])

    crashes = sorted(p.name for p in (out / name).iterdir() if p.name.startswith(("crash", "oom", "timeout", "leak")))
    return {
        "target": name,
        "inputs": last(r"number_of_executed_units:\s*(\d+)"),
        "coverage_edges": last(r"cov: (\d+)"),
        "features": last(r"ft: (\d+)"),
        "corpus": len(list((out / name / "corpus").iterdir())),
        "peak_memory_mb": last(r"peak_rss_mb:\s*(\d+)"),
        "exit_code": code,
        "crashes": crashes,
    }


def fuzz_values(frames: int, seed: int, out: Path) -> None:
    """Send frames with hostile values through the mapper and report the worst."""
    values = importlib.import_module("research.experiments.fuzz_values")
    logging = importlib.import_module("structlog")
    logging.configure(wrapper_class=logging.make_filtering_bound_logger(50))  # a line a refused frame is too many
    report = values.run(frames, seed, lambda r: print(r.line(), flush=True))
    out.mkdir(parents=True, exist_ok=True)
    (out / "values.json").write_text(json.dumps(msgspec.to_builtins(report), indent=1), encoding="utf-8")
    print(report.line())
    print(f"slowest: {report.slowest}")
    if report.failures:
        raise SystemExit("; ".join(report.failures))


def main() -> None:
    """See the module's docstring."""
    if sys.argv[1:2] == ["--one"]:
        fuzz_one(sys.argv[2], sys.argv[3:])
        return
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0, help="for each target; they run side by side")
    parser.add_argument("--targets", nargs="+", default=["message", "log", "question", "answer", "pose"])
    parser.add_argument("--memory-mb", type=int, default=2048, help="a process that takes more has failed")
    parser.add_argument("--out", type=Path, default=Path("runs/fuzz"), help="corpora, crashes, report.json")
    parser.add_argument("--frames", type=int, help="spoil the values of this many frames instead of bytes")
    parser.add_argument("--seed", type=int, default=0, help="of the values")
    arguments = parser.parse_args()
    out = arguments.out.absolute()
    if arguments.frames:
        fuzz_values(arguments.frames, arguments.seed, out)
        return
    began = time.monotonic()
    seconds = max(1, round(60 * arguments.minutes))
    processes = {name: start(name, seconds, arguments.memory_mb, out) for name in arguments.targets}
    rows = [result(name, process.wait(), out) for name, process in processes.items()]
    report = {"minutes": round((time.monotonic() - began) / 60, 1), "targets": rows}
    (out / "report.json").write_text(json.dumps(report, indent=1), encoding="utf-8")
    print("| target | inputs | edges covered | corpus | peak memory | crashes |\n|---|---|---|---|---|---|")
    for row in rows:
        print(
            f"| {row['target']} | {row['inputs']:,} | {row['coverage_edges']} | {row['corpus']} | "
            f"{row['peak_memory_mb']} MB | {', '.join(row['crashes']) or 'none'} |"
        )
    if any(row["crashes"] or row["exit_code"] for row in rows):
        raise SystemExit(f"crashes, hangs or failures: see {out}")


if __name__ == "__main__":
    main()
