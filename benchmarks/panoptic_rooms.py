"""Panoptic NeRF in procedural rooms: labels of all frames from boxes of things and the labels of the shipped S-Ray.

python -m benchmarks.panoptic_rooms --rooms 100000 100001 --keep /tmp/rooms
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
import torch

from semantic_mapper.benchmark.config import camera_of_width
from semantic_mapper.config import PanopticConfig, SamplingConfig
from semantic_mapper.evaluation.bootstrap import paired_bootstrap
from semantic_mapper.evaluation.metrics import ConfusionMatrix, confusion_of
from semantic_mapper.fields.panoptic import Panoptic, box_config
from semantic_mapper.fields.primitives import Primitive
from semantic_mapper.fields.render import render_image
from semantic_mapper.fields.source_maps import encoded_views
from semantic_mapper.imaging import resize_depth
from semantic_mapper.labels import ROOMS, STUFF_NAMES
from semantic_mapper.mapper import Mapper
from semantic_mapper.nodes.cli.map_answers import answer_instances
from semantic_mapper.plots import write_picture
from semantic_mapper.queries.instances import InstanceTracker
from semantic_mapper.queries.mirror import MapMirror
from semantic_mapper.queries.oriented_box import upright_box
from semantic_mapper.replay.boxes import load_boxes
from semantic_mapper.scenes import CameraPathConfig, NoiseConfig, RoomConfig, Scene, make_room, room_frames
from semantic_mapper.training.finetune import FinetuneConfig, PanopticFitConfig
from semantic_mapper.training.grid_fit import GridFitConfig
from semantic_mapper.training.panoptic import fit_panoptic
from semantic_mapper.training.views import stack_sources, view_from_frame
from semantic_mapper.types import PosedFrame, UInt8

UP = np.array((0.0, 0.0, 1.0))
INFLATED = 1.1


@dataclass(frozen=True, slots=True, eq=False)
class MappedRoom:
    """A room's frames with true labels, those of S-Ray, those of the map cast back, and boxes of its things."""

    frames: list[PosedFrame]
    pseudo: UInt8
    cast: UInt8
    true_boxes: tuple[Primitive, ...]
    found_boxes: tuple[Primitive, ...]


def map_room(seed: int, count: int, width: int, keep: Path) -> MappedRoom:
    """Map a room as ``replay`` does it; what was rendered is kept in a folder."""
    frames = list(room_frames(seed, count, camera_of_width(width), path=CameraPathConfig(), noise=NoiseConfig()))
    labels, things = keep / f"{seed}-{count}-{width}.npz", keep / f"{seed}-{count}-{width}.json"
    if not things.is_file():
        keep.mkdir(parents=True, exist_ok=True)
        mapper = Mapper.load()
        pseudo = [mapper.step(replace(f, label=None)).label for f in frames]
        cast = [mapper.voxel_map.ray_cast(f.T_world_camera, f.intrinsics).label for f in frames]
        np.savez_compressed(labels, pseudo=np.stack(pseudo), cast=np.stack(cast))
        found = InstanceTracker(up=UP).update(MapMirror.of(mapper.voxel_map).snapshot())
        things.write_text(json.dumps({"map": "room", **answer_instances(UP.tolist(), found)}))
    with np.load(labels) as kept:
        found_boxes = load_boxes(things).primitives
        return MappedRoom(frames, kept["pseudo"], kept["cast"], thing_boxes(make_room(seed, RoomConfig())), found_boxes)


def thing_boxes(scene: Scene) -> tuple[Primitive, ...]:
    """Upright boxes of all things of a room, a tenth larger on all sides together."""
    parts = scene.primitives
    signs = np.stack(np.meshgrid(*(3 * [(-1.0, 1.0)]), indexing="ij"), -1).reshape(8, 3)
    corners = parts.center[:, None] + np.einsum("pij,pkj->pki", parts.rotation, signs * parts.half[:, None])
    found: list[Primitive] = []
    for number in np.unique(parts.instance):
        own = parts.instance == number
        label = int(parts.label[own][0])
        if label == ROOMS.ignore_id or ROOMS.names[ROOMS.ids.index(label)] in STUFF_NAMES:
            continue
        box = upright_box(corners[own].reshape(-1, 3), UP)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = box.R_world_box, box.center
        name = ROOMS.names[ROOMS.ids.index(label)]
        found.append(Primitive(int(number), name, "box", T, np.maximum(box.size, 0.02) * INFLATED, thing=True))
    return tuple(found)


def predict(field: Panoptic, frame: PosedFrame) -> UInt8:
    """Labels of a frame."""
    views = stack_sources([view_from_frame(replace(frame, label=None), field.label_set, frame.intrinsics.width)])
    depth_m = resize_depth(frame, frame.intrinsics)
    scene = (frame.intrinsics, frame.T_world_camera, depth_m, SamplingConfig(), 0)
    found = render_image(field, encoded_views(views, views.rgb[:, :0]), *scene)
    channel = np.where(found.known.numpy(), found.logits.argmax(1).numpy(), -1)
    return ROOMS.to_ids(channel).reshape(depth_m.shape)


def score(frames: Sequence[PosedFrame], labels: Sequence[UInt8]) -> ConfusionMatrix:
    """All frames; a pixel without an answer is wrong."""
    total = ConfusionMatrix(ROOMS)
    for frame, label in zip(frames, labels, strict=True):
        assert frame.label is not None
        total = total + confusion_of(frame.label, label, ROOMS, "frame")
    return total


def main() -> None:
    """Print a row for each way to label the frames."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rooms", nargs="+", type=int, default=[100000])
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--width", type=int, default=160)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--boxes", choices=["true", "query"], nargs="+", default=["true", "query"])
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="of PanopticFitConfig")
    parser.add_argument("--uncovered", choices=["stuff", "empty"], default="stuff")
    parser.add_argument("--every", type=int, default=1, help="score every n-th frame")
    parser.add_argument("--keep", type=Path, required=True, help="folder for what the mapper has rendered")
    parser.add_argument("--out", type=Path, help="PNG of a few frames")
    given = parser.parse_args()
    fit = PanopticFitConfig()
    for text in given.set:
        name, value = text.split("=")
        fit = msgspec.structs.replace(fit, **{name: type(getattr(fit, name))(float(value))})
    config = FinetuneConfig(
        seconds=0, steps=given.steps, width=given.width, grid=GridFitConfig(held_out=0), panoptic=fit
    )
    rows: dict[str, list[ConfusionMatrix]] = {}
    sheets: list[UInt8] = []
    for seed in given.rooms:
        room = map_room(seed, given.frames, given.width, given.keep)
        scored = room.frames[:: given.every]
        answers: dict[str, list[UInt8]] = {
            "S-Ray": list(room.pseudo[:: given.every]),
            "map cast back": list(room.cast[:: given.every]),
        }
        taught = [
            replace(f, label=label, label_is_pseudo=True) for f, label in zip(room.frames, room.pseudo, strict=True)
        ]
        for kind in given.boxes:
            boxes = tuple(map(box_config, room.true_boxes if kind == "true" else room.found_boxes))
            start = Panoptic(PanopticConfig(boxes=boxes, uncovered=given.uncovered), ROOMS)
            began = time.process_time()
            checkpoint = fit_panoptic(taught, ROOMS, start, config)
            spent = time.process_time() - began
            field = checkpoint.model
            assert isinstance(field, Panoptic)
            began = time.process_time()
            answers[f"panoptic, {kind} boxes"] = [predict(field, f) for f in scored]
            rendering = (time.process_time() - began) / len(scored)
            print(f"room {seed}, {kind} boxes: fit {spent:.0f} CPU s, a frame {rendering:.2f}", flush=True)
            print(f"  {checkpoint.recipe['panoptic']}", flush=True)
        for name, labels in answers.items():
            found = score(scored, labels)
            rows.setdefault(name, []).append(found)
            figures = found.metrics()
            print(f"  room {seed} {name}: {_per_cent(figures.miou)}; {_per_cent(figures.total_accuracy)}", flush=True)
        for number in np.linspace(0, len(scored) - 1, 3).round().astype(int):
            truth = scored[number].label
            assert truth is not None
            shown = [ROOMS.colorize(labels[number]) for labels in answers.values()]
            sheets.append(np.hstack([scored[number].rgb, *shown, ROOMS.colorize(truth)]))
    torch.set_num_threads(1)
    for name, found in rows.items():
        figures = sum(found[1:], found[0]).metrics()
        change = ""
        for other in ("S-Ray", "map cast back"):
            if name not in ("S-Ray", other) and len(found) > 1:
                c = paired_bootstrap(found, rows[other])
                change += f" | {100 * c.observed:+.1f} ({100 * c.low:+.1f} to {100 * c.high:+.1f}) over {other}"
        print(f"| {name} | {_per_cent(figures.miou)} | {_per_cent(figures.total_accuracy)} |{change}")
    if given.out is not None:
        write_picture(given.out, np.vstack(sheets))


def _per_cent(value: float | None) -> str:
    return f"{100 * (value or 0):.1f}"


if __name__ == "__main__":
    main()
