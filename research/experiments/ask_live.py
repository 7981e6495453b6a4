"""How soon does a mapper at work answer `find` and `changes`, and what do questions cost its steps?

    python -m research.experiments.ask_live kitchen.mcap

A log is mapped again and again, as fast as it goes. Every second time another process asks both once a second by
``MapClient``; with ``--goes-on``, of a mapper that goes on in the map of the first time, and then updates what it
remembers all the time."""

import argparse
import multiprocessing
import tempfile
import time
from dataclasses import replace
from itertools import cycle
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import numpy as np

from semantic_mapper.client import MapClient
from semantic_mapper.mapper import Mapper
from semantic_mapper.nodes.mapper import live_memory
from semantic_mapper.nodes.mapper.query_service import QueryService
from semantic_mapper.queries.objects import remember, visit_of
from semantic_mapper.replay.log.sequence import open_log

PHRASES = ("chair", "red chair near the table", "thing on the table", "largest cabinet", "picture in room 1")


def ask(endpoint: str, asking: Event, answers: Any) -> None:
    """Ask while ``asking`` is set; puts (question, milliseconds) of each answer."""
    with MapClient(endpoint, timeout_s=60) as client:
        for phrase in cycle(PHRASES):
            asking.wait()
            for question in ("find", "changes"):
                began = time.perf_counter()
                _ = client.find(phrase) if question == "find" else client.objects().changes
                answers.put((question, 1e3 * (time.perf_counter() - began)))
            time.sleep(1.0)


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path)
    parser.add_argument("--times", type=int, default=7, help="that the log is mapped")
    parser.add_argument("--goes-on", action="store_true")
    arguments = parser.parse_args()
    with open_log(arguments.log) as log:
        frames = list(log)
    mapper, process = Mapper.load(), multiprocessing.get_context("spawn")
    span, ms = frames[-1].stamp_ns - frames[0].stamp_ns + 10**9, np.zeros((arguments.times, len(frames)))
    for frame in frames:
        mapper.step(frame)
    before, live_memory.WANTED_S = None, 2.0
    if arguments.goes_on and remember(mapper.voxel_map):
        before = visit_of(mapper.voxel_map)
    asking, answers = process.Event(), process.Manager().Queue()
    with (
        tempfile.TemporaryDirectory() as folder,
        QueryService(f"ipc://{folder}/q", mapper.voxel_map, before=before) as service,
    ):
        child = process.Process(target=ask, args=(service.endpoint, asking, answers), daemon=True)
        child.start()
        for n in range(arguments.times):
            (asking.set if n % 2 else asking.clear)()
            for k, frame in enumerate(frames):
                began = time.perf_counter()
                mapper.step(replace(frame, stamp_ns=frame.stamp_ns + (n + 1) * span))
                service.follow()
                ms[n, k] = 1e3 * (time.perf_counter() - began)
        child.terminate()
    found = [answers.get() for _ in range(answers.qsize())]
    for question in ("find", "changes"):
        took = [t for name, t in found if name == question]
        p50, p95 = np.percentile(took, (50, 95))
        print(f"{question}: {len(took)} answers, p50 {p50:.0f} ms, p95 {p95:.0f} ms, first {took[0]:.0f} ms")
    asked, alone = ms[1::2].sum(), ms[0::2].sum() * (len(ms[1::2]) / len(ms[0::2]))
    print(f"step {np.median(ms[0::2]):.0f} ms; with questions {asked / alone:.3f} times as long")


if __name__ == "__main__":
    main()
