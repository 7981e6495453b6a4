"""Frames of other odometry sessions, brought into the map's world.

A camera that tracks itself begins its world where it starts. Its frames are held until several of them are found in the
map (``localization.relocalizer``), each by itself, and agree with each other and with the camera's own motion."""

from collections import Counter, deque
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from semantic_mapper.errors import PoseError
from semantic_mapper.geometry import check_pose, invert_pose, move
from semantic_mapper.localization.relocalizer import (
    NotFound,
    Relocalized,
    Relocalizer,
    Sighting,
    agreed,
    find_consensus,
    sighting,
)
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapping.map_types import CameraPose, CorrectedPoses
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.types import Float64, PosedFrame

REMEMBERED = 10  # frames that may
HELD = 30  # frames, at most; older ones are given up

_log = get_logger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class Taken:
    """What became of frames."""

    ready: tuple[PosedFrame, ...] = ()  # to be mapped, in the map's world, oldest first
    given_up: tuple[tuple[PosedFrame, str], ...] = ()  # frames that were held, with the reason why they are not mapped


class OdometrySessions:
    """Which odometry sessions are known in a map, and the search for those that are not.

    The map is that of ``pipeline``; classes of a frame have to agree with it, and its ``last_pose`` is kept. While the
    map is being corrected, no world is looked for. With ``own_first`` the first world is the map's own. ``known`` is
    T_map_world (4, 4) by world, ``found`` counts sessions, ``refused`` looks in vain by reason; ``reason`` says why the
    last frame was not found."""

    def __init__(self, pipeline: MappingPipeline, *, own_first: bool = True) -> None:
        self._pipeline = pipeline
        self._corrector = pipeline.corrector
        self._own_first = own_first
        self._held: deque[PosedFrame] = deque()
        self._sightings: dict[int, deque[Sighting]] = {}
        self.known: dict[int, Float64] = {}
        self.found = 0
        self.refused: Counter[str] = Counter()
        self.reason = ""

    @property
    def held(self) -> int:
        """Frames that wait."""
        return len(self._held)

    @property
    def warning(self) -> str:
        """While frames wait: why."""
        if not self._held:
            return ""
        return f"{len(self._held)} frames are held until their place in the map is known: {self.reason or 'looking'}"

    def where(self, world: int) -> Float64:
        """T_map_world (4, 4) of a known world, for frames that come now."""
        return move(self._corrector.motion(world), self.known[world])

    def in_map(self, poses: CorrectedPoses) -> CorrectedPoses:
        """Corrected poses, each in the world of its frame, in that of the map; as they are where it is not known."""
        world_by_frame = self._corrector.world_by_frame()
        by_stamp = {stamp_ns: world for (_, stamp_ns), world in world_by_frame.items()}
        moved: dict[Any, Float64] = {}
        for key, pose in poses.items():
            world = world_by_frame.get(key) if isinstance(key, tuple) else by_stamp.get(key)
            moved[key] = move(self.known[world], pose) if world in self.known else pose
        return moved

    def take(self, frame: PosedFrame) -> Taken:
        """Take the next frame. One whose pose is not valid goes on to where it is refused."""
        try:
            check_pose(frame.T_world_camera, "")
        except PoseError:
            return Taken(ready=(frame,))
        if self._own_first and not self.known:
            self.known[frame.world] = np.eye(4)
        if frame.world in self.known:
            return Taken(ready=(self._at(frame),))
        if not self._held:
            places = len(self._pipeline.voxel_map.places)
            _log.info("world_sought", camera=frame.camera_id, seq=frame.seq, places=places)
        self._held.append(frame)
        given_up = ((self._held.popleft(), self._why()),) if len(self._held) > HELD else ()
        if not self._look(frame):
            self._pipeline.last_pose = CameraPose(frame.camera_id, frame.stamp_ns, None, self.reason)
            return Taken(given_up=given_up)
        ready = [f for f in self._held if f.world in self.known]
        self._held = deque(f for f in self._held if f.world not in self.known)
        return Taken(tuple(self._at(f) for f in ready), given_up)

    def take_rest(self) -> Taken:
        """Give up what still waits."""
        given_up = tuple((frame, self._why()) for frame in self._held)
        self._held.clear()
        return Taken(given_up=given_up)

    def _why(self) -> str:
        return f"its place in the map is not known: {self.reason}"

    def _at(self, frame: PosedFrame) -> PosedFrame:
        """A frame of a known world."""
        pose = move(self.known[frame.world], frame.T_world_camera)
        self.reason = ""
        in_map = move(self._corrector.motion(frame.world), pose)
        self._pipeline.last_pose = CameraPose(frame.camera_id, frame.stamp_ns, in_map)
        return frame if pose is frame.T_world_camera else replace(frame, T_world_camera=pose)

    def _look(self, frame: PosedFrame) -> bool:
        """Look for a frame; True where its world has become known."""
        if self._corrector.status.running:
            self._sightings.clear()  # of the map as it was
            self.reason = "the map is being corrected"
            return False
        found = self._find(frame)
        if isinstance(found, NotFound):
            self.refused[found.reason] += 1
            self.reason = found.detail
            return False
        seen = self._sightings.setdefault(frame.world, deque(maxlen=REMEMBERED))
        seen.append(sighting(found.T_map_camera, frame.T_world_camera))
        consensus = find_consensus(seen)
        if consensus.refusal:
            self.refused["alone"] += 1
            self.reason = consensus.refusal
            return False
        agreeing = consensus.agreeing
        self.known[frame.world] = move(invert_pose(self._corrector.motion(frame.world)), agreed(agreeing))
        self.found += 1
        del self._sightings[frame.world]
        _log.info("world_found", camera=frame.camera_id, seq=frame.seq, agreeing=len(agreeing), held=len(self._held))
        return True

    def _find(self, frame: PosedFrame) -> Relocalized | NotFound:
        depth, voxel_map = None if frame.depth_sigma_m is not None else frame.depth_m, self._pipeline.voxel_map
        finder = Relocalizer(voxel_map.places.places, voxel_map, voxel_map.label_set.ignore_id)
        return finder.find(frame.rgb, depth, frame.intrinsics, lambda: self._pipeline.classify(frame))
