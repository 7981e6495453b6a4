"""Maps of rooms before and after ``refine``, without the query views of ``benchmark rooms --map --refine``.

Maps are kept, so that other weights are scored in a fraction of the time. A run that ended early goes on where it was.

Example: python -m benchmarks.refined_rooms --split val --refine nesf.safetensors
Example: python -m benchmarks.refined_rooms --split test --refine nesf-rooms --rendered 4
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from semantic_mapper.benchmark.config import SuiteConfig, settings_digest, suite_seeds
from semantic_mapper.benchmark.figures import compare_maps, compare_surfaces, map_row_figures, worst_room
from semantic_mapper.benchmark.records import MapRecord
from semantic_mapper.benchmark.store import RecordStore
from semantic_mapper.fields.checkpoint import default_checkpoint_path, find_checkpoint
from semantic_mapper.fields.nesf import load_nesf, smoothed_votes
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.evaluate.room_map import FusedRoom, RoomLook, TrueSurface, fuse_room, refined_records
from semantic_mapper.scenes import make_room


def kept_room(seed: int, suite: SuiteConfig, rendered: int, folder: Path) -> FusedRoom:
    """The map of a room, from the folder if it is there."""
    map_file, rest = folder / f"{seed}-map.npz", folder / f"{seed}.npz"
    if not rest.is_file():
        room = fuse_room(seed, default_checkpoint_path(), suite, rendered)
        folder.mkdir(parents=True, exist_ok=True)
        room.voxel_map.save(map_file)
        poses, truth, label = (np.stack([getattr(v, name) for v in room.views]) for name in RoomLook.__slots__)
        surface = {"sx": room.surface.xyz, "sl": room.surface.label, "si": room.surface.instance}
        np.savez_compressed(rest, T=poses, truth=truth, label=label, **surface)
    with np.load(rest) as kept:
        views = [RoomLook(*parts) for parts in zip(kept["T"], kept["truth"], kept["label"], strict=True)]
        surface = TrueSurface(kept["sx"], kept["sl"], kept["si"])
    return FusedRoom(make_room(seed), VoxelMap.load(map_file), views, surface)


def show(name: str, records: Sequence[MapRecord], plain: Sequence[MapRecord]) -> None:
    """Print the figures of one way to make maps, and its differences to the maps as they are."""
    row = map_row_figures(records)
    print(f"{name}: " + ", ".join(f"{key} {100 * value:.1f}" for key, value in row.items() if value is not None))
    if records is plain or len(records) < 2:
        return
    for where, found in (("points", compare_maps(records, plain)), ("true surface", compare_surfaces(records, plain))):
        assert found is not None
        low, high = 100 * found["low"], 100 * found["high"]
        print(f"  {where}: {100 * found['observed']:+.1f}, 95 % interval {low:+.1f} to {high:+.1f}")
    room, change = worst_room(records, plain)
    worse = sum(worst_room([a], [b])[1] < 0 for a, b in zip(records, plain, strict=True))
    print(f"  {worse} of {len(records)} rooms worse, the worst, {room}, by {-100 * change:.1f}")


def main() -> None:
    """Map, refine and score what is missing; print what there is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--split", choices=("val", "test"), default="val")
    parser.add_argument("--rooms", type=int, default=0, help="the first so many; 0 = all")
    parser.add_argument("--refine", type=Path, required=True, help="weights from `train --kind nesf`")
    parser.add_argument("--rendered", type=int, default=1, help="every so many-th frame is rendered")
    parser.add_argument("--folder", type=Path, default=Path("runs/refined-rooms"))
    arguments = parser.parse_args()
    suite = SuiteConfig(split=arguments.split, rooms=arguments.rooms)
    network = load_nesf(find_checkpoint(arguments.refine))
    plain = f"{settings_digest(suite, 'map')}-{arguments.rendered}"
    refined, smoothed = f"{plain}-{network.digest[:16]}", f"{plain}-smoothed"
    folder = arguments.folder / f"{arguments.split}-{arguments.rendered}"
    store = RecordStore(folder / "records.jsonl")
    networks = {plain: None, smoothed: smoothed_votes(ROOMS), refined: network}
    for seed in suite_seeds(suite):
        missing = {name: n for name, n in networks.items() if store.find(MapRecord, name, "shipped", seed) is None}
        if missing:
            for record in refined_records(
                kept_room(seed, suite, arguments.rendered, folder), "shipped", suite, missing
            ):
                store.add(record)
            print(f"room {seed}", flush=True)
    rows = {
        name: [r for seed in suite_seeds(suite) if (r := store.find(MapRecord, settings, "shipped", seed)) is not None]
        for name, settings in (("as mapped", plain), ("refined", refined), ("smoothed", smoothed))
    }
    for name, records in rows.items():
        show(name, records, rows["as mapped"])


if __name__ == "__main__":
    main()
