from __future__ import annotations

import dataclasses
from dataclasses import replace
from threading import Event

import numpy as np
import pytest
import torch

from semantic_mapper.config import GridFieldConfig
from semantic_mapper.errors import FrameError, PoseError, WeightsError
from semantic_mapper.fields.checkpoint import streaming
from semantic_mapper.fields.device import DeviceField
from semantic_mapper.fields.scene.grid import GridField
from semantic_mapper.fields.streaming import StreamingSRay
from semantic_mapper.fields.weights import default_checkpoint_path, load_weights
from semantic_mapper.labels import NYU40, ROOMS
from semantic_mapper.localization.places import Place, PlaceStore
from semantic_mapper.mapping import pipeline as pipeline_module
from semantic_mapper.mapping.pipeline import FieldTrial, MappingPipeline
from semantic_mapper.mapping.rendering import RenderedView, add_own_image
from semantic_mapper.types import CameraIntrinsics, MapUpdate, PosedFrame
from tests.drawn_room import walk_frames
from tests.mapping.test_voxel_map import same
from tests.small import tiny_config, tiny_field, tiny_frames, tiny_pipeline


@pytest.mark.parametrize("value", [1e-40, 1e4, 1e30, 3.4e38, np.inf, np.nan, -1.0])
def test_depth_that_no_sensor_measures_counts_as_none(value: float):
    hostile, blank = tiny_pipeline(), tiny_pipeline()
    for number, frame in enumerate(tiny_frames(3)):
        assert frame.depth_m is not None
        wild, none = frame.depth_m.copy(), frame.depth_m.copy()
        part = np.s_[::2] if number else np.s_[:]
        wild[part], none[part] = value, 0
        hostile.step(replace(frame, depth_m=wild))
        blank.step(replace(frame, depth_m=none))
    assert same(hostile.voxel_map.block_state(), blank.voxel_map.block_state())


def test_bad_frames_are_refused_and_leave_the_map_as_it_was():
    a, b = tiny_pipeline(), tiny_pipeline()
    good = tiny_frames()
    nan_pose, mirrored = good[1].T_world_camera.copy(), good[1].T_world_camera.copy()
    nan_pose[0, 3] = np.nan
    mirrored[:3, 0] *= -1
    a.step(good[0])
    b.step(good[0])
    with pytest.raises(PoseError, match=r"seq=1 .*NaN"):
        a.step(replace(good[1], T_world_camera=nan_pose))
    with pytest.raises(PoseError, match="not a rotation"):
        a.step(replace(good[1], T_world_camera=mirrored))
    for frame in good[1:3]:
        a.step(frame)
        b.step(frame)
    assert same(a.voxel_map.block_state(), b.voxel_map.block_state())


def test_arrays_of_a_frame_may_be_used_again_after_its_step():
    """Its place is made by a thread, which is held up here until they have been."""
    usual, reused, go_on = tiny_pipeline(), tiny_pipeline(), Event()
    frame = walk_frames(7, 1, CameraIntrinsics(132.0, 132.0, 79.5, 59.5, 160, 120))[0]
    usual.step(frame)
    [place] = usual.voxel_map.places.places
    assert len(place.points) > 10

    def wait() -> Place:
        assert go_on.wait(60)
        return place

    PlaceStore().add_soon(np.eye(4), wait)
    assert frame.depth_m is not None
    rgb, depth, pose = frame.rgb.copy(), frame.depth_m.copy(), frame.T_world_camera.copy()
    reused.step(replace(frame, rgb=rgb, depth_m=depth, T_world_camera=pose))
    rgb[:], depth[:], pose[:] = 0, 0, 0
    go_on.set()
    [found] = reused.voxel_map.places.places
    np.testing.assert_array_equal(found.points, place.points)
    np.testing.assert_array_equal(found.T_world_camera, place.T_world_camera)


def test_cameras_of_two_sizes_have_each_their_own_keyframes():
    """At one place both become keyframes, and each is rendered from views of its own size."""
    pipeline = tiny_pipeline(keyframes={"translation_m": 0.02})

    def narrow(frame: PosedFrame, seq: int) -> PosedFrame:
        intrinsics = replace(
            frame.intrinsics, cx=frame.intrinsics.cx - 8, cy=frame.intrinsics.cy - 6, width=80, height=60
        )
        rgb, depth = frame.rgb[6:66, 8:88].copy(), frame.depth_m[6:66, 8:88].copy()
        return replace(frame, seq=seq, camera_id="narrow", rgb=rgb, depth_m=depth, label=None, intrinsics=intrinsics)

    wide, other = [], []
    for frame in tiny_frames(4):
        wide.append(pipeline.step(frame))
        other.append(pipeline.step(narrow(frame, frame.seq + 100)))
    assert wide[0].is_keyframe and other[0].is_keyframe
    assert wide[3].source_seqs and set(wide[3].source_seqs) <= {0, 1, 2}
    assert other[3].source_seqs and set(other[3].source_seqs) <= {100, 101, 102}


def test_where_a_frame_has_no_depth_it_says_what_the_map_is_surer_of():
    pipeline, frames = tiny_pipeline(), tiny_frames()
    for frame in frames[:3]:
        pipeline.step(frame)
    depth, hole = frames[3].depth_m.copy(), np.zeros(frames[3].depth_m.shape, np.bool_)
    hole[20:60, 20:80] = True
    depth[hole] = 0
    update = pipeline.step(replace(frames[3], depth_m=depth))
    seen = pipeline.voxel_map.ray_cast(frames[3].T_world_camera, frames[3].intrinsics)
    sure, agrees = seen.confidence > update.confidence, update.label == seen.label
    assert (hole & sure).sum() > 300 and agrees[hole & sure].mean() > 0.9 > agrees[~hole & sure].mean()


def test_frames_without_depth_are_rendered_and_fused_from_what_the_field_sees():
    # Untrained weights guess the depth of a view without depth at random, so only views with depth are sources here.
    pipeline = tiny_pipeline(keyframes={"use_current_view": False, "translation_m": 0.02}, depth={"source": "sensor"})
    frames = tiny_frames()
    for frame in frames[:3]:
        pipeline.step(frame)
    update = pipeline.step(replace(frames[3], depth_m=None))
    truth = frames[3].depth_m
    both = (update.depth_m > 0) & (truth > 0)
    assert both.mean() > 0.5
    assert np.median(np.abs(update.depth_m[both] - truth[both])) < 0.1


class CountingField(StreamingSRay):
    """Counts the rays that it renders."""

    rays = 0

    def render(self, rays, sources):
        self.rays += len(rays.origin)
        return super().render(rays, sources)


def test_fewer_rays_give_nearly_the_same_view_and_a_map_that_repeats():
    trained = load_weights(default_checkpoint_path())
    frames = tiny_frames(3)
    updates, rays, pipelines = [], [], []
    for fraction in (1.0, 0.4, 0.4):
        config = tiny_config(render={"encode_width": 64, "ray_fraction": fraction, "scale": 0.5})
        field = CountingField(trained.config, trained.label_set, trained.tensors, config.sampling)
        pipeline = MappingPipeline(config, field, trained.label_set)
        updates.append([pipeline.step(f) for f in frames])
        rays.append(field.rays)
        pipelines.append(pipeline)
    assert rays[1] < 0.6 * rays[0]
    assert np.mean([(a.label == b.label).mean() for a, b in zip(updates[0], updates[1], strict=True)]) > 0.9
    assert same(pipelines[1].voxel_map.block_state(), pipelines[2].voxel_map.block_state())


def test_labels_of_anchors_are_used_and_labels_of_other_frames_are_not():
    frames = tiny_frames()
    config = tiny_config()
    field = tiny_field()
    maps = []
    for anchors, stream in (
        (frames[:2], frames[2:4]),
        ([replace(f, label=None) for f in frames[:2]], frames[2:4]),
        (frames[:2], [replace(f, label=None) for f in frames[2:4]]),
    ):
        pipeline = MappingPipeline(config, streaming(field), ROOMS, anchors=anchors)
        for frame in stream:
            pipeline.step(frame)
        maps.append(pipeline)
    assert not same(maps[0].voxel_map.block_state(), maps[1].voxel_map.block_state())
    assert same(maps[0].voxel_map.block_state(), maps[2].voxel_map.block_state())


def test_the_own_image_weighs_less_where_views_of_a_frame_are_labelled(monkeypatch: pytest.MonkeyPatch):
    weights: list[float] = []

    def note(view, own, weight, where=None):
        if where is None:  # the votes; else what is shown between rays
            weights.append(weight)
        return add_own_image(view, own, weight, where)

    monkeypatch.setattr(pipeline_module, "add_own_image", note)
    frames, config = tiny_frames(), tiny_config(keyframes={"translation_m": 0.01})
    away = frames[0].T_world_camera.copy()
    away[:3, 3] += 30
    maps = []
    for anchors in ((), (replace(frames[0], T_world_camera=away),), frames[:1]):
        pipeline = MappingPipeline(config, streaming(tiny_field()), ROOMS, anchors=anchors)
        assert [len(pipeline.step(f).source_seqs) for f in frames[1:3]] == ([1, 2] if anchors == frames[:1] else [0, 1])
        maps.append(pipeline.voxel_map.block_state())
    assert weights == pytest.approx([0.8, 0.8] * 2 + [0.2, 0.2])
    assert same(maps[0], maps[1])  # a labelled keyframe of another room is no reason to trust these views


def test_without_labelled_views_fewer_rays_are_rendered_and_the_own_image_fills_between_them(monkeypatch):
    frames, config = tiny_frames(4), tiny_config(render={"encode_width": 96, "scale": 0.5, "ray_fraction": 0.3})

    def last_of(anchors: list[PosedFrame]) -> tuple[MapUpdate, RenderedView]:
        shown: list[RenderedView] = []
        pipeline = MappingPipeline(config, streaming(tiny_field(), config.sampling), ROOMS, anchors=anchors)
        render = pipeline._render_semantics
        pipeline._render_semantics = lambda *args: shown.append(render(*args)[0]) or render(*args)
        return [pipeline.step(frame) for frame in frames][-1], shown[-1]

    labelled, unlabelled = last_of(list(frames[:2])), last_of([])
    assert labelled[0].rays <= 0.3 * 48 * 36 and unlabelled[0].rays <= 0.7 * 0.3 * 48 * 36 < labelled[0].rays
    monkeypatch.setattr(pipeline_module, "OWN_BETWEEN_RAYS", 0.0)
    (_, view), (_, alone) = unlabelled, last_of([])
    traced, known = view.traced, view.known
    assert traced is not None and (known & ~traced).any()
    np.testing.assert_array_equal(view.probabilities[traced], alone.probabilities[traced])
    assert (view.probabilities != alone.probabilities)[known & ~traced].any(axis=1).mean() > 0.9


class SceneField(GridField):
    """Has the geometry of a scene, and notes which rays it was asked for."""

    def render(self, rays, sources):
        self.__dict__.setdefault("priors", []).append(float(rays.prior_depth_m.max()))
        return super().render(rays, sources)


def test_a_field_that_holds_the_scene_is_told_no_depth_but_a_sensors_and_needs_no_near_view():
    frames = tiny_frames()
    config = tiny_config(keyframes={"use_current_view": False})
    field = SceneField(GridFieldConfig(), ROOMS)
    pipeline = MappingPipeline(config, DeviceField(field, torch.device("cpu"), config.sampling), ROOMS)
    for frame in frames:
        pipeline.step(frame)
    priors = field.__dict__["priors"]
    assert min(priors) > 0, "a sensor's"
    priors.clear()
    pipeline.step(replace(frames[0], depth_m=None, seq=100, stamp_ns=frames[-1].stamp_ns + 10**9))
    assert priors and max(priors) == 0, "neither the map's"
    priors.clear()
    away = frames[0].T_world_camera.copy()
    away[:3, 3] += 30
    pipeline.step(
        replace(frames[0], depth_m=None, seq=101, stamp_ns=frames[-1].stamp_ns + 2 * 10**9, T_world_camera=away)
    )
    assert priors, "rendered, though no keyframe looks there"


FRAMES = tiny_frames(6)


def mapped(count: int = 4) -> MappingPipeline:
    pipeline = tiny_pipeline(keyframes={"translation_m": 0.01})
    for frame in FRAMES[:count]:
        pipeline.step(dataclasses.replace(frame, label=None))
    return pipeline


def test_an_exchanged_field_goes_on_with_map_and_keyframes_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline_module, "SURE", 0.0)  # a field that knows nothing is sure of nothing
    pipeline = mapped()
    before, keyframes = pipeline.voxel_map.block_state(), pipeline.keyframes.keyframes
    assert len(keyframes) == 4
    anchors = [FRAMES[4], FRAMES[5]]
    alike = FieldTrial(pipeline, streaming(tiny_field()), (), [FRAMES[0], FRAMES[1]])
    assert [alike.advance() for _ in range(2)] == [False, True]
    trial = FieldTrial(pipeline, streaming(tiny_field()), anchors, [FRAMES[0], FRAMES[1]])
    assert [trial.advance() for _ in range(4)] == [False, False, False, True]
    # What the map says comes from the same random weights; those that know labels of two views say otherwise.
    assert alike.agreement is not None and trial.agreement is not None and alike.agreement > 2 * trial.agreement
    assert pipeline.keyframes.keyframes == keyframes  # a trial changes nothing
    trial.exchange()
    kept = pipeline.keyframes.keyframes
    assert [k.labelled for k in kept] == [True, True, False, False, False, False]
    assert kept[2:] == keyframes and (kept[0].encoded.channel >= 0).any()
    assert same(pipeline.voxel_map.block_state(), before)
    update = pipeline.step(dataclasses.replace(FRAMES[4], label=None))
    assert update.fused and {4, 5} & set(update.source_seqs)
    trial = FieldTrial(pipeline, streaming(tiny_field()), anchors[:1], [])
    assert trial.advance() and trial.agreement is None
    trial.exchange()  # labelled keyframes of the weights before go with them
    assert [k.seq for k in pipeline.keyframes.keyframes if k.labelled] == [FRAMES[4].seq]


def test_what_does_not_fit_the_pipeline_is_refused() -> None:
    pipeline = mapped(1)
    with pytest.raises(WeightsError, match="label set 'nyu40'"):
        FieldTrial(pipeline, streaming(tiny_field(NYU40)), (), ())
    with pytest.raises(WeightsError, match="65 keyframes come with these weights, but only 64 are kept"):
        FieldTrial(pipeline, streaming(tiny_field()), [FRAMES[0]] * 65, ())


def test_a_frame_beyond_its_budget_is_refused_and_the_run_goes_on(
    monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
):
    monkeypatch.setattr("semantic_mapper.mapping.allocation.LEAST_FRAME_BUDGET", 400)
    a, b = (tiny_pipeline(voxel_map={"voxel_size_m": 0.02, "max_blocks": 3200}) for _ in range(2))
    good = replace(tiny_frames()[0], depth_m=np.full((72, 96), 1.0, np.float32))
    noise = replace(good, seq=1, depth_m=rng.uniform(0.5, 5, (72, 96)).astype(np.float32))
    a.step(good)
    with pytest.raises(FrameError, match=r"more than 400 blocks of 0\.02 m voxels"):
        a.step(noise)
    a.step(replace(good, seq=2))
    b.step(good)
    b.step(replace(good, seq=2))
    assert same(a.voxel_map.block_state(), b.voxel_map.block_state())
