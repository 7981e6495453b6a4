"""A disk that is truly full under a recording: a small file system in a name space of its own (unshare, tmpfs)."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from research.experiments.fault_table import Outcome
from semantic_mapper.replay.log.recording import Recording, RecordingRules
from semantic_mapper.replay.log.sequence import open_log, parts_on_disk
from semantic_mapper.transport.codec import encode_frame
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics, PosedFrame

ROOT = Path(__file__).resolve().parents[2]
DISK = "4m"
FRAMES = 600  # of 9 KB each: more than the disk holds
SPLIT_BYTES = 500_000
CAMERA = CameraIntrinsics(50.0, 50.0, 31.5, 23.5, 64, 48)


def full_disks(rounds: int) -> Iterator[Outcome]:
    """Record more than fits, with both rules for it. Raises RuntimeError: no file system can be mounted here."""
    for count in range(rounds):
        for policy in ("stop", "delete-oldest"):
            with tempfile.TemporaryDirectory(prefix="disk-") as disk:
                command = f"mount -t tmpfs -o size={DISK} tmpfs {disk} && exec {sys.executable} -m {__name__} "
                words = ["unshare", "-rm", "sh", "-c", f"{command} {disk} {policy} {count}"]
                done = subprocess.run(words, capture_output=True, text=True, cwd=ROOT, check=False)
            if done.returncode:
                raise RuntimeError(f"no small disk could be recorded to: {done.stderr.strip()}")
            found = json.loads(done.stdout.splitlines()[-1])
            counted = {"messages counted as lost": found["lost"], "parts deleted": found["deleted"]}
            counts = {name: count for name, count in counted.items() if count}
            case = f"disk full while recording, `{policy}` (longest write)"
            yield Outcome(case, found["pause_s"], lost_messages=found["unaccounted"], counts=counts)


def fill(disk: Path, policy: str, seed: int) -> dict[str, float]:
    """Record until long after the disk is full, read again, and count.

    Returns:
        ``pause_s`` (the longest write), ``lost`` and ``deleted`` as the recording counts them, and ``unaccounted``:
        frames that should be in the log, or be counted as lost, and are not.
    """
    rng = np.random.default_rng(seed)
    info = StreamInfo("noise", {"noise": CAMERA}, None)
    rules = RecordingRules(split_bytes=SPLIT_BYTES, disk_full="stop" if policy == "stop" else "delete-oldest")
    recording = Recording(disk / "a.mcap", info, rules, recording="disk")
    pause_s = 0.0
    for seq in range(FRAMES):
        rgb = rng.integers(0, 256, (CAMERA.height, CAMERA.width, 3), dtype=np.uint8)
        parts = encode_frame(PosedFrame(seq + 1, seq, "noise", rgb, None, None, CAMERA, np.eye(4)))
        began = time.perf_counter()
        recording.write(parts)
        pause_s = max(pause_s, time.perf_counter() - began)
    recording.close()
    with open_log(list(parts_on_disk(disk / "a.mcap").values())) as log:
        found = [frame.seq for frame in log]
        damaged = len(log.errors)
    first = 0 if policy == "stop" else found[0]
    expected = list(range(first, FRAMES - recording.lost))
    unaccounted = len(set(expected) ^ set(found)) + damaged
    return {
        "pause_s": pause_s,
        "lost": recording.lost,
        "deleted": recording.deleted,
        "unaccounted": unaccounted,
    }


def main() -> None:
    """In the name space: see ``fill``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("disk", type=Path)
    parser.add_argument("policy", choices=("stop", "delete-oldest"))
    parser.add_argument("seed", type=int)
    given = parser.parse_args()
    print(json.dumps(fill(given.disk, given.policy, given.seed)))


if __name__ == "__main__":
    main()
