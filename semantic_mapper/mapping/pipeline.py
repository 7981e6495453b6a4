"""The whole main job in one class: a posed frame in, a better map out.

Replay and the mapper node call this very ``step``.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from semantic_mapper.config import MapperConfig, with_quality
from semantic_mapper.errors import ConfigError, FrameError
from semantic_mapper.fields.base import EncodedViews, SemanticField, check_classes, stack_views
from semantic_mapper.fields.depth_prior import depth_prior
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.geometry import camera_matrix, check_pose, scale_intrinsics
from semantic_mapper.imaging import (
    FrameViews,
    fill_holes,
    is_measured,
    resize_label,
    resize_spread,
    working_intrinsics,
)
from semantic_mapper.labels import LabelSet
from semantic_mapper.localization.features import find_place_features
from semantic_mapper.localization.places import MAX_FEATURES, make_place
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapping.correction import FusedFrame, MapCorrector
from semantic_mapper.mapping.frame_depth import FrameDepth, computed_trust, rendered_trust
from semantic_mapper.mapping.keyframes import EncodedSize, Keyframe, KeyframeStore
from semantic_mapper.mapping.moving import MovingFilter
from semantic_mapper.mapping.odometry_sessions import PoseInMap
from semantic_mapper.mapping.picture_check import PictureCheck
from semantic_mapper.mapping.pose_check import PoseCheck
from semantic_mapper.mapping.views.upsample import upsample
from semantic_mapper.mapping.views.view_renderer import RenderedView, ViewRenderer, add_own_image
from semantic_mapper.mapping.views.virtual_views import RenderedVirtualView, ViewpointChooser, add_votes
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import Bool, CameraIntrinsics, Float32, MapUpdate, PosedFrame, SourceViews, UInt8

_log = get_logger(__name__)

ODD_FRAMES = 2  # frames of another size that are refused before the new size is believed
MAX_CAMERAS = 64  # as in a stream's information; something is kept of each
VIRTUAL_SIZE = 2  # times the size of a coarse view: how finely the map is looked at in a virtual one
SURE = 0.8  # confidence from which on the map is believed where another field is compared with it
COVERAGE_WIDTH = 80  # width of the depth image that a keyframe keeps for the choice of source views


class _FullSize(NamedTuple):
    """A rendered view at the size of its frame.

    Args:
        views: The frame, without what moves.
        depth_m: (H, W) to fuse.
        rows: (H, W) which coarse pixel each pixel takes its probabilities from, -1 = unknown.
        trust: (H, W) in depth; None = full.
        moving: (H, W) what was left out because it moves; None = nothing was looked for.
    """

    views: FrameViews
    depth_m: Float32
    rows: NDArray[np.int32]
    trust: Float32 | None
    moving: Bool | None = None


class MappingPipeline:
    """Keyframes, view choice, rendering and fusion behind one ``step``.

    Deterministic: same frames, config, field and thread count give the same map, bit for bit.

    Args:
        config: All settings.
        field: Renders semantics; its classes must be those of ``label_set``.
        label_set: Classes of the map.
        anchors: Labelled keyframes that the field was finetuned on; they are source views from the first frame on.

    Attributes:
        pose_in_map: Of the last frame of a session.
        picture_check: What was wrong with pictures that depth was to be computed from, and between them and their
            poses.

    Raises:
        WeightsError: the field renders other classes than the map holds.
    """

    def __init__(
        self,
        config: MapperConfig,
        field: SemanticField,
        label_set: LabelSet,
        *,
        anchors: Sequence[PosedFrame] = (),
    ) -> None:
        check_classes(field, label_set)
        self.config = config = with_quality(config)
        self.field = field
        self.label_set = label_set
        self.voxel_map = VoxelMap(config.voxel_map, label_set)
        self.keyframes = KeyframeStore(config.keyframes)
        self._frame_depth = FrameDepth(config.depth, self._cast_for_hint)
        self.picture_check: PictureCheck = self._frame_depth.pictures
        self.pose_check = PoseCheck(config.voxel_map.depth_max_m)
        self.moving = MovingFilter(config, label_set)
        self.pose_in_map = PoseInMap()
        self._viewpoints = ViewpointChooser(config.seed)
        self._uses_own_view = config.keyframes.use_current_view
        self._own_image_weight = config.keyframes.own_image_weight if self._uses_own_view else 0.0
        self._renderer = ViewRenderer(field, config.render, config.sampling)
        self.corrector = MapCorrector(
            config.history, self.voxel_map, self.keyframes, self._fuse_again, self.moving.clear
        )
        self._steps = 0
        self._intrinsics: dict[str, CameraIntrinsics] = {}
        self._odd_sizes: dict[str, tuple[tuple[int, int], int]] = {}
        self._stage_ms: dict[str, float] = {}
        self._warned_of_sizes = False
        for anchor in anchors:
            self.keyframes.add(self.encode_anchor(anchor))

    def step(self, frame: PosedFrame) -> MapUpdate:
        """Render the semantics of one frame, fuse it, and maybe keep it as a source view.

        A frame whose depth is to be computed gets it from those before it; see ``prepare``.

        Raises:
            FrameError, PoseError: the frame cannot be used. The map is unchanged and the next frame is welcome.
            ConfigError: ``depth.from_motion.delay_frames`` is not 0, and the frame does not come from ``prepare``.
        """
        (frame,) = self.prepare(frame) if self._delay_frames == 0 else (self._prepared(frame),)
        with self.corrector.lock:
            self.corrector.make_room()
            frame = self.corrector.place(frame)
            self._check(frame)
            self._stage_ms = {}
            views = FrameViews(frame)
            with self._stage("encode"):
                current = self._encode(views)
            with self._stage("choose"):
                sources = self._choose_sources(views, current.size)
            with self._stage("render"):
                view = self._render(views, self._with_own(sources, current), self.config.render.scale)
                votes = add_own_image(view, self.field, current, self._own_image_weight)
            moving = self._find_moving(frame)
            with self._stage("upsample"):
                full = self._upsample_still(views, votes, moving)
            with self._stage("fuse"):
                touched = self._fuse(self.voxel_map, full, votes)
            if self.corrector.records:
                with self._stage("history"):
                    rendered = votes.probabilities, votes.known, votes.depth_m
                    self.corrector.record(FusedFrame(full.views.frame, *rendered))
            with self._stage("keyframe"):
                is_keyframe = self._keep_view(full.views, current, sources)
            self._note_step(frame)
            return self._update(frame, view, full, sources, is_keyframe, touched)

    def prepare(self, frame: PosedFrame) -> list[PosedFrame]:
        """Give a frame the depth that ``config.depth`` asks for; what is ready for ``step``, oldest first.

        One frame each, unless ``depth.from_motion.delay_frames`` lets frames wait for later ones.

        Raises:
            FrameError: its picture cannot be mapped, such as a dark or blurred one; see ``picture_check``.
            PoseError: the pose is not a rigid transform.
        """
        check_pose(frame.T_world_camera, f"frame seq={frame.seq} of camera '{frame.camera_id}'")
        return self._frame_depth.push(frame)

    def prepare_rest(self) -> list[PosedFrame]:
        """The frames that still wait in ``prepare``, oldest first."""
        return self._frame_depth.finish()

    @property
    def pose_disagreement_px(self) -> tuple[float, float] | None:
        """Median distance in pixels of corners from where given poses have them, and where refined poses do, of the
        last frames whose depth was computed; None where there were none."""
        return self._frame_depth.disagreement.medians

    def render_virtual_views(self, views: int = 1) -> tuple[RenderedVirtualView, ...]:
        """Render the map from where no camera stood, the views of most gain, and fuse what they say of classes.

        For when there is time to spare; every view takes about that of a frame. Nothing is measured: TSDF, colours and
        ``frames`` stay as they are. Deterministic, as part of the sequence of steps and virtual views.

        The history keeps frames alone: a correction of poses rebuilds the map without the votes of these views, and
        all may be looked at again.

        Args:
            views: At most this many.

        Returns:
            What was rendered, empty where no view is worth its time: no frame mapped yet, too few keyframes, or all
            that they see is clear or was looked at.
        """
        rendered: list[RenderedVirtualView] = []
        with self.corrector.lock:
            while len(rendered) < views and (view := self._render_virtual_view()) is not None:
                rendered.append(view)
        return tuple(rendered)

    def encode_anchor(self, anchor: PosedFrame) -> Keyframe:
        """A labelled keyframe that a field was finetuned on, as ``exchange_field`` takes it."""
        resized = FrameViews(anchor)
        return self._make_keyframe(resized, self._encode(resized, self._known_channel(anchor)), labelled=True)

    def exchange_field(self, field: SemanticField, anchors: Sequence[Keyframe]) -> None:
        """Go on with other weights. What is in the map stays, with the weight that it has.

        Args:
            field: Encodes as the present one does (``fields.learned.encode_alike``): keyframes keep their features.
            anchors: Of ``encode_anchor``; they take the place of those of the weights before.

        Raises:
            WeightsError: it renders other classes than the map holds; nothing has changed.
        """
        check_classes(field, self.label_set)
        self.field = field
        self._renderer.exchange_field(field)
        self.keyframes.exchange_labelled(anchors)

    def agreement(self, frame: PosedFrame, renderer: ViewRenderer, keyframes: KeyframeStore) -> tuple[int, int]:
        """How far another field agrees with the map where that is sure of itself. Changes nothing.

        Args:
            frame: One that was mapped.
            renderer: Of a field that encodes as the present one does.
            keyframes: It renders from these and, where the config says so, the frame itself.

        Returns:
            Pixels of the coarse view that it names as the map does, and those that are compared.
        """
        frame = self.corrector.place(frame)
        resized = FrameViews(frame)
        current = self._encode(resized)
        sources = self._choose_sources(resized, current.size, keyframes)
        view = self._render(resized, self._with_own(sources, current), self.config.render.scale, renderer)
        low = scale_intrinsics(frame.intrinsics, view.known.shape[1], view.known.shape[0])
        seen = self.voxel_map.ray_cast(frame.T_world_camera, low)
        sure = view.known & (seen.confidence >= SURE) & (seen.label != self.label_set.ignore_id)
        same = self.label_set.to_ids(view.probabilities.argmax(axis=2)) == seen.label
        return int((same & sure).sum()), int(sure.sum())

    def classify(self, frame: PosedFrame) -> UInt8:
        """Class ids (h, w) of a frame as it shows them by itself, wherever it was taken; coarse. Changes nothing."""
        resized = FrameViews(frame)
        view = self._render(resized, [self._encode(resized)], self.config.render.scale)
        label = self.label_set.to_ids(view.probabilities.argmax(axis=2))
        return np.where(view.known, label, np.uint8(self.label_set.ignore_id)).astype(np.uint8)

    def _render_virtual_view(self) -> RenderedVirtualView | None:
        known = [k for k in self.keyframes.keyframes if k.camera_id in self._intrinsics]
        if not known:
            return None
        size, intrinsics = known[-1].encoded.size, self._intrinsics[known[-1].camera_id]
        fitting = [k for k in self.keyframes.keyframes if k.encoded.size == size]
        view = self._viewpoints.choose(self.voxel_map, fitting, intrinsics)
        if view is None:
            return None
        # A ray cast of the map at full size would take longer than the rendering, and the map is no sharper.
        fraction = min(1.0, VIRTUAL_SIZE * self.config.render.scale)
        smaller = scale_intrinsics(intrinsics, round(intrinsics.width * fraction), round(intrinsics.height * fraction))
        cast = self.voxel_map.ray_cast(view.T_world_camera, smaller)
        frame = PosedFrame(
            stamp_ns=known[-1].stamp_ns,
            seq=known[-1].seq,
            camera_id=known[-1].camera_id,
            rgb=cast.rgb,
            depth_m=cast.depth_m,
            label=None,
            intrinsics=smaller,
            T_world_camera=view.T_world_camera,
        )
        resized = FrameViews(frame)
        sources = self._choose_sources(resized, size)
        rendered = self._render(resized, [k.encoded for k in sources], self.config.render.scale / fraction)
        full = self._upsample(resized, rendered, self.voxel_map)
        table = rendered.probabilities.reshape(-1, len(self.label_set)), full.rows
        blocks = add_votes(self.voxel_map, view.T_world_camera, smaller, full.depth_m, table)
        return RenderedVirtualView(view, tuple(k.seq for k in sources), blocks)

    def _find_moving(self, frame: PosedFrame) -> Bool | None:
        """Pixels (H, W) of what moves by depth; None where nothing is looked for."""
        if not self.moving.looks_at(frame):
            return None
        with self._stage("motion"):
            return self.moving.find(frame)

    def _upsample_still(self, views: FrameViews, votes: RenderedView, moving: Bool | None) -> _FullSize:
        """The view at full size, without what moves by depth or by class."""
        if moving is None:
            return self._upsample(views, votes, self.voxel_map)
        full = self._upsample(self.moving.leave_out(views, moving), votes, self.voxel_map)
        if self.moving.uses_classes:
            label, _ = self._at_rows(votes, full.rows)
            by_class = self.moving.of_classes(label)
            if (by_class & ~moving).any():
                moving = moving | by_class
                full = self._upsample(self.moving.leave_out(views, moving), votes, self.voxel_map)
        self.moving.note(views.frame, moving)
        return full._replace(moving=moving)

    def _fuse(self, voxel_map: VoxelMap, full: _FullSize, votes: RenderedView) -> int:
        """Integrate a frame into a map; blocks touched."""
        frame, table = full.views.frame, votes.probabilities.reshape(-1, len(self.label_set))
        measured = is_measured(frame)
        return voxel_map.integrate(frame, full.depth_m, table, rows=full.rows, trust=full.trust, measured=measured)

    def _fuse_again(self, voxel_map: VoxelMap, fused: FusedFrame) -> None:
        """Integrate a frame of the history into a map."""
        view = RenderedView(fused.probabilities, fused.known, fused.rendered_depth_m, 0, 0)
        self._fuse(voxel_map, self._upsample(FrameViews(fused.frame), view, voxel_map), view)

    def _keep_view(self, views: FrameViews, current: EncodedViews, sources: Sequence[Keyframe]) -> bool:
        """Keep a frame as a source view, and as a place that the map is found again by, where it shows something new;
        whether it became a source view."""
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
            found = find_place_features(frame.rgb, frame.depth_m, MAX_FEATURES)
            places.add(make_place(frame.camera_id, frame.stamp_ns, pose, found, frame.intrinsics))
        return is_keyframe

    def _note_step(self, frame: PosedFrame) -> None:
        """Take note of a frame that is in the map, and render virtual views where they are due."""
        self._intrinsics[frame.camera_id] = frame.intrinsics
        self._odd_sizes.pop(frame.camera_id, None)
        spent = self._stage_ms
        self._renderer.note(spent["render"], sum(spent.values()) - spent["render"])
        self._steps += 1
        every = self.config.virtual.every_n_frames
        if every and self._steps % every == 0:
            with self._stage("virtual"):
                try:
                    self.render_virtual_views()
                except FrameError as error:  # the frame itself is in the map
                    _log.warning("virtual_view_refused", seq=frame.seq, reason=str(error))

    def _update(
        self,
        frame: PosedFrame,
        view: RenderedView,
        full: _FullSize,
        sources: Sequence[Keyframe],
        is_keyframe: bool,
        touched: int,
    ) -> MapUpdate:
        label, confidence = self._at_rows(view, full.rows)
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
            label=label,
            confidence=confidence,
            depth_m=depth_m,
            blocks=self.voxel_map.block_count,
            blocks_touched=touched,
            rays=view.rays,
            samples=view.samples,
            stage_ms=self._stage_ms,
            moving=full.moving,
        )

    @property
    def _delay_frames(self) -> int:
        depth = self.config.depth
        return depth.from_motion.delay_frames if depth.source in ("auto", "computed") else 0

    def _prepared(self, frame: PosedFrame) -> PosedFrame:
        if frame.depth_sigma_m is None and (frame.depth_m is None or self.config.depth.source == "computed"):
            raise ConfigError("depth.from_motion.delay_frames lets frames wait: give step what prepare returns")
        return frame

    def _cast_for_hint(self, frame: PosedFrame, intrinsics: CameraIntrinsics) -> tuple[Float32, Bool]:
        if self.voxel_map.block_count == 0:
            empty = np.zeros((intrinsics.height, intrinsics.width), np.float32)
            return empty, empty > 0
        view = self.voxel_map.ray_cast(self.corrector.place(frame).T_world_camera, intrinsics)
        assert view.measured is not None
        return view.depth_m, view.measured

    def _check(self, frame: PosedFrame) -> None:
        where = f"frame seq={frame.seq} of camera '{frame.camera_id}'"
        check_pose(frame.T_world_camera, where)
        if frame.camera_id not in self._intrinsics and len(self._intrinsics) >= MAX_CAMERAS:
            raise FrameError(
                f"{where}: this map has frames of {MAX_CAMERAS} cameras already, the most it takes; give all frames of "
                "one camera the same camera_id"
            )
        size, scale = (frame.intrinsics.width, frame.intrinsics.height), self.config.render.scale
        if round(min(size) * scale) < 1:
            raise FrameError(
                f"{where}: {size[0]}x{size[1]} pixels are too few: at render.scale {scale:g} no ray is left to render; "
                "send larger images, or raise render.scale"
            )
        expected = self._intrinsics.get(frame.camera_id, frame.intrinsics)
        if (expected.width, expected.height) != (frame.intrinsics.width, frame.intrinsics.height):
            if self._is_new_size(frame):
                _log.warning("camera_size_changed", camera=frame.camera_id, width=frame.intrinsics.width)
                return
            raise FrameError(
                f"{where}: {frame.intrinsics.width}x{frame.intrinsics.height}, but this camera has sent "
                f"{expected.width}x{expected.height} before; give another camera_id to another stream"
            )

    def _is_new_size(self, frame: PosedFrame) -> bool:
        """Whether enough frames in a row had this other size to believe that the odd one out came before them."""
        size = (frame.intrinsics.width, frame.intrinsics.height)
        last, count = self._odd_sizes.get(frame.camera_id, (size, 0))
        count = count + 1 if last == size else 1
        self._odd_sizes[frame.camera_id] = (size, count)
        return count > ODD_FRAMES

    @contextmanager
    def _stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self._stage_ms[name] = (time.perf_counter() - start) * 1e3

    def _known_channel(self, anchor: PosedFrame) -> torch.Tensor | None:
        """Labels of a keyframe that the field was finetuned on, as the input of ``encode``; never of other frames."""
        if anchor.label is None:
            return None
        width = self.config.render.encode_width or anchor.intrinsics.width
        label = resize_label(anchor.label, working_intrinsics(anchor.intrinsics, width))
        return torch.from_numpy(self.label_set.to_channels(label, f"anchor seq={anchor.seq}"))[None]

    def _encode(self, resized: FrameViews, channel: torch.Tensor | None = None) -> EncodedViews:
        """Encode one frame at working width, where that is not larger than the frame."""
        frame = resized.frame
        intrinsics = working_intrinsics(frame.intrinsics, self.config.render.encode_width or frame.intrinsics.width)
        rgb, depth = resized.rgb(intrinsics), resized.depth(intrinsics)
        spread = resize_spread(frame, intrinsics)  # a field that has not learned from computed depth leaves it out
        views = SourceViews(
            rgb=torch.from_numpy(rgb).permute(2, 0, 1).float().div(255)[None],
            depth_m=torch.from_numpy(depth)[None],
            K=torch.from_numpy(camera_matrix(intrinsics)).float()[None],
            T_world_camera=torch.tensor(frame.T_world_camera, dtype=torch.float32)[None],
            channel=channel,
            depth_sigma_m=None if spread is None else torch.from_numpy(spread)[None],
        )
        with torch.inference_mode():
            return self.field.encode(views)

    def _choose_sources(
        self, resized: FrameViews, size: EncodedSize, keyframes: KeyframeStore | None = None
    ) -> list[Keyframe]:
        frame = resized.frame
        config = self.config.keyframes
        intrinsics = working_intrinsics(frame.intrinsics, COVERAGE_WIDTH)
        depth = resized.depth(intrinsics)
        count = config.source_views - int(self._uses_own_view)
        store = self.keyframes if keyframes is None else keyframes
        # Cameras of another shape have feature maps of another size; one render takes views of one size.
        chosen = store.choose(frame.T_world_camera, intrinsics, depth, count, size)
        if not chosen and self._holds_scene:  # what it says does not depend on the views
            chosen = [k for k in store.keyframes if k.encoded.size == size][-1:]
        others = sum(k.encoded.size != size for k in store.keyframes)
        if others and not self._warned_of_sizes:
            self._warned_of_sizes = True
            _log.warning(
                "source_views_left_out",
                reason="keyframes were encoded at another size than this frame",
                left_out=others,
                seq=frame.seq,
            )
        return chosen

    def _render(
        self, resized: FrameViews, views: list[EncodedViews], scale: float, renderer: ViewRenderer | None = None
    ) -> RenderedView:
        """The coarse view (h, w), ``scale`` times the size of the frame."""
        frame = resized.frame
        width, height = round(frame.intrinsics.width * scale), round(frame.intrinsics.height * scale)
        if not views:
            empty = np.zeros((height, width), np.float32)
            return RenderedView(np.zeros((height, width, len(self.label_set)), np.float32), empty > 0, empty, 0, 0)
        intrinsics = scale_intrinsics(frame.intrinsics, width, height)
        prior = self._depth_prior(resized, intrinsics)
        return (renderer or self._renderer).render(
            stack_views(views),
            intrinsics,
            frame.T_world_camera,
            prior,
            resized.rgb(intrinsics),
            measured=(resized.depth(intrinsics) > 0) & (prior > 0) if frame.depth_m is not None else None,
            computed=frame.depth_sigma_m is not None,
            stamp_ns=frame.stamp_ns,
        )

    @property
    def _holds_scene(self) -> bool:
        return isinstance(self.field, LearnedField) and self.field.holds_scene

    def _depth_prior(self, resized: FrameViews, intrinsics: CameraIntrinsics) -> Float32:
        """Where the surface is expected: the sensor's depth (``depth_prior``), else the map's own ray cast.

        Nowhere, without a sensor, for a field that holds the scene: it knows better.
        """
        frame = resized.frame
        depth = resized.depth(intrinsics)
        if self._holds_scene and not is_measured(frame):
            return np.zeros_like(depth)
        if frame.depth_m is not None:
            return depth_prior(depth, resized.rgb(intrinsics))
        if self.voxel_map.block_count == 0:
            return depth
        return fill_holes(self.voxel_map.ray_cast(frame.T_world_camera, intrinsics).depth_m)

    def _with_own(self, sources: Sequence[Keyframe], current: EncodedViews) -> list[EncodedViews]:
        """Source views as they are rendered from, the frame itself among them where the settings say so."""
        return [*(k.encoded for k in sources), *([current] if self._uses_own_view else [])]

    def _upsample(self, views: FrameViews, view: RenderedView, voxel_map: VoxelMap) -> _FullSize:
        """A rendered view at the size of its frame."""
        frame = views.frame
        size = (frame.intrinsics.width, frame.intrinsics.height)
        low = scale_intrinsics(frame.intrinsics, view.known.shape[1], view.known.shape[0])
        if frame.depth_m is None:
            map_depth = voxel_map.ray_cast(frame.T_world_camera, low).depth_m
            low_trust = rendered_trust(view.depth_m, map_depth, voxel_map.truncation_m)
            trust = np.asarray(cv2.resize(low_trust, size, interpolation=cv2.INTER_NEAREST), np.float32)
            depth = np.asarray(cv2.resize(view.depth_m, size, interpolation=cv2.INTER_LINEAR), np.float32)
        else:
            depth, trust = views.depth(frame.intrinsics), None
            if frame.depth_sigma_m is not None:
                trust = computed_trust(depth, frame.depth_sigma_m)
        rows = upsample(view.probabilities, view.known, views.rgb(low), views.depth(low), frame.rgb, depth)
        return _FullSize(views, depth, rows, trust)

    def _at_rows(self, view: RenderedView, rows: NDArray[np.int32]) -> tuple[UInt8, Float32]:
        """Class ids and confidence (H, W) of what the pixels take from a view; row -1 is unknown."""
        table = view.probabilities.reshape(-1, len(self.label_set))
        ids = np.append(self.label_set.to_ids(table.argmax(axis=1)), np.uint8(self.label_set.ignore_id))
        return ids[rows], np.append(table.max(axis=1), np.float32(0))[rows]

    def _make_keyframe(self, resized: FrameViews, encoded: EncodedViews, *, labelled: bool = False) -> Keyframe:
        frame = resized.frame
        intrinsics = working_intrinsics(frame.intrinsics, COVERAGE_WIDTH)
        depth = resized.depth(intrinsics)
        return Keyframe(
            frame.seq, frame.stamp_ns, frame.T_world_camera, intrinsics, depth, encoded, labelled, frame.camera_id
        )
