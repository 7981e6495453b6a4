"""Logs and weights to try a fleet on: pieces of a recording, rooms, and weights that are a little worse.

    logs    20 pieces of a log, one after the other, and the 40 rooms that nothing was trained on; a manifest with tags
    worse   the weights that ship with the package, with noise on every matrix

Example:
    python -m research.experiments.fleet_pieces logs kitchen.mcap --out runs/pieces
    python -m research.experiments.fleet_pieces worse --noise 0.15 --out runs/pieces/worse.safetensors
    semantic-mapper fleet run replay runs/pieces/fleet.csv --out runs/fleet-a
    semantic-mapper fleet run replay runs/pieces/fleet.csv --out runs/fleet-b --weights runs/pieces/worse.safetensors
    semantic-mapper fleet compare runs/fleet-a runs/fleet-b
"""

from __future__ import annotations

import argparse
import csv
from dataclasses import replace
from itertools import islice
from pathlib import Path

import torch

from research.scenes import TEST_SEEDS, VALIDATION_SEEDS, NoiseConfig, room_frames
from semantic_mapper.fields.checkpoint import default_checkpoint_path, load_checkpoint, save_checkpoint
from semantic_mapper.labels import ROOMS
from semantic_mapper.replay.log.format import LogWriter
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics

CAMERA = CameraIntrinsics(110.3, 110.3, 79.5, 59.5, 160, 120)
PIECES, ROOM_FRAMES = 20, 12


def write_pieces(source: Path, out: Path) -> list[dict[str, str]]:
    """Equal pieces of a log; rows of the manifest."""
    rows = []
    with open_log(source) as log:
        frames = iter(log)
        each = len(log) // PIECES
        for number in range(PIECES):
            name = f"{source.stem}-{number:02}.mcap"
            info = StreamInfo(source.stem, log.info.cameras, log.info.label_set, each)
            with LogWriter(out / name, info) as piece:
                for frame in islice(frames, each):
                    piece.write_frame(frame)
            rows.append({"log": name, "robot": f"r{number % 3}", "site": source.stem})
    return rows


def write_rooms(out: Path) -> list[dict[str, str]]:
    """Walks through rooms with a noisy depth camera; rows of the manifest."""
    rows = []
    for number, seed in enumerate((*VALIDATION_SEEDS, *TEST_SEEDS)):
        name = f"room-{number:02}.mcap"
        info = StreamInfo("rooms", {"rooms": CAMERA}, ROOMS, ROOM_FRAMES)
        with LogWriter(out / name, info) as log:
            for frame in room_frames(seed, ROOM_FRAMES, CAMERA, noise=NoiseConfig()):
                log.write_frame(frame)
        rows.append({"log": name, "robot": f"r{number % 3}", "site": "rooms"})
    return rows


def write_worse(noise: float, out: Path) -> None:
    """Noise of so many standard deviations of each matrix on it."""
    checkpoint = load_checkpoint(default_checkpoint_path())
    draw = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in checkpoint.model.parameters():
            if parameter.ndim > 1:
                spread = parameter.std()
                parameter += noise * spread * torch.randn(parameter.shape, generator=draw)
    recipe = {**checkpoint.recipe, "noise": noise}
    save_checkpoint(replace(checkpoint, recipe=recipe), out)


def main() -> None:
    """Write logs or weights."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("logs", "worse"))
    parser.add_argument("source", type=Path, nargs="?", help="logs: the log to cut")
    parser.add_argument("--noise", type=float, default=0.15)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    if arguments.what == "worse":
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        write_worse(arguments.noise, arguments.out)
        return
    arguments.out.mkdir(parents=True, exist_ok=True)
    rows = [*(write_pieces(arguments.source, arguments.out) if arguments.source else []), *write_rooms(arguments.out)]
    with (arguments.out / "fleet.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, ["log", "robot", "site"])
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
