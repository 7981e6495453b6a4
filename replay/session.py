"""A mapping session: the pipeline plus the bookkeeping that every replay and every mapper node shares.

``MapSession.process`` takes a frame to ``MappingPipeline.step``, whether it comes from a socket or from a log, so that
both write the same map and the same summary. Verbs that write no map (`eval`, `autolabel`) step a ``Mapper``.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np

from semantic_mapper.errors import FrameError, LabelError, PoseError
from semantic_mapper.evaluation.metrics import ConfusionMatrix, ImageMeans, confusion_of
from semantic_mapper.fields.weights import WeightsFile
from semantic_mapper.imaging import is_measured
from semantic_mapper.labels import LabelSet
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.odometry_sessions import OdometrySessions, Taken
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.evaluate.truth import SurfaceTruth, TruthMapper
from semantic_mapper.transport.codec import decode_as, encode
from semantic_mapper.types import Float64, MapUpdate, PosedFrame

if TYPE_CHECKING:
    from semantic_mapper.mapping.pipeline import MappingPipeline
    from semantic_mapper.replay.rerun_log import RerunLog

_log = get_logger(__name__)

MOSTLY = 0.5  # of a frame that its weights know, or whose depth is too far; of the frames, for a warning
FAR_LIMIT = 0.85  # of ``depth.from_motion.far_m``: computed depth from here on fits the farthest plane best
EVERY = 4  # rows and columns of depth that are looked at
MAX_LISTED = 50  # refused frames, refused labels and damages: the first ones are reported in the summary
SNAPSHOTS = 8  # frames kept for the overview picture
BIN_GROWTH = 1.005  # each bin of a histogram of times is so much longer than the one before
SHORTEST_MS = 1e-3  # shorter times count as this

ItemT = TypeVar("ItemT")


@dataclass(frozen=True, slots=True)
class Refusal:
    """A frame that could not be used."""

    seq: int
    stamp_ns: int
    reason: str
    camera_id: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """A frame as the map has it and what became of it, packed: as they are, most of 5 MB."""

    T_world_camera: Float64  # (4, 4)
    packed: tuple[list[bytes], list[bytes]]

    @classmethod
    def of(cls, frame: PosedFrame, update: MapUpdate) -> Snapshot:
        """Pack both, without a loss but for the confidence, which is rounded to 1/255."""
        return cls(frame.T_world_camera, (encode(frame), encode(update)))

    def open(self) -> tuple[PosedFrame, MapUpdate]:
        """Both again."""
        frame, update = self.packed
        return decode_as(PosedFrame, frame), decode_as(MapUpdate, update)


class BoundedLog(Generic[ItemT]):
    """Counts all items, and keeps the first ones, at most ``MAX_LISTED``."""

    def __init__(self) -> None:
        self.first: list[ItemT] = []
        self.count = 0

    def __len__(self) -> int:
        """How many there were, kept or not."""
        return self.count

    def append(self, item: ItemT) -> None:
        """Count one more."""
        self.count += 1
        if len(self.first) < MAX_LISTED:
            self.first.append(item)


class LatencyHistogram:
    """Milliseconds of steps: the first one, and percentiles of the others, right to a quarter of a percent."""

    def __init__(self) -> None:
        self.first: float | None = None  # stands by itself: it may compile kernels, once on a machine
        self._counts = Counter[int]()  # by the logarithm of the time

    def add(self, ms: float) -> None:
        """Count one more step."""
        if self.first is None:
            self.first = ms
        else:
            self._counts[round(math.log(max(ms, SHORTEST_MS), BIN_GROWTH))] += 1

    def percentile(self, percent: float) -> float | None:
        """Of all steps but the first; of the first where it is the only one, None without any."""
        if not self._counts:
            return self.first
        bins = sorted(self._counts)
        count = np.cumsum([self._counts[number] for number in bins])
        return BIN_GROWTH ** bins[int(np.searchsorted(count, round(percent / 100 * (count[-1] - 1)), side="right"))]


class MapSession:
    """Feeds frames to the pipeline, keeps count, and scores against labels where the stream has them.

    ``stream_labels`` are the classes of the frames' label images; None where they have none. ``source`` names the log
    or stream in the summary. ``rerun`` gets every frame, what was rendered for it, and the map at the end.
    ``own_first`` (of ``OdometrySessions``) is False where the map was there before the stream.
    """

    def __init__(
        self,
        mapper: Mapper,
        *,
        stream_labels: LabelSet | None,
        source: str = "",
        rerun: RerunLog | None = None,
        own_first: bool = True,
    ) -> None:
        self.mapper = mapper
        self.pipeline = mapper.pipeline
        self.source = source
        self.odometry_sessions = OdometrySessions(self.pipeline, own_first=own_first)
        self.exclude_stamps = mapper.weights.train_stamps_ns
        self.published = self.fused = self.dropped = 0
        self.unreadable = 0  # refused by the player of a log; they never came here
        self.scored = self.excluded = 0
        self.pseudo_labelled = 0  # frames whose labels a field has rendered; they are no truth
        self.corrected_poses = 0  # given; the map has moved with them
        self.learned: dict[str, Any] | None = None  # what became of weights that were offered meanwhile
        self.unfinished_correction = ""  # what the map has not moved with, and why
        self.left_out = 0  # by the import that has made the log
        self.scale_from = ""  # what the metres of the stream come from, where that is found or assumed
        self.without_depth = 0  # their geometry was rendered, not measured
        self.outside = 0  # that weights of one scene know less than half of
        self._known, self._mapped = 0.0, 0  # fractions of frames that they know, in sum; frames
        self.computed_depth = 0  # their geometry was computed from the pictures
        self.too_little_motion = 0  # of these, those whose camera had not moved enough to compute any
        self.with_depth = 0  # measured or computed at some pixel
        self.too_far = 0  # most of it beyond ``_range_m``
        # Frames that were not mapped, those that were but whose label image cannot be used, and stretches of a log in
        # which no frame can be made out:
        self.refusals, self.label_refusals = BoundedLog[Refusal](), BoundedLog[Refusal]()
        self.damages = BoundedLog[str]()
        self.step_ms = LatencyHistogram()
        self.stage_ms: dict[str, LatencyHistogram] = {}
        self.confusion = ConfusionMatrix(self.pipeline.label_set)
        self.per_image = ImageMeans()
        self.truth = None if stream_labels is None else TruthMapper(stream_labels, self.pipeline.label_set)
        self.surface_truth = SurfaceTruth(self.pipeline.label_set)
        self.snapshots: list[Snapshot] = []
        self._snapshot_stride = 1
        self.rerun = rerun
        if rerun is not None:
            rerun.note_scale(self.pipeline.voxel_map.scale_known)

    def process(self, frame: PosedFrame) -> list[MapUpdate | Refusal]:
        """Take one frame and map what is ready: the frame itself, unless its depth waits for later ones, or its world
        has to be found in the map first (``odometry_sessions``).
        Returns what became of each: the update, or why it was refused (counted and logged, the map unchanged)."""
        self.published += 1
        taken = self.odometry_sessions.take(frame)
        done = self._give_up(taken)
        for item in taken.ready:
            began = time.perf_counter()
            try:
                ready = self.pipeline.prepare(item)
            except FrameError as error:
                done.append(self._refuse(item, error))
                continue
            depth_ms = (time.perf_counter() - began) * 1e3
            done += [self._map(prepared, depth_ms / len(ready)) for prepared in ready]
        return done

    def process_rest(self) -> list[MapUpdate | Refusal]:
        """Map the frames that still wait for later ones, which do not come any more."""
        left = self._give_up(self.odometry_sessions.take_rest())
        return [*left, *(self._map(item, 0.0) for item in self.pipeline.prepare_rest())]

    def _give_up(self, taken: Taken) -> list[MapUpdate | Refusal]:
        return [self._refuse(frame, PoseError(reason)) for frame, reason in taken.given_up]

    def _refuse(self, frame: PosedFrame, error: FrameError) -> Refusal:
        self.refusals.append(refusal := Refusal(frame.seq, frame.stamp_ns, str(error), frame.camera_id))
        _log.error("frame_refused", seq=frame.seq, camera=frame.camera_id, reason=str(error))
        return refusal

    def _map(self, frame: PosedFrame, depth_ms: float) -> MapUpdate | Refusal:
        began = time.perf_counter()
        try:
            update = self.pipeline.step(frame)
        except FrameError as error:
            return self._refuse(frame, error)
        self.step_ms.add((time.perf_counter() - began) * 1e3 + depth_ms)
        if frame.depth_sigma_m is not None:
            update.stage_ms["depth"] = depth_ms
        for name, value in update.stage_ms.items():
            self.stage_ms.setdefault(name, LatencyHistogram()).add(value)
        self.fused += int(update.fused)
        if frame.depth_m is None:
            if not self.without_depth:
                _log.warning("geometry_is_rendered", seq=frame.seq, reason="the frame has no depth")
            self.without_depth += 1
        elif frame.depth_sigma_m is not None:
            if not self.computed_depth:
                _log.warning("depth_is_computed", seq=frame.seq, reason="the frame has no sensor depth")
            self.computed_depth += 1
            self.too_little_motion += not frame.depth_m.any()
        if self.without_depth + self.computed_depth == 1 and not is_measured(frame) and self.moving_warning:
            _log.warning("moving_classes_stay", seq=frame.seq, camera=frame.camera_id, reason=self.moving_warning)
        self._note_range(frame)
        # How much weights of one scene know of it: weights of another scene cannot be recognised otherwise.
        known = float(np.mean(update.label != self.pipeline.label_set.ignore_id))
        self._known, self._mapped = self._known + known, self._mapped + 1
        self.outside += known < MOSTLY
        frame = self.pipeline.corrector.place(frame)  # where the map has it
        scored = self._score(frame, update)
        if self.fused % self._snapshot_stride == 0:  # a bounded, evenly spread sample of the session
            self.snapshots.append(Snapshot.of(scored, update))
        if len(self.snapshots) > SNAPSHOTS:
            self.snapshots = self.snapshots[::2]
            self._snapshot_stride *= 2
        if self.rerun is not None:
            self.rerun.log_step(frame, update)
        return replace(update, world=frame.world, T_map_world=self.odometry_sessions.where(frame.world))

    def _note_range(self, frame: PosedFrame) -> None:
        if frame.depth_m is None or not len(known := (depth := frame.depth_m[::EVERY, ::EVERY])[depth > 0]):
            return
        self.with_depth += 1
        self.too_far += float(np.mean(known > self._range_m)) > MOSTLY

    @property
    def range_warning(self) -> str:
        """What is wrong with depth that is too far in most frames, and how to fix it; empty where it is not."""
        if self.too_far <= MOSTLY * self.with_depth:
            return ""
        frames = f"in {self.too_far} of {counted(self.with_depth, 'frame')} most of the"
        if self.computed_depth:
            return (
                f"{frames} computed depth is beyond {self._range_m:g} m, where the range (voxel_map.depth_max_m, "
                "depth.from_motion.far_m) ends: the camera hardly moved sideways (walk past things while filming), the "
                "poses have too large a scale (give the right one at the import), or the scene is large (raise both)"
            )
        return (
            f"{frames} depth is beyond the range of the map (voxel_map.depth_max_m = {self._range_m:g} m) and not "
            "mapped: check the unit of depth (depth_scale), or raise the range"
        )

    @property
    def _range_m(self) -> float:
        """Depth beyond is not mapped, or is at the limit of what can be computed."""
        config = self.pipeline.config
        computed = FAR_LIMIT * config.depth.from_motion.far_m if self.computed_depth else math.inf
        return min(computed, config.voxel_map.depth_max_m)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is wrong with frames: depth out of range, pictures unlike those that the weights learned from, no
        measured depth for ``moving.classes``."""
        check = self.pipeline.domain_check
        return self.range_warning, "" if check is None else check.warning, self.moving_warning

    @property
    def moving_warning(self) -> str:
        """Why what moves by its class may be in the map all the same; empty where ``moving.classes`` works."""
        unmeasured = self.without_depth + self.computed_depth
        if not (unmeasured and self.pipeline.config.moving.classes):
            return ""
        return (
            f"moving.classes left nothing out of {counted(unmeasured, 'frame')} whose depth no sensor measured: what "
            "moves there may be in the map; use a depth sensor, or film while nothing moves"
        )

    def follow_weights(self, weights: WeightsFile, path: Path) -> None:
        """Take note of other weights in the pipeline; from now on, no frame that they were fitted to is scored."""
        self.mapper = replace(self.mapper, weights=weights, weights_path=path)
        self.exclude_stamps |= weights.train_stamps_ns

    def follow_correction(self) -> None:
        """Take what the scores compare with to the poses that the map has after a correction."""
        self.corrected_poses = self.pipeline.corrector.status.poses
        self.surface_truth.move(self.pipeline.corrector.poses())

    def refuse(self, seq: int, stamp_ns: int, reason: str) -> None:
        """Count a frame that was damaged before it could be processed."""
        self.published += 1
        self.refusals.append(Refusal(seq, stamp_ns, reason))
        _log.error("frame_refused", seq=seq, reason=reason)

    def refuse_unreadable(self, count: int, reasons: Sequence[str]) -> None:
        """Count frames that a player could not read and has not sent; reasons are those of the first few."""
        for reason in reasons[:count]:
            self.refusals.append(Refusal(0, 0, reason))
        self.refusals.count += max(0, count - len(reasons))
        self.published += count
        self.unreadable += count

    @property
    def received(self) -> int:
        """Frames that came here, or were dropped on the way."""
        return self.published - self.unreadable

    def note_damage(self, reason: str) -> None:
        """Keep word of a damaged stretch of a log; nobody knows how many frames it held."""
        self.damages.append(reason)
        _log.error("log_damaged", reason=reason)

    def count_dropped(self, count: int) -> None:
        """Count frames that were published but never reached this session."""
        self.published += count
        self.dropped += count

    def more_summary(self) -> dict[str, Any]:
        """What only some summaries say: of weights of one scene, of odometry sessions found in the map."""
        sessions, found = self.odometry_sessions, dict[str, Any]()
        mapped = self._mapped
        if self.pipeline.field.holds_scene and self.mapper.model.knows_classes and mapped:
            found["scene"] = {"known": round(self._known / mapped, 4), "frames_outside": self.outside}
            if self.outside > MOSTLY * mapped:
                reason = "the weights know less than half of these frames: made for another scene or world frame"
                _log.warning("scene_unknown", frames=self.outside, of=mapped, reason=reason)
        if sessions.found or sessions.refused:
            found["relocalization"] = {"sessions_found": sessions.found, "looks_refused": dict(sessions.refused)}
        return found

    def _score(self, frame: PosedFrame, update: MapUpdate) -> PosedFrame:
        """Score a frame against its label; returns it without a label that is no truth, or cannot be read."""
        if self.truth is None or frame.label is None:
            return replace(frame, label=None)
        if frame.label_is_pseudo:
            self.pseudo_labelled += 1
            return replace(frame, label=None, label_is_pseudo=False)
        try:
            truth = self.truth.to_map_ids(frame.label, f"frame seq={frame.seq}")
        except LabelError as error:
            _log.error("label_refused", seq=frame.seq, reason=str(error))
            self.label_refusals.append(Refusal(frame.seq, frame.stamp_ns, f"mapped, but not scored: {error}"))
            return replace(frame, label=None)
        if frame.stamp_ns in self.exclude_stamps:
            self.excluded += 1
            return frame
        self.scored += 1
        image = confusion_of(truth, update.label, self.pipeline.label_set, f"frame seq={frame.seq}")
        self.confusion += image
        self.per_image.add(image)
        self.surface_truth.add(replace(frame, label=truth))
        return frame


def open_recording(path: Path | None, pipeline: MappingPipeline) -> RerunLog | None:
    """A Rerun recording (.rrd) of a session with this pipeline; None where no path is given."""
    if path is None:
        return None
    # It loads for over a second, and few sessions need it.
    from semantic_mapper.replay.rerun_log import RerunLog, recording_file

    return RerunLog(recording_file(path), pipeline.label_set, pipeline.voxel_map.config.voxel_size_m)
