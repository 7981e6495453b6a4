"""The map of a procedural room against the room itself: frames through the real pipeline, then labels at surfaces."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from research.evaluation.instances import FoundInstances, InstanceMatches, match_instances
from research.evaluation.points import nearest_labels, nearest_points
from research.scenes import CameraPathConfig, NoiseConfig, RoomConfig, Scene, make_room, render_view, room_frames
from research.suites.config import MAP_WIDTH, SuiteConfig, camera_of_width, settings_digest
from research.suites.records import InstanceRecord, MapRecord
from research.suites.rooms import as_given
from research.suites.scoring import as_calibration, as_panoptic, as_rows
from research.train.computed_depth import DELAY_FRAMES
from semantic_mapper.config import DepthConfig
from semantic_mapper.errors import MapError
from semantic_mapper.evaluation.metrics import (
    ConfusionMatrix,
    ImageMeans,
    confusion_of,
)
from semantic_mapper.evaluation.panoptic import PanopticCounts, PanopticImage
from semantic_mapper.fields.nesf import NesfWeights
from semantic_mapper.fields.weights import default_checkpoint_path
from semantic_mapper.geometry import invert_pose, project, transform, unproject
from semantic_mapper.labels import ROOMS, STUFF_NAMES, LabelSet
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.map_types import MapView
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.mapping.refine import refine
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.queries.instances import Instance
from semantic_mapper.replay.evaluate.things import ThingSurface
from semantic_mapper.types import Float32, Float64, PosedFrame, UInt8

NEAR_M = 0.05  # a map point this near to the true surface speaks for it
SEEN_M = 0.03  # a frame sees a map point that is this near, in depth, to where its ray meets the map
UP = np.array((0.0, 0.0, 1.0))  # of procedural rooms
UNSEEN = 255  # no id of ``ROOMS``
TRUTH_VOXEL_M = 0.01  # the true surface is sampled this densely, where the camera saw it that densely


@dataclass(frozen=True, slots=True, eq=False)
class TrueSurface:
    """Points of a room's true surface that its camera has seen: xyz (N, 3) float32 metres, ids (N,) of ``ROOMS``, and
    numbers (N,) of the objects they belong to."""

    xyz: Float32
    label: UInt8
    instance: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class RoomLook:
    """A frame of the sequence: pose, true labels (H, W) and those that the pipeline rendered, ids of ``ROOMS``."""

    T_world_camera: Float64
    truth: UInt8
    label: UInt8


@dataclass(frozen=True, slots=True, eq=False)
class FusedRoom:
    """A room, its map, the frames that it was made of, and its true surface."""

    scene: Scene
    voxel_map: VoxelMap
    views: list[RoomLook]
    surface: TrueSurface


def map_room(seed: int, weights: Path, digest: str, suite: SuiteConfig) -> MapRecord:
    """Fuse a room's sequence and compare the map's labels with those of the nearest true surface.

    Raises WeightsError: see ``Mapper.load``. MapError: the map came out empty.

    Args:
        seed: Of the room.
        weights: File that the pipeline runs on.
        digest: Of the weights, for the record.
        suite: Gives the number of frames, their spacing, whether they have depth, and the settings of the mapper.
    """
    room = fuse_room(seed, weights, suite)
    return _compare(room, room.voxel_map, digest, settings_digest(suite, "map"), suite)


def refine_room(
    seed: int, weights: Path, digest: str, suite: SuiteConfig, networks: Mapping[str, NesfWeights]
) -> list[MapRecord]:
    """As ``map_room``, then with the map refined by each of ``networks``, by the settings that its record goes under.

    Raises WeightsError: see ``Mapper.load``; or networks of other classes. MapError: the map came out empty.
    """
    room = fuse_room(seed, weights, suite)
    records = [_compare(room, room.voxel_map, digest, settings_digest(suite, "map"), suite)]
    with tempfile.TemporaryDirectory() as folder:
        room.voxel_map.save(saved := Path(folder) / "map.npz")
        for settings, network in networks.items():
            refined = VoxelMap.load(saved)
            refine(refined, network, up=UP)
            records.append(_compare(room, refined, digest, settings, suite))
    return records


def fuse_room(seed: int, weights: Path, suite: SuiteConfig, rendered: int = 1) -> FusedRoom:
    """Map a room; only every so many-th of its frames is ``rendered``, the others are fused without classes.

    Raises WeightsError: see ``Mapper.load``.
    """
    pipeline = Mapper.load(weights, msgspec.structs.replace(suite.mapper, depth=_depth(suite))).pipeline
    camera = camera_of_width(MAP_WIDTH)
    path = CameraPathConfig(step_m=suite.sequence.step_m)
    furnished = RoomConfig(style=suite.sequence.style, camouflage=suite.sequence.camouflage)
    scene = make_room(seed, furnished)
    views: list[RoomLook] = []
    poses: list[Float64] = []
    frames = room_frames(seed, suite.map_frames, camera, room=furnished, path=path, noise=NoiseConfig())
    for number, frame in enumerate(frames):
        poses.append(frame.T_world_camera)
        if number % rendered and frame.depth_m is not None:
            pipeline.voxel_map.integrate(frame, frame.depth_m, None)
            continue
        ready = pipeline.prepare(as_given(frame, depth=suite.depth == "on", label=True))
        views += [_step(pipeline, waited) for waited in ready]
    views += [_step(pipeline, waited) for waited in pipeline.prepare_rest()]
    surface = true_surface(scene, poses)
    return FusedRoom(scene, pipeline.voxel_map, views, surface)


def kept_room(seed: int, suite: SuiteConfig, folder: Path, rendered: int = 1) -> tuple[Path, TrueSurface]:
    """The file of a room's map by the default weights, and its true surface; made where ``folder`` lacks them."""
    saved, true = folder / f"{seed}-map.npz", folder / f"{seed}-surface.npz"
    if not true.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        room = fuse_room(seed, default_checkpoint_path(), suite, rendered)
        room.voxel_map.save(saved)
        np.savez_compressed(true, xyz=room.surface.xyz, label=room.surface.label, instance=room.surface.instance)
    with np.load(true) as kept:
        return saved, TrueSurface(kept["xyz"], kept["label"], kept["instance"])


def _depth(suite: SuiteConfig) -> DepthConfig:
    """Where the mapper takes depth from: computed as in ``map``, and by the field where no frame has any."""
    config = suite.mapper.depth
    if suite.depth == "computed":
        waits = msgspec.structs.replace(config.from_motion, delay_frames=DELAY_FRAMES)
        return msgspec.structs.replace(config, source="computed", from_motion=waits)
    return msgspec.structs.replace(config, source="off" if suite.depth == "off" else config.source)


def _step(pipeline: MappingPipeline, frame: PosedFrame) -> RoomLook:
    assert frame.label is not None
    label = in_rooms(pipeline.step(frame).label, pipeline.label_set)
    return RoomLook(frame.T_world_camera, frame.label, label)


def in_rooms(label: UInt8, label_set: LabelSet) -> UInt8:
    """Ids of another label set as those of ``ROOMS`` with the same name; its ignore id for other names."""
    return ROOMS.to_ids(ROOMS.channel_map_from(label_set)[label])


def true_surface(scene: Scene, poses: list[Float64]) -> TrueSurface:
    """What a perfect camera at ``poses`` (each (4, 4)) sees of a room, one point a cubic centimetre."""
    camera = camera_of_width(MAP_WIDTH)
    xyz: list[Float32] = []
    label: list[UInt8] = []
    instance: list[NDArray[np.int64]] = []
    for T_world_camera in poses:
        view = render_view(scene, camera, T_world_camera)
        hit = view.depth_m > 0
        xyz.append(transform(T_world_camera, unproject(view.depth_m, camera)[hit]).astype(np.float32))
        label.append(view.label[hit])
        instance.append(view.instance[hit].astype(np.int64))
    points, labels = np.concatenate(xyz), np.concatenate(label)
    cell = np.floor(points / TRUTH_VOXEL_M).astype(np.int64)
    _, first = np.unique(cell @ np.array([1, 1 << 20, 1 << 40]), return_index=True)
    return TrueSurface(points[first], labels[first], np.concatenate(instance)[first])


def _compare(room: FusedRoom, voxel_map: VoxelMap, digest: str, settings: str, suite: SuiteConfig) -> MapRecord:
    scene, views, surface = room.scene, room.views, room.surface
    points = voxel_map.points()
    if not len(points.xyz):
        raise MapError(f"room {scene.seed}: none of its {suite.map_frames} frames could be fused; the map is empty")
    label = in_rooms(points.label, voxel_map.label_set)
    truth = nearest_labels(points.xyz, surface.xyz, surface.label, ROOMS, max_distance_m=NEAR_M)
    at_surface = confusion_of(
        surface.label, nearest_labels(surface.xyz, points.xyz, label, ROOMS, max_distance_m=NEAR_M), ROOMS, "map"
    )
    rendered = [confusion_of(v.truth, v.label, ROOMS, f"room {scene.seed}") for v in views]
    means = ImageMeans()
    for image in rendered:
        means.add(image)
    camera = camera_of_width(MAP_WIDTH)
    casts = [voxel_map.ray_cast(view.T_world_camera, camera) for view in views]
    cast, cast_views = _seen_from_its_frames(casts, voxel_map.label_set, views)
    one_frame = _label_of_one_frame(points.xyz, casts, views, scene.seed)
    seen = np.where(one_frame == UNSEEN, ROOMS.ignore_id, truth)
    answered = (truth != ROOMS.ignore_id) & (label != ROOMS.ignore_id)
    return MapRecord(
        settings=settings,
        weights=digest,
        room=scene.seed,
        template=scene.template,
        points=len(points.xyz),
        on_surface=float((truth != ROOMS.ignore_id).mean()),
        confusion=as_rows(confusion_of(truth, label, ROOMS, "map")),
        surface_confusion=as_rows(at_surface),
        view_confusion=as_rows(sum(rendered, ConfusionMatrix(ROOMS))),
        view_miou=means.metrics().miou,
        cast_confusion=as_rows(cast),
        cast_view_confusion=as_rows(cast_views),
        seen_confusion=as_rows(confusion_of(seen, label, ROOMS, "map")),
        one_frame_confusion=as_rows(
            confusion_of(seen, np.where(one_frame == UNSEEN, ROOMS.ignore_id, one_frame), ROOMS, "a frame")
        ),
        calibration=as_calibration(points.confidence[answered], label[answered] == truth[answered]),
        instances=compare_instances(voxel_map, surface),
        panoptic=as_panoptic(_compare_panoptic(room, voxel_map, casts)),
    )


def _compare_panoptic(room: FusedRoom, voxel_map: VoxelMap, casts: list[MapView]) -> PanopticCounts:
    """The finished map with its things, as its own frames see it, against what they show."""
    camera, counts = camera_of_width(MAP_WIDTH), PanopticCounts(ROOMS)
    seen = ThingSurface(voxel_map, up=UP)
    for view, cast in zip(room.views, casts, strict=True):
        true = render_view(room.scene, camera, view.T_world_camera)
        found = seen.panoptic(cast, view.T_world_camera, camera)
        found = PanopticImage(in_rooms(found.label, voxel_map.label_set), found.instance)
        counts.update(PanopticImage(true.label, true.instance), found, f"room {room.scene.seed}")
    return counts


def compare_instances(voxel_map: VoxelMap, surface: TrueSurface) -> InstanceRecord:
    """As ``match_things``, as data."""
    _, matches = match_things(voxel_map, surface)
    found = tuple((m.class_id, m.confidence, m.iou, m.truth, m.neither) for m in matches.found)
    return InstanceRecord(found=found, truth=matches.truth)


def match_things(
    voxel_map: VoxelMap, surface: TrueSurface, labels: LabelSet = ROOMS, up: Float64 = UP
) -> tuple[tuple[Instance, ...], InstanceMatches]:
    """The things that queries find in a map, unsure ones, too, and each against those of the true surface, ids of
    ``labels``, at the map's surface voxels."""
    seen = ThingSurface(voxel_map, up=up)
    nearest = nearest_points(seen.xyz, surface.xyz, max_distance_m=NEAR_M)
    things = seen.things
    channel = labels.channel_map_from(voxel_map.label_set)
    class_id = labels.to_ids(channel[np.array([thing.class_id for thing in things], np.uint8)])
    confidence = np.array([thing.certainty for thing in things], np.float32)
    matches = match_instances(
        FoundInstances(seen.number, class_id, confidence),
        np.append(surface.label, np.uint8(labels.ignore_id))[nearest],
        np.append(surface.instance, 0)[nearest],
        labels,
        STUFF_NAMES,
    )
    return things, matches


def _label_of_one_frame(xyz: Float32, casts: list[MapView], views: list[RoomLook], seed: int) -> UInt8:
    """For each map point (N, 3) what one of the frames that see it says, drawn at random; ``UNSEEN`` where none does.

    That is the map without fusion: the same points, each counting once, labelled by a single look.
    """
    camera = camera_of_width(MAP_WIDTH)
    rng = np.random.default_rng(seed)
    chosen = np.full(len(xyz), UNSEEN, np.uint8)
    looks = np.zeros(len(xyz), np.int64)
    for view, cast in zip(views, casts, strict=True):
        p = transform(invert_pose(view.T_world_camera), xyz.astype(np.float64))
        front = np.flatnonzero(p[:, 2] > 0.05)
        uv = np.rint(project(p[front], camera)).astype(np.int64)
        inside = ((uv >= 0) & (uv < (camera.width, camera.height))).all(1)
        index, (u, v) = front[inside], uv[inside].T
        surface = cast.depth_m[v, u]
        visible = (surface > 0) & (np.abs(surface - p[index, 2]) < SEEN_M)
        index, label = index[visible], view.label[v[visible], u[visible]]
        looks[index] += 1
        taken = rng.random(len(index)) * looks[index] < 1  # so that in the end every look was as likely
        chosen[index[taken]] = label[taken]
    return chosen


def _seen_from_its_frames(
    casts: list[MapView], label_set: LabelSet, views: list[RoomLook]
) -> tuple[ConfusionMatrix, ConfusionMatrix]:
    """The finished map as its own frames see it, and their rendered labels, both at the pixels where it has a label.

    The two are each other's like: the same pixels of the same classes, so that their difference is what fusing brings.
    """
    fused, rendered = ConfusionMatrix(ROOMS), ConfusionMatrix(ROOMS)
    for view, cast in zip(views, casts, strict=True):
        label = in_rooms(cast.label, label_set)
        truth = np.where(cast.label == label_set.ignore_id, ROOMS.ignore_id, view.truth)
        fused = fused + confusion_of(truth, label, ROOMS, "map seen from a frame")
        rendered = rendered + confusion_of(truth, view.label, ROOMS, "frame")
    return fused, rendered
