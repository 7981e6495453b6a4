"""What Rerun shows of a session: cameras, rendered semantics, depth, path, the map in four colourings, stage times.

The same is written to a recording (.rrd) and sent to a viewer that watches, so both look alike; ``rerun_layout`` says
how.
"""

import threading
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rerun as rr
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from semantic_mapper.errors import LogError
from semantic_mapper.evaluation.upright import camera_up
from semantic_mapper.geometry import scale_intrinsics
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.map_types import MapPoints, computed_fraction
from semantic_mapper.plots import CHANGE_COLORS, UNKNOWN
from semantic_mapper.queries.graph import HUNG_NAMES, Room, SceneGraph
from semantic_mapper.queries.instances import Instance
from semantic_mapper.queries.objects import MapObject, ObjectChange
from semantic_mapper.replay.exporters.base import CameraPath
from semantic_mapper.replay.rerun_layout import (
    CEILING,
    COMPUTED_COLOR,
    MEASURED_COLOR,
    Eye,
    camera_path,
    draw_map_legend,
    eye_on,
    in_ceiling,
    layout,
    scale_colors,
)
from semantic_mapper.types import CameraIntrinsics, Float64, MapUpdate, PosedFrame

APPLICATION = "semantic_mapper"
IMAGE_WIDTH = 320  # images are logged at this width: a recording of a long log stays small
JPEG_QUALITY = 80
FRUSTUM_M = 0.4  # how far before the camera its image stands in the world
REGROWN = 1.5  # a map that is so much larger is looked at again
FLUSH_S = 10.0
MOVING_COLOR, MOVING_RADIUS_M, MOVING_STRIDE = (255, 80, 160), 0.015, 4
NAMED, NAMED_M = 3, 0.4  # kinds of things that a room is called by; the least length of a thing with a name
APART_M = 0.5  # two names; the larger thing has its own
ROOM_COLOR, DOOR_RADIUS_M, DOT_RADIUS_M = (255, 255, 255), 0.06, 0.01
GONE_COLOR = (150, 150, 150)


def recording_file(path: Path) -> rr.RecordingStream:
    """A recording that is written to a file; open it with ``rerun FILE``. Raises LogError: the file cannot be made."""
    stream = rr.RecordingStream(APPLICATION)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        stream.save(path)
    except (OSError, RuntimeError) as error:
        raise LogError(f"{path}: cannot be written: {error}") from error
    return stream


def recording_server(url: str) -> rr.RecordingStream:
    """A recording that is sent to a server as it grows (``rerun+http://HOST:PORT/proxy``)."""
    stream = rr.RecordingStream(APPLICATION)
    stream.connect_grpc(url)
    return stream


class RerunLog:
    """Writes to one recording. Frames and maps may come from two threads; ``label_set`` is that of images and map."""

    def __init__(self, stream: rr.RecordingStream, label_set: LabelSet, voxel_size_m: float = 0.02) -> None:
        self._stream = stream
        self._label_set = label_set
        self._radius = voxel_size_m / 2
        self._lock = threading.Lock()
        self._cameras: list[str] = []
        self._paths: dict[str, CameraPath] = {}
        self._up: Float64 | None = None  # as the floor says, once it is known
        self._eye: Eye | None = None
        self._colourings: list[str] = ["class"]  # of the map
        self._extent_m = -1.0  # of the map when the eye was set
        infos = [
            rr.AnnotationInfo(id=i, label=name, color=color)
            for i, name, color in zip(label_set.ids, label_set.names, label_set.colors, strict=True)
        ]
        infos.append(rr.AnnotationInfo(id=label_set.ignore_id, label="unknown", color=UNKNOWN))
        stream.log("/", rr.AnnotationContext(infos), static=True)

    def note_scale(self, known: bool) -> None:
        """Where lengths are no metres, the recording says so (entity ``scale``)."""
        if not known:
            self.note("scale", "unknown; lengths are not metres")

    def note(self, name: str, text: str) -> None:
        """Something to know of the whole recording: the entity ``name``."""
        self._stream.log(name, rr.TextDocument(f"{name}: {text}"), static=True)

    def log_step(self, frame: PosedFrame, update: MapUpdate) -> None:
        """One frame and what was rendered for it."""
        self.log_frame(frame)
        self.log_update(update, frame.intrinsics)

    def log_frame(self, frame: PosedFrame, *, posed: bool = True) -> None:
        """A camera image with its pose, or the image alone where its pose is not of the map's world."""
        path, k, T = self._camera(frame.camera_id), _as_logged(frame.intrinsics), frame.T_world_camera
        self.set_time(frame.stamp_ns, frame.seq)
        rgb = cv2.resize(frame.rgb, (k.width, k.height), interpolation=cv2.INTER_AREA)
        self._stream.log(f"{path}/image/rgb", rr.Image(np.asarray(rgb, np.uint8)).compress(jpeg_quality=JPEG_QUALITY))
        if not posed:
            return
        self._stream.log(path, rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        self._stream.log(
            f"{path}/image",
            rr.Pinhole(
                focal_length=(k.fx, k.fy),
                principal_point=(k.cx + 0.5, k.cy + 0.5),
                width=k.width,
                height=k.height,
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=FRUSTUM_M,
            ),
        )
        self._paths.setdefault(frame.camera_id, CameraPath()).add(T)

    def log_update(self, update: MapUpdate, intrinsics: CameraIntrinsics) -> None:
        """What was rendered for a frame of a camera with these intrinsics, and how long it took."""
        path, k = self._camera(update.camera_id), _as_logged(intrinsics)
        size = k.width, k.height
        self.set_time(update.stamp_ns, update.seq)
        label = cv2.resize(update.label, size, interpolation=cv2.INTER_NEAREST_EXACT)
        self._stream.log(f"{path}/image/semantics", rr.SegmentationImage(np.asarray(label, np.uint8)))
        depth = cv2.resize(update.depth_m, size, interpolation=cv2.INTER_NEAREST_EXACT)
        self._stream.log(f"{path}/image/depth", rr.DepthImage(np.asarray(depth, np.float32), meter=1.0))
        self._stream.log(f"{path}/moving", moving_points(update, intrinsics))
        for stage, value in update.stage_ms.items():
            self._stream.log(f"stage_ms/{stage}", rr.Scalars(value))

    def log_map(self, points: MapPoints) -> None:
        """The surface of the map as it is now, in all colourings that it has something to tell in."""
        computed = computed_fraction(points)
        for camera, path in list(self._paths.items()):
            positions = np.stack([T[:3, 3] for T in list(path.poses)])
            self._stream.log(rr.new_entity_path(["world", "path", camera]), rr.LineStrips3D([positions]))
        looks = {
            "class": {"class_ids": points.label.astype(np.uint16)},
            "colour": {"colors": points.rgb},
            "confidence": {"colors": scale_colors(points.confidence)},
        }
        if points.measured is not None and computed:
            colors = np.array((COMPUTED_COLOR, MEASURED_COLOR), np.uint8)
            looks["measured"] = {"colors": colors[points.measured.astype(np.intp)]}
        self._look_at(points, list(looks))
        above = np.zeros(len(points.xyz), np.bool_) if self._eye is None else in_ceiling(points.xyz, self._eye.up)
        for name, look in looks.items():
            for part, kept in ("", ~above), (f"/{CEILING}", above):
                shown = {kind: values[kept] for kind, values in look.items()}
                self._stream.log(f"world/map/{name}{part}", rr.Points3D(points.xyz[kept], radii=self._radius, **shown))
        legend = draw_map_legend(points.label, self._label_set, computed)
        self._stream.log("legend", rr.Image(legend))

    def log_graph(self, graph: SceneGraph, gone: Sequence[Instance] = ()) -> None:
        """Rooms, doors and things of the map as it is now, in the view that is coloured by class.

        Where things were that are ``gone`` is drawn in grey, with the stamp of when they went.
        """
        self._up = graph.up
        rooms = [np.concatenate((room.outline, room.outline[:1])) for room in graph.rooms]
        self._stream.log("world/graph/rooms", rr.LineStrips3D(rooms, colors=ROOM_COLOR))
        doors = np.array([door.center for door in graph.doors]).reshape(-1, 3)
        widths = [f"door, {door.width_m:.2f} m" for door in graph.doors]
        self._stream.log("world/graph/doors", rr.Points3D(doors, radii=DOOR_RADIUS_M, colors=ROOM_COLOR, labels=widths))
        classes = [thing.class_id for thing in graph.things]
        self._log_boxes("things", graph.things, class_ids=classes, show_labels=False)
        large = sorted(filter(is_large, graph.things), key=lambda thing: -thing.box.size.prod())
        tops = [t.box.center + graph.up * (np.abs(t.box.R_world_box.T @ graph.up) @ t.box.size / 2) for t in large]
        kept = list[int]()
        for i, top in enumerate(tops):
            if all(np.linalg.norm(top - tops[other]) > APART_M for other in kept):
                kept.append(i)
        large, tops = [large[i] for i in kept], np.array([tops[i] for i in kept]).reshape(-1, 3)
        tints = {i: (np.array(c) + 255) // 2 for i, c in zip(self._label_set.ids, self._label_set.colors, strict=True)}
        names = [thing.title for thing in large]
        colors = [tints[thing.class_id] for thing in large]  # brown would not be read on black
        self._log_names("world/graph/thing_names", tops, names, colors)
        places = np.array([free_place(room, tops) for room in graph.rooms]).reshape(-1, 3)
        self._log_names("world/graph/room_names", places, room_names(graph), ROOM_COLOR)
        left = [f"{thing.title}, gone at {(thing.gone_ns or 0) / 1e9:.1f} s" for thing in gone]
        self._log_boxes("gone", gone, colors=GONE_COLOR, labels=left, show_labels=True)

    def log_changes(self, changes: Sequence[ObjectChange]) -> None:
        """What has become of things since the map of before, in colours of their own; of what was moved an arrow."""
        colors = [CHANGE_COLORS[change.kind] for change in changes]
        names = [f"{c.object.class_name} {c.object.id}: {c.kind}" for c in changes]
        self._log_boxes("changes", [c.object for c in changes], colors=colors, labels=names, show_labels=True)
        ways = [(c.before.box.center, c.object.box.center) for c in changes if c.kind == "moved" and c.before]
        starts, ends = np.array(ways).reshape(-1, 2, 3).transpose(1, 0, 2)
        arrows = rr.Arrows3D(origins=starts, vectors=ends - starts, radii=DOT_RADIUS_M, colors=CHANGE_COLORS["moved"])
        self._stream.log("world/graph/moves", arrows)

    def _log_names(self, entity: str, xyz: Float64, names: Sequence[str], colors: Any) -> None:
        shown = rr.Points3D(xyz, radii=DOT_RADIUS_M, colors=colors, labels=names, show_labels=True)
        self._stream.log(entity, shown)

    def _log_boxes(self, name: str, things: Sequence[Instance | MapObject], **look: Any) -> None:
        boxes = [thing.box for thing in things]
        turns = [Rotation.from_matrix(box.R_world_box).as_quat() for box in boxes]
        self._stream.log(
            f"world/graph/{name}",
            rr.Boxes3D(
                centers=np.array([box.center for box in boxes]).reshape(-1, 3),
                sizes=np.array([box.size for box in boxes]).reshape(-1, 3),
                quaternions=np.array(turns).reshape(-1, 4),
                fill_mode="majorwireframe",
                **look,
            ),
        )

    def finish(self, points: MapPoints, graph: SceneGraph | None = None) -> None:
        """The finished map; ends the recording."""
        if graph is not None:
            self.log_graph(graph)
        self.log_map(points)
        self.close()

    def close(self) -> None:
        """End the recording once all of it is written or sent. Harmless when repeated.

        Raises LogError: not all of it could be.
        """
        try:
            self._stream.flush(timeout_sec=FLUSH_S)
        except RuntimeError as error:
            raise LogError(f"not all of the recording could be written or sent: {error}") from error
        finally:
            self._stream.disconnect()

    def _camera(self, camera: str) -> str:
        """Entity of a camera; a new one gets its place in the layout."""
        with self._lock:
            new = camera not in self._cameras
            if new:
                self._cameras.append(camera)
        if new:
            self._lay_out()
        return camera_path(camera)

    def _look_at(self, points: MapPoints, colourings: list[str]) -> None:
        """Set the view again where the map is the first one, has grown much, or has other colourings."""
        if not len(points.xyz):
            return
        extent = float(np.linalg.norm(np.ptp(np.percentile(points.xyz, (1, 99), axis=0), axis=0)))
        if self._colourings == colourings and extent <= REGROWN * self._extent_m:
            return
        poses = [T for path in list(self._paths.values()) for T in list(path.poses)]
        up = camera_up(np.stack(poses)) if self._up is None and poses else self._up
        self._eye = eye_on(points.xyz, up)
        self._colourings, self._extent_m = colourings, extent
        self._lay_out()

    def _lay_out(self) -> None:
        self._stream.send_blueprint(layout(self._cameras, self._colourings, self._eye))

    def set_time(self, stamp_ns: int, seq: int | None = None) -> None:
        """As of when is what this thread shows from now on; frames set it by themselves."""
        self._stream.set_time("capture", duration=np.timedelta64(stamp_ns, "ns"))
        if seq is not None:
            self._stream.set_time("frame", sequence=seq)


def is_large(thing: Instance) -> bool:
    """Whether it has its name on it: names of what is small, a splinter, or of no telling class would cover others."""
    return float(thing.box.size.max()) >= NAMED_M and thing.class_name != "otherprop"


def free_place(room: Room, names: Float64) -> Float64:
    """Where on its floor a room's own name is farthest from other ``names`` (N, 3): (3,) in the middle, or half way."""
    places = np.concatenate((room.center[None], (room.center + room.outline) / 2))
    return places[cdist(places, names).min(axis=1, initial=np.inf).argmax()]


def room_names(graph: SceneGraph) -> list[str]:
    """What to call each room, by the largest that stands in it: "room 1: chairs, table"."""
    names = list[str]()
    for room in graph.rooms:
        size, count = Counter[str](), Counter[str]()
        for thing in graph.things:
            telling = thing.class_name not in HUNG_NAMES and not thing.class_name.startswith("other")
            if telling and is_large(thing) and graph.room_of[thing.id] == room.id:
                size[thing.class_name] += len(thing.voxels)
                count[thing.class_name] += 1
        holds = [f"{name}s" if count[name] > 1 and name[-1] != "s" else name for name, _ in size.most_common(NAMED)]
        names.append(f"room {room.id}" + (f": {', '.join(holds)}" if holds else ""))
    return names


def moving_points(update: MapUpdate, k: CameraIntrinsics) -> rr.Points3D:
    """What moves, in the camera's axes; no points where nothing does."""
    if update.moving is None:
        return rr.Points3D(np.empty((0, 3), np.float32))
    v, u = (MOVING_STRIDE * i for i in np.nonzero(update.moving[::MOVING_STRIDE, ::MOVING_STRIDE]))
    z = update.depth_m[v, u]
    xyz = np.stack(((u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z), axis=1)
    return rr.Points3D(xyz[z > 0], radii=MOVING_RADIUS_M, colors=MOVING_COLOR)


def _as_logged(k: CameraIntrinsics) -> CameraIntrinsics:
    width = min(k.width, IMAGE_WIDTH)
    return scale_intrinsics(k, width, round(k.height * width / k.width))
