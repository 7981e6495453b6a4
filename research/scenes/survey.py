"""Look at the suite: contact sheets, how often each class is seen, how fast rooms are rendered.

``python -m research.scenes.survey sheet --out rooms.png`` and likewise ``classes``, ``speed``, ``klevr``,
``aerial`` and ``streets``.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated

import cv2
import msgspec
import numpy as np
import typer

from research.scenes.aerial.views import aerial_camera, aerial_views, cached_town
from research.scenes.camera import camera_path
from research.scenes.config import (
    TEST_SEEDS,
    TRAIN_SEEDS,
    VALIDATION_SEEDS,
    CameraPathConfig,
    DepthSensorName,
    NoiseConfig,
    RoomConfig,
)
from research.scenes.klevr import klevr_camera, klevr_views
from research.scenes.render import render_view
from research.scenes.room import make_room
from research.scenes.room_templates import ROOM_TEMPLATES
from research.scenes.sequence import RoomView, room_views
from research.scenes.shots import sequence_shots
from research.scenes.streets.boxes import StreetBox, street_boxes
from research.scenes.streets.pseudo import pseudo_labels, pseudo_miou
from research.scenes.streets.views import PAIRS, cached_street, street_camera, street_views
from semantic_mapper.geometry import transform, unproject
from semantic_mapper.labels import CARLA, KITTI360, KLEVR, ROOMS
from semantic_mapper.log_events import get_logger
from semantic_mapper.plots import draw_picture_rows
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, UInt8

CAMERA = CameraIntrinsics(220.6, 220.6, 159.5, 119.5, 320, 240)  # an OAK-D's colour camera, at a quarter of its width
SPLITS = {"train": TRAIN_SEEDS, "validation": VALIDATION_SEEDS, "test": TEST_SEEDS}
AERIAL_SHOWN = (8, 47, 85, 104)  # numbers of views, from high to low
SPREAD = CameraPathConfig(step_m=0.6)  # views that differ

app = typer.Typer(add_completion=False, help=__doc__)
log = get_logger(__name__)


def contact_sheet(
    seeds: Iterable[int],
    views: int,
    *,
    across: int = 1,
    camera: CameraIntrinsics = CAMERA,
    noise: NoiseConfig | None = NoiseConfig(),
) -> UInt8:
    """Rooms as rows of pictures (H, W, 3) RGB: for each view its colours, its labels and its measured depth.

    The room templates take turns, so that six seeds show all of them. ``across`` rooms share a row.
    """
    names = sorted(ROOM_TEMPLATES)
    rows: list[UInt8] = []
    for number, seed in enumerate(seeds):
        room = RoomConfig(template=names[number % len(names)])  # type: ignore[arg-type]
        tiles: list[UInt8] = []
        for view in room_views(seed, views, camera, room=room, path=SPREAD, noise=noise):
            depth = view.rendered.depth_m
            tiles += [view.frame.rgb, ROOMS.colorize(view.rendered.label), depth_picture(depth)]
        rows.append(np.concatenate(tiles, 1))
        cv2.putText(rows[-1], f"{seed} {room.template}", (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 0), 1)
    rows += [np.zeros_like(rows[0])] * (-len(rows) % across)
    return np.concatenate([np.concatenate(rows[k : k + across], 1) for k in range(0, len(rows), across)], 0)


def class_shares(seeds: Iterable[int], views: int) -> dict[str, Float64]:
    """Of each class: fraction of all pixels, and fraction of the pictures that show it (2,)."""
    small = CameraIntrinsics(55.15, 55.15, 39.5, 29.5, 80, 60)
    pixels, pictures, count = np.zeros(256), np.zeros(256), 0
    for seed in seeds:
        scene = make_room(seed, RoomConfig(shadow_resolution=8))
        for pose in camera_path(scene, views, seed, SPREAD):
            histogram = np.bincount(render_view(scene, small, pose).label.ravel(), minlength=256)
            pixels += histogram
            pictures += histogram > 0
            count += 1
    return {
        name: np.array([pixels[i] / pixels.sum(), pictures[i] / count])
        for i, name in zip(ROOMS.ids, ROOMS.names, strict=True)
    }


def images_per_second(seeds: Iterable[int], views: int, depth: DepthSensorName) -> dict[str, float]:
    """Images a CPU second, all threads counted, with full shading and sensors: of views alone, and of whole rooms."""
    noise = NoiseConfig(depth=depth)
    making = rendering = 0.0
    count = primitives = rooms = 0
    for seed in seeds:
        started = time.process_time()
        scene = make_room(seed)
        poses = camera_path(scene, views, seed)
        shots = sequence_shots(poses, seed, noise)
        made = time.process_time()
        for k, pose in enumerate(poses):
            render_view(scene, CAMERA, pose, noise=k, noise_config=noise, shot=shots[k])
        making, rendering = making + made - started, rendering + time.process_time() - made
        count, primitives, rooms = count + views, primitives + len(scene.primitives), rooms + 1
    return {
        "views_per_s": count / rendering,
        "with_room_and_path_per_s": count / (rendering + making),
        "room_and_path_s": making / rooms,
        "primitives": primitives / rooms,
    }


def box_overlap(views: Sequence[RoomView], boxes: Sequence[StreetBox]) -> tuple[float, float]:
    """Fraction of the surface pixels that lie in a box of their class, and of those in boxes of two classes."""
    names = sorted({box.name for box in boxes})
    covered = several = count = 0
    for view in views:
        exact = view.rendered.exact_depth_m
        points = transform(view.T_world_camera, unproject(exact, view.frame.intrinsics)).reshape(-1, 3)
        points, label = points[exact.ravel() > 0], view.rendered.label.ravel()[exact.ravel() > 0]
        inside = np.zeros((len(names), len(points)), np.bool_)
        for box in boxes:
            inside[names.index(box.name)] |= box.contains(points)
        own = np.array([KITTI360.id_of(name) for name in names])[:, None] == label
        covered, several = covered + (inside & own).any(axis=0).sum(), several + (inside.sum(axis=0) > 1).sum()
        count += len(points)
    return float(covered / count), float(several / count)


def depth_picture(depth_m: Float32) -> UInt8:
    """Near is red, 6 m and more are blue, black where there is none."""
    grey = np.clip(depth_m / 6.0 * 255.0, 0, 255).astype(np.uint8)
    picture = np.asarray(cv2.applyColorMap(255 - grey, cv2.COLORMAP_TURBO), np.uint8)[..., ::-1].copy()
    picture[depth_m == 0] = 0
    return picture


Split = Annotated[str, typer.Option(help="train, validation or test")]
Rooms = Annotated[int, typer.Option(help="how many seeds of the split")]
Views = Annotated[int, typer.Option(help="of each room")]


@app.command()
def sheet(
    out: Annotated[Path, typer.Option(help="PNG or JPEG to write")],
    split: Split = "train",
    first: Annotated[int, typer.Option(help="how many seeds of the split to skip")] = 0,
    rooms: Rooms = 12,
    views: Views = 2,
    across: Annotated[int, typer.Option(help="rooms side by side")] = 1,
    scale: Annotated[float, typer.Option(help="of the picture that is written")] = 1.0,
    clean: Annotated[bool, typer.Option(help="perfect sensors")] = False,
) -> None:
    """Write pictures, labels and depth of rooms of all room templates to a PNG or JPEG."""
    seeds, noise = SPLITS[split][first : first + rooms], None if clean else NoiseConfig()
    picture = contact_sheet(seeds, views, across=across, noise=noise)
    picture = np.asarray(cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    cv2.imwrite(str(out), np.ascontiguousarray(picture[..., ::-1]))
    log.info("contact_sheet_written", path=str(out), size=picture.shape)


@app.command()
def classes(
    out: Annotated[Path, typer.Option(help="JSON to write")],
    split: Split = "train",
    rooms: Rooms = 100,
    views: Views = 10,
) -> None:
    """Measure how often each class is seen and write the shares as JSON."""
    shares = class_shares(SPLITS[split][:rooms], views)
    plain = {name: {"pixels": round(float(s[0]), 5), "pictures": round(float(s[1]), 4)} for name, s in shares.items()}
    out.write_bytes(msgspec.json.format(msgspec.json.encode(plain), indent=1))
    log.info("class_shares", **{name: f"{100 * s[0]:.2f} %" for name, s in shares.items()})


@app.command()
def speed(rooms: Rooms = 8, views: Views = 30, depth: Annotated[str, typer.Option()] = "oak_d") -> None:
    """Measure images a CPU second at 320x240; the first room only warms the compiled code up."""
    sensor = msgspec.convert(depth, DepthSensorName)
    images_per_second(TRAIN_SEEDS[:1], 2, sensor)
    figures = images_per_second(TRAIN_SEEDS[1 : rooms + 1], views, sensor)
    log.info("speed", depth=sensor, **{name: round(value, 2) for name, value in figures.items()})


@app.command()
def klevr(
    out: Annotated[Path, typer.Option(help="PNG or JPEG to write")],
    scenes: Annotated[int, typer.Option(help="how many of each variant")] = 6,
    width: Annotated[int, typer.Option(help="pixels of a picture")] = 180,
) -> None:
    """Write pictures and labels of KLEVR scenes, upright and floating, and measure 100 views of 72x72 a scene."""
    rows: dict[str, list[UInt8]] = {}
    for variant in ("upright", "float"):
        views = [next(klevr_views(seed, [0], klevr_camera(width), variant=variant)) for seed in range(scenes)]
        rows[variant] = [view.frame.rgb for view in views]
        rows[f"{variant}: classes"] = [KLEVR.colorize(view.rendered.label) for view in views]
    cv2.imwrite(str(out), np.ascontiguousarray(draw_picture_rows(rows, KLEVR, width)[..., ::-1]))
    started = time.process_time()
    for seed in range(scenes):
        for _ in klevr_views(seed, range(100), klevr_camera(72)):
            pass
    log.info("klevr_written", path=str(out), cpu_s_a_scene=round((time.process_time() - started) / scenes, 3))


@app.command()
def aerial(
    out: Annotated[Path, typer.Option(help="PNG or JPEG to write")],
    first: Annotated[int, typer.Option(help="seed of the first town")] = 200_000,
    towns: Annotated[int, typer.Option(help="how many")] = 2,
    width: Annotated[int, typer.Option(help="pixels of a picture")] = 230,
) -> None:
    """Write pictures and labels of towns from four heights, one in the dark, and measure views of 192x192."""
    rows: dict[str, list[UInt8]] = {}
    for seed in range(first, first + towns):
        views = list(aerial_views(seed, AERIAL_SHOWN, aerial_camera(width)))
        views += aerial_views(seed, AERIAL_SHOWN[:1], aerial_camera(width), dark=True)
        rows[f"town {seed}"] = [view.frame.rgb for view in views]
        rows[f"{seed}: classes"] = [CARLA.colorize(view.rendered.label) for view in views]
    cv2.imwrite(str(out), np.ascontiguousarray(draw_picture_rows(rows, CARLA, width)[..., ::-1]))
    started = time.process_time()
    count = sum(1 for _ in aerial_views(first, range(0, 100, 10), aerial_camera(192)))
    seconds = (time.process_time() - started) / count
    primitives = [len(cached_town(seed).scene.primitives) for seed in range(first, first + towns)]
    log.info("aerial_written", path=str(out), cpu_s_a_view=round(seconds, 3), primitives=primitives)


@app.command()
def streets(
    out: Annotated[Path, typer.Option(help="PNG or JPEG to write")],
    first: Annotated[int, typer.Option(help="seed of the first street")] = 200_000,
    count: Annotated[int, typer.Option(help="how many")] = 2,
    width: Annotated[int, typer.Option(help="pixels of a picture")] = 352,
) -> None:
    """Write pictures, measured depth, labels and predicted labels of streets, and measure what the suite promises."""
    camera, columns = street_camera(width), list[UInt8]()
    seen: dict[str, int] = dict.fromkeys(KITTI360.names, 0)
    overlaps: list[float] = []
    for seed in range(first, first + count):
        started = time.process_time()
        views = list(street_views(seed, range(PAIRS), camera))
        seconds = (time.process_time() - started) / PAIRS
        predicted, scored = pseudo_labels(views, seed, every=4), views[::4]
        covered, several = box_overlap(scored, boxes := street_boxes(cached_street(seed), PAIRS))
        overlaps.append(several)
        ids = np.unique(np.concatenate([view.rendered.label.ravel() for view in scored]))
        for name in KITTI360.names:
            seen[name] += KITTI360.id_of(name) in ids
        log.info(
            "street",
            seed=seed,
            boxes=len(boxes),
            primitives=len(cached_street(seed).scene.primitives),
            in_own_class=round(covered, 4),
            in_two_classes=round(several, 3),
            pseudo_miou=round(pseudo_miou(scored, predicted[::4]), 3),
            cpu_s_a_view=round(seconds, 2),
        )
        rows = [
            [view.frame.rgb for view in views[::8]],
            [depth_picture(view.rendered.depth_m / np.float32(6)) for view in views[::8]],
            [KITTI360.colorize(view.rendered.label) for view in views[::8]],
            [KITTI360.colorize(label) for label in predicted[::8]],
        ]
        columns += [np.concatenate(row, 1) for row in rows]
    cv2.imwrite(str(out), np.ascontiguousarray(np.concatenate(columns, 0)[..., ::-1]))
    log.info("streets_written", path=str(out), in_two_classes=round(float(np.mean(overlaps)), 3), streets_with=seen)


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    app()
