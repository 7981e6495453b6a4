"""Panoptic NeRF in procedural rooms: labels of all frames from boxes of things and the labels of the shipped S-Ray.

python -m research.experiments.panoptic_rooms --rooms 100000 100001 --keep /tmp/rooms
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from research.scenes import CameraPathConfig, NoiseConfig, RoomConfig, Scene, make_room
from research.scenes.sequence import room_views
from research.suites.config import camera_of_width
from semantic_mapper.config import PanopticConfig, SamplingConfig
from semantic_mapper.evaluation.bootstrap import paired_bootstrap
from semantic_mapper.evaluation.metrics import ConfusionMatrix, confusion_of
from semantic_mapper.evaluation.panoptic import PanopticCounts, PanopticImage
from semantic_mapper.fields.panoptic import Panoptic, box_config
from semantic_mapper.fields.primitives import Primitive
from semantic_mapper.fields.render import render_image
from semantic_mapper.fields.source_maps import encoded_views
from semantic_mapper.imaging import resize_depth
from semantic_mapper.labels import ROOMS, STUFF_NAMES
from semantic_mapper.mapper import Mapper
from semantic_mapper.nodes.cli.map_answers import answer_instances
from semantic_mapper.plots import draw_picture_rows, write_picture
from semantic_mapper.queries.oriented_box import upright_box
from semantic_mapper.replay.box_picture import edges_in_view
from semantic_mapper.replay.boxes import load_boxes
from semantic_mapper.replay.evaluate.thing_surface import ThingSurface
from semantic_mapper.replay.instance_images import thing_image
from semantic_mapper.training.finetune import FinetuneConfig, PanopticFitConfig
from semantic_mapper.training.grid_fit import GridFitConfig
from semantic_mapper.training.panoptic import fit_panoptic
from semantic_mapper.training.views import stack_sources, view_from_frame
from semantic_mapper.types import PosedFrame, UInt8

UP = np.array((0.0, 0.0, 1.0))
INFLATED = 1.1
COLUMNS = 3  # frames of a picture


@dataclass(frozen=True, slots=True, eq=False)
class MappedRoom:
    """A room's frames with the true things, labels of S-Ray, those and things of the map cast back, and boxes."""

    frames: list[PosedFrame]
    things: list[NDArray[np.uint16]]
    pseudo: UInt8
    cast: list[PanopticImage]
    true_boxes: tuple[Primitive, ...]
    found_boxes: tuple[Primitive, ...]


def map_room(seed: int, count: int, width: int, keep: Path) -> MappedRoom:
    """Map a room as ``replay`` does it; what was rendered is kept in a folder."""
    views = list(room_views(seed, count, camera_of_width(width), path=CameraPathConfig(), noise=NoiseConfig()))
    frames = [view.frame for view in views]
    kept, boxes = (keep / f"{seed}-{count}-{width}{end}" for end in ("-things.npz", ".json"))
    if not kept.is_file():
        keep.mkdir(parents=True, exist_ok=True)
        mapper = Mapper.load()
        pseudo = [mapper.step(replace(f, label=None)).label for f in frames]
        surface, cast = ThingSurface(mapper.voxel_map), list[PanopticImage]()
        for f in frames:
            seen = mapper.voxel_map.ray_cast(f.T_world_camera, f.intrinsics)
            cast.append(surface.panoptic(seen, f.T_world_camera, f.intrinsics))
        boxes.write_text(json.dumps({"map": "room", **answer_instances(UP.tolist(), surface.things)}))
        label, instance = (np.stack(images) for images in zip(*cast, strict=True))
        np.savez_compressed(kept, pseudo=np.stack(pseudo), label=label, instance=instance)
    with np.load(kept) as found:
        cast = list(map(PanopticImage, found["label"], found["instance"]))
        true_boxes = thing_boxes(make_room(seed, RoomConfig()))
        things = [view.rendered.instance for view in views]
        return MappedRoom(frames, things, found["pseudo"], cast, true_boxes, load_boxes(boxes).primitives)


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


def predict(field: Panoptic, frame: PosedFrame) -> PanopticImage:
    """Labels and things of a frame."""
    views = stack_sources([view_from_frame(replace(frame, label=None), field.label_set, frame.intrinsics.width)])
    depth_m = resize_depth(frame, frame.intrinsics)
    scene = (frame.intrinsics, frame.T_world_camera, depth_m, SamplingConfig(), 0)
    found = render_image(field, encoded_views(views, views.rgb[:, :0]), *scene)
    channel = np.where(found.known.numpy(), found.logits.argmax(1).numpy(), -1)
    label = ROOMS.to_ids(channel).reshape(depth_m.shape)
    return PanopticImage(label, thing_image(field, frame, label))


def score(room: MappedRoom, every: int, found: Sequence[PanopticImage]) -> tuple[ConfusionMatrix, PanopticCounts]:
    """Every n-th frame of a room; a pixel without an answer is wrong."""
    total, counts = ConfusionMatrix(ROOMS), PanopticCounts(ROOMS)
    for frame, things, image in zip(room.frames[::every], room.things[::every], found, strict=True):
        assert frame.label is not None
        total = total + confusion_of(frame.label, image.label, ROOMS, "frame")
        counts.update(PanopticImage(frame.label, things), image)
    return total, counts


def fit(room: MappedRoom, kind: str, given: argparse.Namespace) -> Panoptic:
    """The field of a room."""
    losses = PanopticFitConfig()
    for text in given.set:
        name, value = text.split("=")
        losses = msgspec.structs.replace(losses, **{name: type(getattr(losses, name))(float(value))})
    grid = GridFitConfig(held_out=0)
    config = FinetuneConfig(seconds=0, steps=given.steps, width=given.width, grid=grid, panoptic=losses)
    labels = room.pseudo if given.pseudo == "sray" else [image.label for image in room.cast]
    taught = [replace(f, label=label, label_is_pseudo=True) for f, label in zip(room.frames, labels, strict=True)]
    boxes = tuple(map(box_config, room.true_boxes if kind == "true" else room.found_boxes))
    start = Panoptic(PanopticConfig(boxes=boxes, uncovered=given.uncovered), ROOMS)
    began = time.process_time()
    checkpoint = fit_panoptic(taught, ROOMS, start, config)
    print(f"  {kind} boxes: fit {time.process_time() - began:.0f} CPU s; {checkpoint.recipe['panoptic']}", flush=True)
    assert isinstance(checkpoint.model, Panoptic)
    return checkpoint.model


def main() -> None:
    """Print a row for each way to label the frames."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rooms", nargs="+", type=int, default=[100000])
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--width", type=int, default=160)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--boxes", choices=["true", "query"], nargs="+", default=["true", "query"])
    parser.add_argument("--pseudo", choices=["sray", "map"], default="map", help="labels to learn from")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="of PanopticFitConfig")
    parser.add_argument("--uncovered", choices=["stuff", "empty"], default="stuff")
    parser.add_argument("--every", type=int, default=1, help="score every n-th frame")
    parser.add_argument("--keep", type=Path, required=True, help="folder for what the mapper has rendered")
    parser.add_argument("--out", type=Path, help="PNG of a few frames of the last room")
    given = parser.parse_args()
    torch.set_num_threads(1)
    rows: dict[str, list[tuple[ConfusionMatrix, PanopticCounts]]] = {}
    for seed in given.rooms:
        print(f"room {seed}", flush=True)
        room = map_room(seed, given.frames, given.width, given.keep)
        no_things = np.zeros_like(room.things[0])
        answers = {
            "S-Ray": [PanopticImage(label, no_things) for label in room.pseudo[:: given.every]],
            "map cast back": room.cast[:: given.every],
        }
        for kind in given.boxes:
            field = fit(room, kind, given)
            began = time.process_time()
            answers[f"panoptic, {kind} boxes"] = [predict(field, f) for f in room.frames[:: given.every]]
            seconds = (time.process_time() - began) / len(answers["S-Ray"])
            print(f"  a frame with its things: {seconds:.2f} CPU s", flush=True)
        for name, found in answers.items():
            rows.setdefault(name, []).append(score(room, given.every, found))
            print("  " + _row(name, *rows[name][-1]), flush=True)
        if given.out is not None:
            draw(room, given, answers)
    for name, found in rows.items():
        matrices, counts = [matrix for matrix, _ in found], [of for _, of in found]
        change = ""
        for other in ("S-Ray", "map cast back"):
            if name not in ("S-Ray", other) and len(found) > 1:
                c = paired_bootstrap(matrices, [matrix for matrix, _ in rows[other]])
                change += f" {100 * c.observed:+.1f} ({100 * c.low:+.1f} to {100 * c.high:+.1f}) over {other};"
        print(_row(name, sum(matrices[1:], matrices[0]), sum(counts[1:], counts[0])) + change)


def draw(room: MappedRoom, given: argparse.Namespace, answers: Mapping[str, Sequence[PanopticImage]]) -> None:
    """Image, boxes, labels of S-Ray, of the last answer and true ones, things of both, of a few frames."""
    last = list(answers.values())[-1]
    boxes = room.found_boxes if given.boxes[-1] == "query" else room.true_boxes
    rows: dict[str, list[UInt8]] = {}
    for number in np.linspace(0, len(last) - 1, COLUMNS + 2).round().astype(int)[1:-1]:
        frame, things = (of[number * given.every] for of in (room.frames, room.things))
        assert frame.label is not None
        drawn = frame.rgb.copy()
        for box in boxes:
            for (ax, ay), (bx, by) in edges_in_view(box, frame.T_world_camera, frame.intrinsics):
                cv2.line(drawn, (round(ax), round(ay)), (round(bx), round(by)), (255, 200, 0), 1, cv2.LINE_AA)
        true_things = np.where(np.isin(frame.label, ROOMS.thing_ids(STUFF_NAMES)), things, 0)
        shown = {
            "image": frame.rgb,
            "boxes": drawn,
            "labels of S-Ray": ROOMS.colorize(answers["S-Ray"][number].label),
            "Panoptic NeRF": ROOMS.colorize(last[number].label),
            "true classes": ROOMS.colorize(frame.label),
            "things found": thing_colours(last[number].instance),
            "true things": thing_colours(true_things),
        }
        for caption, image in shown.items():
            rows.setdefault(caption, []).append(image)
    write_picture(given.out, draw_picture_rows(rows, ROOMS, 2 * given.width))


def thing_colours(number: NDArray[np.integer[Any]]) -> UInt8:
    """A colour for each thing, black where there is none."""
    colours = np.random.default_rng(3).integers(60, 256, (65536, 3)).astype(np.uint8)
    colours[0] = 0
    return colours[number]


def _row(name: str, matrix: ConfusionMatrix, counts: PanopticCounts) -> str:
    labels, things = matrix.metrics(), counts.metrics()
    of_things = "-" if name == "S-Ray" else f"{_per_cent(things.pq)} | {_per_cent(things.pq_things)}"
    by_class = ", ".join(f"{n} {_per_cent(v)}" for n, v in labels.per_class.items())
    return f"| {name} | {_per_cent(labels.miou)} | {_per_cent(labels.total_accuracy)} | {of_things} | {by_class}"


def _per_cent(value: float | None) -> str:
    return f"{100 * (value or 0):.1f}"


if __name__ == "__main__":
    main()
