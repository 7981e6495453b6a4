from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch

from research.scenes import PoseNoiseConfig, room_frames
from research.tests.train.small_run import POOL, small_run
from research.train.cameras import draw_camera
from research.train.computed_depth import ComputedDepth, compute_depth
from research.train.rooms import PackedRoom, RoomPoolConfig, pack_room, unpack_room
from research.train.start import take_over
from research.train.step import StepConfig, draw_batch
from research.train.train import train
from research.train.view_draws import cropped_view
from semantic_mapper.config import SamplingConfig, convert_config
from semantic_mapper.fields.checkpoint import Checkpoint, save_checkpoint
from semantic_mapper.fields.sampling import COMPUTED_GUIDED
from semantic_mapper.fields.sray import SRay
from semantic_mapper.labels import ROOMS
from semantic_mapper.training.views import mirrored_view, stack_sources
from tests.small import SMALL_ENCODER, SMALL_MODEL

CPU = torch.device("cpu")
MEASURED = convert_config(POOL, RoomPoolConfig, "test config")
COMPUTED = msgspec.structs.replace(MEASURED, width=64, views=6, computed_depth=1.0)


@pytest.fixture(scope="module")
def room() -> PackedRoom:
    packed = pack_room(0, COMPUTED)
    assert isinstance(packed, PackedRoom)
    return packed


def test_a_room_with_computed_depth_keeps_what_was_measured_as_its_target(room: PackedRoom):
    views = unpack_room(room, CPU).views
    sources = stack_sources(views)
    assert room.computed_m is not None and room.computed_sigma_m is not None and sources.depth_sigma_m is not None
    assert np.array_equal(sources.depth_m.numpy(), room.computed_m)
    assert np.array_equal(sources.depth_sigma_m.numpy(), room.computed_sigma_m)
    assert np.array_equal(np.stack([v.depth_m.numpy() for v in views]), room.depth_m)
    assert not np.array_equal(room.computed_m, room.depth_m)


def test_computed_depth_is_near_the_measured_one_where_its_spread_is_small():
    frames = list(room_frames(3, 8, draw_camera(3, 160, 0.1, MEASURED.camera).intrinsics))
    for frame, computed in zip(frames, compute_depth(frames, ComputedDepth(1, 6)), strict=True):
        assert frame.depth_m is not None and computed.depth_m is not None and computed.depth_sigma_m is not None
        known = (frame.depth_m > 0) & (computed.depth_m > 0)
        error = np.abs(computed.depth_m - frame.depth_m)[known] / frame.depth_m[known]
        spread = computed.depth_sigma_m[known] / computed.depth_m[known]
        assert np.median(error[spread <= np.median(spread)]) < 0.05


def test_every_nth_picture_is_a_view_whose_pose_drifts_as_it_was_given():
    intrinsics = draw_camera(0, 64, 0.1, MEASURED.camera).intrinsics
    frames = list(room_frames(0, 6, intrinsics, pose_noise=PoseNoiseConfig()))
    chosen = compute_depth(frames, ComputedDepth(2, 0))
    assert [f.seq for f in chosen] == [0, 2, 4]
    assert all(np.array_equal(f.T_world_camera, frames[f.seq].T_world_camera) for f in chosen)


def test_mirrored_and_cropped_views_carry_their_computed_depth_along(room: PackedRoom):
    view = unpack_room(room, CPU).views[2]
    assert view.computed_m is not None and view.computed_sigma_m is not None
    mirrored = mirrored_view(view)
    assert mirrored.computed_m is not None and mirrored.computed_sigma_m is not None
    assert torch.equal(mirrored.computed_m.flip(-1), view.computed_m)
    assert torch.equal(mirrored.computed_sigma_m.flip(-1), view.computed_sigma_m)
    whole = cropped_view(view, 1.0, 0, 0)
    assert whole.computed_m is not None and torch.equal(whole.computed_m, view.computed_m)
    part = cropped_view(view, 0.5, 0, 0)
    assert part.computed_m is not None and part.computed_sigma_m is not None
    assert torch.equal(part.computed_m[::2, ::2], view.computed_m[: -(-len(view.computed_m) // 2), :32])
    assert part.computed_sigma_m.shape == part.depth_m.shape


def test_rays_are_sampled_round_computed_depth_and_learn_the_measured_one(room: PackedRoom):
    views = unpack_room(room, CPU).views
    config = StepConfig(rays=64, depth_dropout=0, sampling=SamplingConfig(guided=4))
    batch = draw_batch(views, 2, [1, 3], config, torch.Generator().manual_seed(0), len(ROOMS), CPU)
    assert batch is not None and views[2].computed_m is not None
    assert batch.z.shape[1] == COMPUTED_GUIDED
    assert torch.isin(batch.rays.prior_depth_m, views[2].computed_m).all()
    assert torch.isin(batch.targets.depth_m, views[2].depth_m).all()


def test_a_run_learns_from_rooms_with_computed_depth():
    encoder = msgspec.structs.replace(SMALL_ENCODER, computed_depth=True)
    field = msgspec.to_builtins(msgspec.structs.replace(SMALL_MODEL, encoder=encoder))
    checkpoint = train(small_run(field=field, pool=POOL | {"computed_depth": 1.0}, steps=4))
    assert checkpoint.model.config.encoder.computed_depth
    assert all(bool(tensor.isfinite().all()) for tensor in checkpoint.model.state_dict().values())


def test_weights_that_were_never_shown_computed_depth_can_learn_from_it(tmp_path: Path):
    before = SRay(SMALL_MODEL, ROOMS)
    encoder = msgspec.structs.replace(SMALL_ENCODER, computed_depth=True)
    after = SRay(msgspec.structs.replace(SMALL_MODEL, encoder=encoder), ROOMS)
    save_checkpoint(Checkpoint(before), tmp_path / "before.safetensors")
    take_over(after, tmp_path / "before.safetensors")
    theirs = before.state_dict()
    assert all(torch.equal(tensor, theirs[name]) for name, tensor in after.state_dict().items())
    assert after.config.encoder.computed_depth
