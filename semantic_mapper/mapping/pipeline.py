"""The whole main job in one class: a posed frame in, a better map out.

Replay and the mapper node call this very ``step``.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, ParamSpec, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.config import MapperConfig, with_quality
from semantic_mapper.errors import FrameError, WeightsError
from semantic_mapper.fields.base import Encoded, StreamField, WorkingView, check_classes
from semantic_mapper.fields.domain_check import DomainCheck
from semantic_mapper.fields.render import View
from semantic_mapper.geometry import check_pose, scale_intrinsics
from semantic_mapper.imaging import (
    FrameViews,
    depth_prior,
    fill_holes,
    is_measured,
    resize_label,
    resize_spread,
    working_intrinsics,
)
from semantic_mapper.labels import LabelSet
from semantic_mapper.localization.features import find_place_features
from semantic_mapper.localization.places import MAX_FEATURES, Place, make_place
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapping.correction import MapCorrector
from semantic_mapper.mapping.frame_depth import FrameDepth, computed_trust, rendered_trust
from semantic_mapper.mapping.keyframes import Keyframe, KeyframeStore
from semantic_mapper.mapping.map_types import CameraPose
from semantic_mapper.mapping.moving import MovingFilter
from semantic_mapper.mapping.pose_check import PoseCheck
from semantic_mapper.mapping.rendering import RenderedView, ViewRenderer, add_own_image, likeliest, upsample
from semantic_mapper.mapping.segmenter import Opinion, Segmenter
from semantic_mapper.mapping.virtual_views import ViewpointChooser, VirtualView, add_votes
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import Bool, CameraIntrinsics, Float32, Int32, MapUpdate, PosedFrame, UInt8

_log = get_logger(__name__)
_aside = ThreadPoolExecutor(1, "aside")  # for a stage that needs one core, while others need both now and then

MAX_CAMERAS = 64  # as in a stream's information; something is kept of each
VIRTUAL_SIZE = 2  # times the size of a coarse view: how finely the map is looked at in a virtual one
SURE = 0.8  # confidence from which on the map is believed where another field is compared with it
OWN_WITH_LABELS = 0.25  # of the own image's weight is left where a frame is rendered from labelled views, too
OWN_BETWEEN_RAYS = 0.5  # of it counts in the rendered view between rays, where none is labelled
RAYS_WITHOUT_LABELS = 0.7  # of ``render.ray_fraction`` are rendered then
RECALL_STEP = 2  # pixels of the rendered view: how finely the map is looked at where a frame has no depth
COVERAGE_WIDTH = 80  # width of the depth image that a keyframe keeps for the choice of source views

P = ParamSpec("P")
T = TypeVar("T")
S = TypeVar("S", np.uint8, np.float32)


class _FullSize(NamedTuple):
    views: FrameViews
    depth_m: Float32
    rows: Int32
    trust: Float32 | None
    moving: Bool | None = None


class MappingPipeline:
    """Keyframes, view choice, rendering and fusion behind one ``step``.

    Deterministic: same frames, config, field and thread count give the same map, bit for bit. ``anchors`` are labelled
    keyframes that the field was finetuned on: source views from the first frame on. ``corrector`` moves the map with
    corrected poses, ``frame_depth`` gives frames their depth, ``picture_check`` says what was wrong with pictures,
    ``domain_check`` whether the weights know such pictures, ``last_pose`` where the last frame was (None before the
    first), for any thread.
    ``WeightsError``: the field renders other classes than the map holds."""

    def __init__(
        self, config: MapperConfig, field: StreamField[Any], label_set: LabelSet, *, anchors: Sequence[PosedFrame] = ()
    ) -> None:
        check_classes(field, label_set)
        self.config = config = with_quality(config)
        self.field = field
        self.label_set = label_set
        self.voxel_map = VoxelMap(config.voxel_map, label_set)
        self.keyframes = KeyframeStore(config.keyframes)
        self.frame_depth = FrameDepth(config.depth, self._cast_for_hint)
        self.picture_check = self.frame_depth.pictures
        self.domain_check: DomainCheck | None = None  # where it is known what the weights learned from
        self.pose_check = PoseCheck(config.voxel_map.depth_max_m)
        self._segmenter = Segmenter(config.segmenter, label_set) if config.segmenter.table else None
        self.moving = MovingFilter(config, label_set, sees_moving=self._segmenter is not None and self._segmenter.moves)
        self.last_pose: CameraPose | None = None
        self._viewpoints = ViewpointChooser(config.seed)
        self._renderer = ViewRenderer(field, config.render, config.sampling)
        self.corrector = MapCorrector(
            config.history, self.voxel_map, self.keyframes, self._fuse_again, self._follow_correction
        )
        self._steps = 0
        self._intrinsics: dict[str, CameraIntrinsics] = {}  # by camera
        self._stage_ms: dict[str, float] = {}
        for anchor in anchors:
            self.keyframes.add(self.encode_anchor(anchor))

    def step(self, frame: PosedFrame) -> MapUpdate:
        """Render the semantics of one frame, fuse it, and maybe keep it as a source view.

        ``FrameError`` or ``PoseError``: the frame cannot be used; the map is unchanged and the next frame is welcome.
        ``ConfigError``: ``depth.from_motion.delay_frames`` is not 0, and the frame does not come from ``prepare``."""
        frame = self.frame_depth.give(frame)
        with self.corrector.lock:
            self.corrector.make_room()
            views = FrameViews(self._checked(self.corrector.place(frame)))
            self._stage_ms = {}
            self.pose_check.look(views.frame)
            finding = _aside.submit(self.moving.find, views.frame)
            try:
                current = self._timed("encode", self._encode, views)
                if self.domain_check is not None:
                    self.domain_check.note()
                sources = self._timed("choose", self._choose_sources, views, current, self.keyframes)
                opinion = self._timed("segment", self._look, views) if self._segmenter else None
                view, votes = self._timed("render", self._render_semantics, views, sources, current, opinion)
            finally:
                moving = self._timed("motion", finding.result)
            # From here on without what moves (``full.views``): it is published, but neither fused nor kept.
            full = self._timed("upsample", self._upsample_still, views, votes, moving, opinion)
            touched = self._timed("fuse", self._fuse, self.voxel_map, full, votes)
            if self.corrector.records:
                self._timed("history", self.corrector.record, full.views.frame, votes)
            is_keyframe = self._timed("keyframe", self._keep_view, full.views, current, sources)
            shown = self._timed("recall", self._recall, view, full)
            self._finish_step(views.frame)
            return self._update(views.frame, view, shown, full, sources, is_keyframe, touched)

    def prepare(self, frame: PosedFrame) -> list[PosedFrame]:
        """Give a frame the depth that ``config.depth`` asks for; what is ready for ``step``, oldest first: one frame
        each, unless ``depth.from_motion.delay_frames`` lets frames wait.

        ``FrameError``: its picture cannot be mapped, dark or blurred. ``PoseError``: no rigid transform."""
        return self.frame_depth.push(frame)

    def prepare_rest(self) -> list[PosedFrame]:
        """The frames that still wait in ``prepare``, oldest first."""
        return self.frame_depth.finish()

    def render_virtual_view(self) -> VirtualView | None:
        """Render the map from where no camera stood, the view of most gain, fuse what it says of classes, and return
        it; None where no view is worth the time, about that of a frame.

        Nothing is measured: TSDF, colours and ``frames`` stay as they are. Deterministic, as part of the sequence of
        steps. A correction of poses rebuilds the map without these votes, and all may be looked at again."""
        with self.corrector.lock:
            known = [k for k in self.keyframes.keyframes if k.camera_id in self._intrinsics]
            if not known:
                return None
            newest = known[-1]
            intrinsics = self._intrinsics[newest.camera_id]
            fitting = [k for k in self.keyframes.keyframes if k.encoded.size == newest.encoded.size]
            view = self._viewpoints.choose(self.voxel_map, fitting, intrinsics)
            if view is not None:
                self._fuse_virtual_view(view, newest, intrinsics)
            return view

    def encode_anchor(self, anchor: PosedFrame) -> Keyframe:
        """A labelled keyframe that a field was finetuned on, as ``exchange_field`` takes it."""
        views, channel = FrameViews(anchor), None
        if anchor.label is not None:
            width = self.config.render.encode_width or anchor.intrinsics.width
            label = resize_label(anchor.label, working_intrinsics(anchor.intrinsics, width))
            channel = self.label_set.to_channels(label, f"anchor seq={anchor.seq}")
        return self._make_keyframe(views, self._encode(views, channel), labelled=True)

    def exchange_field(self, field: StreamField[Any], anchors: Sequence[Keyframe]) -> None:
        """Go on with other weights, which encode as the present ones do, and the anchors of ``encode_anchor`` in place
        of those before; what is in the map stays. ``WeightsError``: it renders other classes; nothing has changed."""
        check_classes(field, self.label_set)
        self.field = self._renderer.field = field
        self.domain_check = None  # they were fitted to this place
        self.keyframes.exchange_labelled(anchors)

    def release(self) -> None:
        """Forget keyframes and what encodes them, where no frame is to come: some 60 MB."""
        self.keyframes.clear()
        self.field.release()

    def agreement(self, frame: PosedFrame, renderer: ViewRenderer, keyframes: KeyframeStore) -> tuple[int, int]:
        """Pixels of a mapped frame that another field, rendering from ``keyframes``, names as the map does, and pixels
        compared: those that the map is sure of. Changes nothing; the field encodes as the present one does."""
        frame = self.corrector.place(frame)
        views = FrameViews(frame)
        current = self._encode(views)
        sources = self._with_own(self._choose_sources(views, current, keyframes), current)
        view = self._render(views, sources, self.config.render.scale, renderer)
        low = scale_intrinsics(frame.intrinsics, view.known.shape[1], view.known.shape[0])
        seen = self.voxel_map.ray_cast(frame.T_world_camera, low)
        sure = view.known & (seen.confidence >= SURE) & (seen.label != self.label_set.ignore_id)
        same = self.label_set.to_ids(view.probabilities.argmax(axis=2)) == seen.label
        return int((same & sure).sum()), int(sure.sum())

    def classify(self, frame: PosedFrame) -> UInt8:
        """Class ids (h, w) of a frame as it shows them by itself, wherever it was taken; coarse. Changes nothing."""
        views = FrameViews(frame)
        view = self._render(views, [self._encode(views)], self.config.render.scale, self._renderer)
        label = self.label_set.to_ids(view.probabilities.argmax(axis=2))
        return np.where(view.known, label, np.uint8(self.label_set.ignore_id)).astype(np.uint8)

    # The stages of a step.

    def _timed(self, name: str, stage: Callable[P, T], *args: P.args, **named: P.kwargs) -> T:
        start = time.perf_counter()
        result = stage(*args, **named)
        self._stage_ms[name] = (time.perf_counter() - start) * 1e3
        return result

    def _checked(self, frame: PosedFrame) -> PosedFrame:
        where = f"frame seq={frame.seq} of camera '{frame.camera_id}'"
        check_pose(frame.T_world_camera, where)
        if frame.camera_id not in self._intrinsics and len(self._intrinsics) >= MAX_CAMERAS:
            raise FrameError(
                f"{where}: a map takes {MAX_CAMERAS} cameras; give frames of one camera the same camera_id"
            )
        size, scale = (frame.intrinsics.width, frame.intrinsics.height), self.config.render.scale
        if round(min(size) * scale) < 1:
            raise FrameError(
                f"{where}: {size[0]}x{size[1]} pixels at render.scale {scale:g} leave no ray; raise either"
            )
        return frame

    def _encode(self, resized: FrameViews, channel: NDArray[np.integer] | None = None) -> Encoded:
        """Encode one frame at working width; ``channel`` (h, w) are labels of a keyframe that the field was
        finetuned on."""
        frame = resized.frame
        intrinsics = working_intrinsics(frame.intrinsics, self.config.render.encode_width or frame.intrinsics.width)
        spread = resize_spread(frame, intrinsics)  # a field that has not learned from computed depth leaves it out
        images = resized.rgb(intrinsics), resized.depth(intrinsics)
        return self.field.encode(WorkingView(*images, intrinsics, frame.T_world_camera, channel, spread))

    def _choose_sources(self, views: FrameViews, current: Encoded, keyframes: KeyframeStore) -> list[Keyframe]:
        """Keyframes to render a frame from, of its size: cameras of another shape have feature maps of another size."""
        intrinsics = working_intrinsics(views.frame.intrinsics, COVERAGE_WIDTH)
        count = self.config.keyframes.source_views - int(self.config.keyframes.use_current_view)
        chosen = keyframes.choose(views.frame.T_world_camera, intrinsics, views.depth(intrinsics), count, current.size)
        if not chosen and self.field.holds_scene:  # what it says does not depend on the views
            chosen = [k for k in keyframes.keyframes if k.encoded.size == current.size][-1:]
        return chosen

    def _with_own(self, sources: Sequence[Keyframe], current: Encoded) -> list[Encoded]:
        """Source views as they are rendered from, the frame itself among them where the settings say so."""
        return [*(k.encoded for k in sources), *([current] if self.config.keyframes.use_current_view else [])]

    def _look(self, views: FrameViews) -> Opinion:
        """What the segmenter says of a frame, at the pixels (h, w) that are rendered."""
        assert self._segmenter is not None
        k, scale = views.frame.intrinsics, self.config.render.scale
        return self._segmenter.look(views, scale_intrinsics(k, round(k.width * scale), round(k.height * scale)))

    def _render_semantics(
        self, views: FrameViews, sources: Sequence[Keyframe], current: Encoded, opinion: Opinion | None
    ) -> tuple[RenderedView, RenderedView]:
        """The coarse view (h, w) as it is rendered, joined with what the frame's image says by itself between rays; and
        joined with it everywhere. Both joined with the segmenter's opinion where there is one, whose weight does not
        depend on that of the image."""
        keyframes = self.config.keyframes
        weight = keyframes.own_image_weight if keyframes.use_current_view else 0.0
        own = self.field.source_logits(current) if weight else None
        labelled = any(k.labelled for k in sources)
        share = RAYS_WITHOUT_LABELS if own is not None and not labelled else 1.0
        rendered_from = self._with_own(sources, current)
        view = votes = self._render(views, rendered_from, self.config.render.scale, self._renderer, share)
        if own is not None:
            votes = add_own_image(view, own, weight * (OWN_WITH_LABELS if labelled else 1.0))
            if not labelled and view.traced is not None:
                view = add_own_image(view, own, weight * OWN_BETWEEN_RAYS, ~view.traced)
        return (view, votes) if opinion is None else (opinion.join(view), opinion.join(votes))

    def _render(
        self, views: FrameViews, sources: list[Encoded], scale: float, renderer: ViewRenderer, share: float = 1.0
    ) -> RenderedView:
        """The view (h, w), ``scale`` times the size of the frame, with a ``share`` of the rays that it may have."""
        frame = views.frame
        width, height = round(frame.intrinsics.width * scale), round(frame.intrinsics.height * scale)
        if not sources:
            empty = np.zeros((height, width), np.float32)
            return RenderedView(np.zeros((height, width, len(self.label_set)), np.float32), empty > 0, empty)
        intrinsics = scale_intrinsics(frame.intrinsics, width, height)
        prior = self._depth_prior(views, intrinsics)
        view = View(
            renderer.field,
            self.field.stack(sources),
            intrinsics,
            frame.T_world_camera,
            prior,
            self.config.sampling,
            measured=(views.depth(intrinsics) > 0) & (prior > 0) if frame.depth_m is not None else None,
            stamp_ns=frame.stamp_ns,
        )
        computed = frame.depth_sigma_m is not None
        return renderer.render(view, views.rgb(intrinsics), computed=computed, share=share)

    def _depth_prior(self, views: FrameViews, intrinsics: CameraIntrinsics) -> Float32:
        """Where the surface is expected: the sensor's depth (``depth_prior``), else the map's own ray cast; nowhere,
        without a sensor, for a field that holds the scene."""
        frame, depth = views.frame, views.depth(intrinsics)
        if self.field.holds_scene and not is_measured(frame):
            return np.zeros_like(depth)
        if frame.depth_m is not None:
            return depth_prior(depth, views.rgb(intrinsics))
        if self.voxel_map.block_count == 0:
            return depth
        return fill_holes(self.voxel_map.ray_cast(frame.T_world_camera, intrinsics).depth_m)

    def _upsample_still(
        self, views: FrameViews, votes: RenderedView, moving: Bool | None, opinion: Opinion | None
    ) -> _FullSize:
        """The view at full size, without what moves by depth or by class."""
        if moving is None:
            return self._upsample(views, votes, self.voxel_map)
        full = self._upsample(self.moving.leave_out(views, moving), votes, self.voxel_map)
        if self.moving.uses_classes:
            ids = self.label_set.to_ids(likeliest(votes.probabilities)[0])
            label = self._at_rows(ids, full.rows, self.label_set.ignore_id)
            by_class = self.moving.of_classes(label)
            if opinion is not None:
                by_class |= np.append(opinion.moving, False)[full.rows]
            if (by_class & ~moving).any():
                moving = moving | by_class
                full = self._upsample(self.moving.leave_out(views, moving), votes, self.voxel_map)
        self.moving.note(views.frame, moving)
        return full._replace(moving=moving)

    def _upsample(self, views: FrameViews, view: RenderedView, voxel_map: VoxelMap) -> _FullSize:
        frame = views.frame
        size = (frame.intrinsics.width, frame.intrinsics.height)
        low = scale_intrinsics(frame.intrinsics, view.known.shape[1], view.known.shape[0])
        if frame.depth_m is None:
            map_depth = voxel_map.ray_cast(frame.T_world_camera, low).depth_m
            low_trust = rendered_trust(view.depth_m, map_depth, voxel_map.truncation_m)
            trust = np.asarray(cv2.resize(low_trust, size, interpolation=cv2.INTER_NEAREST), np.float32)
            depth = np.asarray(cv2.resize(view.depth_m, size, interpolation=cv2.INTER_LINEAR), np.float32)
        else:
            depth, sigma_m = views.depth(frame.intrinsics), frame.depth_sigma_m
            trust = None if sigma_m is None else computed_trust(depth, sigma_m)
        rows = upsample(view.probabilities, view.known, views.rgb(low), views.depth(low), frame.rgb, depth)
        return _FullSize(views, depth, rows, trust)

    def _fuse(self, voxel_map: VoxelMap, full: _FullSize, votes: RenderedView) -> int:
        """Integrate a frame into a map; blocks touched."""
        frame, table = full.views.frame, votes.probabilities.reshape(-1, len(self.label_set))
        measured = is_measured(frame)
        return voxel_map.integrate(frame, full.depth_m, table, rows=full.rows, trust=full.trust, measured=measured)

    def _fuse_again(self, voxel_map: VoxelMap, frame: PosedFrame, view: RenderedView) -> None:
        self._fuse(voxel_map, self._upsample(FrameViews(frame), view, voxel_map), view)

    def _follow_correction(self) -> None:
        """Drop or move what is known of frames by their poses, as a correction begins and as the map has moved."""
        self.moving.clear()
        if self._segmenter is not None:
            self._segmenter.clear()
        if self.corrector.status.running:
            return
        self.pose_check.compare_again(self.keyframes.keyframes)
        if (last := self.last_pose) is not None:
            moved = self.corrector.poses().get((last.camera_id, last.stamp_ns), last.T_map_camera)
            self.last_pose = replace(last, T_map_camera=moved)

    def _keep_view(self, views: FrameViews, current: Encoded, sources: Sequence[Keyframe]) -> bool:
        """Keep a frame as a source view (whether it became one), and as a place, where it shows something new."""
        frame = views.frame
        is_keyframe = self.keyframes.wants(frame.T_world_camera, current.size)
        if is_keyframe:
            keyframe = self._make_keyframe(views, current)
            if is_measured(frame):  # computed depth follows from the poses and cannot contradict them
                self.pose_check.add(keyframe, sources, self.keyframes.keyframes)
            self.keyframes.add(keyframe)
        places, pose = self.voxel_map.places, frame.T_world_camera
        if self.config.keyframes.save_places and is_measured(frame) and places.wants(pose):
            assert frame.depth_m is not None
            kept = replace(frame, rgb=frame.rgb.copy(), depth_m=frame.depth_m.copy(), T_world_camera=pose.copy())
            # Of a copy: the caller may use its arrays again.
            places.add_soon(kept.T_world_camera, partial(_place_of, kept))
        return is_keyframe

    def _make_keyframe(self, views: FrameViews, encoded: Encoded, *, labelled: bool = False) -> Keyframe:
        frame = views.frame
        intrinsics = working_intrinsics(frame.intrinsics, COVERAGE_WIDTH)
        depth = views.depth(intrinsics)
        return Keyframe(
            frame.seq, frame.stamp_ns, frame.T_world_camera, intrinsics, depth, encoded, labelled, frame.camera_id
        )

    def _finish_step(self, frame: PosedFrame) -> None:
        """Take note of a frame that is in the map, and render virtual views where they are due."""
        self._intrinsics[frame.camera_id] = frame.intrinsics
        spent = self._stage_ms
        self._renderer.note(spent["render"], sum(spent.values()) - spent["render"])
        self._steps += 1
        every = self.config.virtual.every_n_frames
        if every and self._steps % every == 0:
            try:
                self._timed("virtual", self.render_virtual_view)
            except FrameError as error:  # the frame itself is in the map
                _log.warning("virtual_view_refused", seq=frame.seq, reason=str(error))

    def _update(
        self,
        frame: PosedFrame,
        view: RenderedView,
        shown: tuple[UInt8, Float32],
        full: _FullSize,
        sources: Sequence[Keyframe],
        is_keyframe: bool,
        touched: int,
    ) -> MapUpdate:
        depth_m = full.depth_m
        if full.moving is not None and frame.depth_m is not None:
            depth_m = np.where(full.moving, frame.depth_m, depth_m)
        return MapUpdate(
            stamp_ns=frame.stamp_ns,
            seq=frame.seq,
            camera_id=frame.camera_id,
            fused=touched > 0,
            is_keyframe=is_keyframe,
            source_seqs=tuple(k.seq for k in sources),
            label=self._at_rows(shown[0], full.rows, self.label_set.ignore_id),
            confidence=self._at_rows(shown[1], full.rows),
            depth_m=depth_m,
            blocks=self.voxel_map.block_count,
            blocks_touched=touched,
            rays=view.rays,
            samples=view.samples,
            stage_ms=self._stage_ms,
            moving=full.moving,
        )

    def _recall(self, view: RenderedView, full: _FullSize) -> tuple[UInt8, Float32]:
        """Class ids and confidence (h, w) of a rendered view; the map's where the frame has no depth and the map is
        surer: there the field guesses where the surface is, and the map has seen it. Not on what moves."""
        channel, most = likeliest(view.probabilities)
        label, frame = self.label_set.to_ids(channel), full.views.frame
        if frame.depth_m is None or self.voxel_map.block_count == 0:
            return label, most
        size = label.shape[::-1]
        hole = view.known & (full.views.depth(scale_intrinsics(frame.intrinsics, *size)) == 0)
        if full.moving is not None:
            hole &= ~cv2.resize(full.moving.view(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(np.bool_)
        coarse = scale_intrinsics(frame.intrinsics, *(max(1, side // RECALL_STEP) for side in size))
        wanted = cv2.resize(hole.view(np.uint8), (coarse.width, coarse.height), interpolation=cv2.INTER_AREA) > 0
        cast = self.voxel_map.ray_cast(frame.T_world_camera, coarse, wanted)
        found = np.asarray(cv2.resize(cast.label, size, interpolation=cv2.INTER_NEAREST), np.uint8)
        sure = np.asarray(cv2.resize(cast.confidence, size, interpolation=cv2.INTER_NEAREST), np.float32)
        hole &= (found != self.label_set.ignore_id) & (sure > most)
        label[hole] = found[hole]
        # The map counts frames that say the same for the same reason as independent ones, so it is too sure.
        most[hole] = (sure[hole] + view.probabilities[hole, self.label_set.to_channels(found[hole])]) / 2
        return label, most

    def _at_rows(self, values: NDArray[S], rows: Int32, unknown: float = 0) -> NDArray[S]:
        """What the pixels (H, W) take from a rendered view (h, w); row -1 is ``unknown``."""
        return np.append(values.ravel(), np.array(unknown, values.dtype)).take(
            rows, mode="wrap"
        )  # twice as fast as by index

    # Besides the stages.

    def _cast_for_hint(self, frame: PosedFrame, intrinsics: CameraIntrinsics) -> tuple[Float32, Bool]:
        """Depth of the map as a frame sees it, and whether it was measured (h, w)."""
        if self.voxel_map.block_count == 0:
            empty = np.zeros((intrinsics.height, intrinsics.width), np.float32)
            return empty, empty > 0
        view = self.voxel_map.ray_cast(self.corrector.place(frame).T_world_camera, intrinsics)
        assert view.measured is not None
        return view.depth_m, view.measured

    def _fuse_virtual_view(self, view: VirtualView, newest: Keyframe, intrinsics: CameraIntrinsics) -> None:
        # A ray cast of the map at full size would take longer than the rendering, and the map is no sharper.
        fraction = min(1.0, VIRTUAL_SIZE * self.config.render.scale)
        smaller = scale_intrinsics(intrinsics, round(intrinsics.width * fraction), round(intrinsics.height * fraction))
        cast = self.voxel_map.ray_cast(view.T_world_camera, smaller)
        rgb, depth, pose = cast.rgb, cast.depth_m, view.T_world_camera
        frame = PosedFrame(newest.stamp_ns, newest.seq, newest.camera_id, rgb, depth, None, smaller, pose)
        views = FrameViews(frame)
        sources = [k.encoded for k in self._choose_sources(views, newest.encoded, self.keyframes)]
        rendered = self._render(views, sources, self.config.render.scale / fraction, self._renderer)
        full = self._upsample(views, rendered, self.voxel_map)
        table = rendered.probabilities.reshape(-1, len(self.label_set)), full.rows
        add_votes(self.voxel_map, view.T_world_camera, smaller, full.depth_m, table)


def _place_of(frame: PosedFrame) -> Place:
    assert frame.depth_m is not None
    found = find_place_features(frame.rgb, frame.depth_m, MAX_FEATURES)
    return make_place(frame.camera_id, frame.stamp_ns, frame.T_world_camera, found, frame.intrinsics)


class FieldTrial:
    """A field that may take the place of a pipeline's, which goes on mapping meanwhile: looked at in small pieces.

    ``field`` encodes as the present one does (``fields.weights.encode_alike``); ``anchors`` are labelled keyframes that
    it was finetuned on; in ``frames``, mapped ones, it is compared with the map. ``WeightsError``: other classes than
    the map's, or more anchors than the pipeline keeps keyframes."""

    def __init__(
        self,
        pipeline: MappingPipeline,
        field: StreamField[Any],
        anchors: Sequence[PosedFrame],
        frames: Sequence[PosedFrame],
    ) -> None:
        check_classes(field, pipeline.label_set)
        capacity = pipeline.config.keyframes.capacity
        if len(anchors) > capacity:
            raise WeightsError(
                f"{len(anchors)} keyframes come with these weights, but only {capacity} are kept (keyframes.capacity)"
            )
        self._pipeline = pipeline
        self._field = field
        self._renderer = ViewRenderer(field, pipeline.config.render, pipeline.config.sampling)
        self._anchors, self._frames = list(anchors), list(frames)
        self._encoded: list[Keyframe] = []
        self._same = self._compared = 0

    @property
    def agreement(self) -> float | None:
        """Fraction of the pixels that the map is sure of which this field names as the map does; None = none."""
        return self._same / self._compared if self._compared else None

    def advance(self) -> bool:
        """Encode an anchor, or look at a frame: about the time of one step. True once nothing is left to do."""
        if len(self._encoded) < len(self._anchors):
            self._encoded.append(self._pipeline.encode_anchor(self._anchors[len(self._encoded)]))
        elif self._frames:
            keyframes = KeyframeStore(self._pipeline.config.keyframes)
            for keyframe in self._pipeline.keyframes.keyframes:
                if not keyframe.labelled:
                    keyframes.add(keyframe)
            keyframes.exchange_labelled(self._encoded)
            same, compared = self._pipeline.agreement(self._frames.pop(), self._renderer, keyframes)
            self._same += same
            self._compared += compared
        return not self._frames and len(self._encoded) == len(self._anchors)

    def exchange(self) -> None:
        """Put the field in the place of the present one; only when ``advance`` has come to its end."""
        self._pipeline.exchange_field(self._field, self._encoded)
