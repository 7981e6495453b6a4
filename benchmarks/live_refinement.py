"""What refining beside a mapper costs its step: the same frames in laps, with the process at work and with it frozen.

Example: python -m benchmarks.live_refinement kitchen.mcap --laps 9 --weights smoothed
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import tempfile
from contextlib import suppress
from pathlib import Path

from benchmarks.paired_steps import LAP, Turn, slowdown
from semantic_mapper.config import load_mapper_config
from semantic_mapper.mapper import Mapper
from semantic_mapper.nodes.mapper.live_refinement import LiveRefinement
from semantic_mapper.nodes.process import prepare_process
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.replay.session import MapSession
from semantic_mapper.types import MapUpdate, PosedFrame


def main() -> None:
    """Print the cost as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("log", type=Path)
    parser.add_argument("--config", type=Path)
    parser.add_argument("--laps", type=int, default=9)
    parser.add_argument("--weights", type=Path, help="as `refine --weights`")
    args = parser.parse_args()
    prepare_process()
    bundle = Mapper.load(None, load_mapper_config(args.config))
    voxel_map = bundle.pipeline.voxel_map
    with open_log(args.log) as reader:
        frames = [item for item in reader.frames_or_errors(LAP) if isinstance(item, PosedFrame)]
    session = MapSession(bundle, stream_labels=None)
    turn, steps = Turn(0, 0, 0), []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.npz"
        with LiveRefinement(voxel_map, path, 1e-9, args.weights) as refinement:
            while turn.lap < args.laps:
                results = session.process(frames[turn.place % len(frames)])
                ms = sum(sum(r.stage_ms.values()) for r in results if isinstance(r, MapUpdate))
                steps.append((turn, ms))
                turn = turn.after()
                if turn.place == 0 and turn.lap == 1:
                    voxel_map.save(path)
                if turn.lap >= 1:
                    refinement.follow(voxel_map.version, voxel_map.epoch)
                    _freeze(refinement, frozen=turn.frozen)
            _freeze(refinement, frozen=False)
            report = slowdown(steps) | refinement.counters | {"failure": refinement.failure}
    print(json.dumps(report | {"load": os.getloadavg()}, indent=1))


def _freeze(refinement: LiveRefinement, *, frozen: bool) -> None:
    process = refinement._process  # pyright: ignore[reportPrivateUsage]
    if process is not None:
        with suppress(ProcessLookupError):
            os.kill(process.pid, signal.SIGSTOP if frozen else signal.SIGCONT)


if __name__ == "__main__":
    main()
