"""Small real things shared by tests: a tiny S-Ray and frames of a procedural room."""

from functools import cache

import torch

from research.scenes import TRAIN_SEEDS, room_frames
from semantic_mapper.config import EncoderConfig, MapperConfig, SRayConfig, convert_config
from semantic_mapper.fields.checkpoint import streaming
from semantic_mapper.fields.encoder import calibrate
from semantic_mapper.fields.sray import SRay
from semantic_mapper.labels import ROOMS, LabelSet
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.training.views import stack_sources, view_from_frame
from semantic_mapper.types import CameraIntrinsics, PosedFrame

INTRINSICS = CameraIntrinsics(66.0, 66.0, 47.5, 35.5, 96, 72)
SMALL_ENCODER = EncoderConfig(channels=(8, 16), blocks=(1, 1), depth=True)
SMALL_MODEL = SRayConfig(feature_dim=16, heads=2, encoder=SMALL_ENCODER)


def tiny_field(label_set: LabelSet = ROOMS, seed: int = 0) -> SRay:
    """Random weights, evaluation mode."""
    torch.manual_seed(seed)
    return SRay(SMALL_MODEL, label_set).eval()


def settled_field() -> SRay:
    """As ``tiny_field``, but its encoder's norms know images: as that of trained weights, it can rest."""
    field = tiny_field()
    assert field.image_encoder is not None
    calibrate(field.image_encoder, stack_sources([view_from_frame(f, ROOMS, 96) for f in tiny_frames(6)]))
    return field.eval()


@cache
def tiny_frames(count: int = 6, seed: int = 7) -> tuple[PosedFrame, ...]:
    """Labelled 96x72 frames of one room, shared by all tests: what a test changes, it copies first."""
    frames = tuple(room_frames(TRAIN_SEEDS[seed], count, INTRINSICS))
    for frame in frames:
        frame.T_world_camera.flags.writeable = False
    return frames


def tiny_config(**changes: object) -> MapperConfig:
    """A config for 96x72 frames and untrained weights; ``changes`` are whole sections as dicts."""
    voxel_map = {"voxel_size_m": 0.05, "unknown_below": 0.0}
    base = {"render": {"encode_width": 96, "scale": 0.5}, "voxel_map": voxel_map}
    return convert_config({**base, **changes}, MapperConfig, "test config")


def tiny_pipeline(**changes: object) -> MappingPipeline:
    """A pipeline of ``tiny_config`` and ``tiny_field``."""
    config = tiny_config(**changes)
    return MappingPipeline(config, streaming(tiny_field(), config.sampling), ROOMS)
