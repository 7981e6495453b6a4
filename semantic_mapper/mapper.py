"""The map of a stream of frames, in this process: weights, renderer and pipeline in one object."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from msgspec.structs import replace

from semantic_mapper.config import MapperConfig, load_config, with_quality
from semantic_mapper.fields.base import SemanticField
from semantic_mapper.fields.checkpoint import Checkpoint, default_checkpoint_path, find_checkpoint, load_checkpoint
from semantic_mapper.fields.device import DeviceField, choose_device
from semantic_mapper.fields.domain_check import find_domain_check
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.sray import SRay
from semantic_mapper.fields.streaming import StreamingSRay
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import MapUpdate, PosedFrame


@dataclass(frozen=True, slots=True, eq=False)
class Mapper:
    """A mapping pipeline and the weights that it renders with; ``Mapper.load`` makes one."""

    pipeline: MappingPipeline  # what every frame goes through, live or replayed
    checkpoint: Checkpoint  # the weights, their classes and their training
    weights_path: Path  # file that they came from

    @classmethod
    def load(cls, weights: Path | str | None = None, config: MapperConfig | Path | str | None = None) -> Mapper:
        """Load weights and build the pipeline round them; the map's classes are those of the weights.

        Raises ConfigError: a setting cannot be used, or a GPU is requested that is not there. WeightsError: missing,
        damaged or foreign weights.

        Args:
            weights: A .safetensors file; None = the weights that ship with the package.
            config: Settings, or a TOML file of them; None = the defaults.
        """
        if not isinstance(config, MapperConfig):
            config = MapperConfig() if config is None else load_config(Path(config), MapperConfig)
        config = with_quality(config)
        path = default_checkpoint_path() if weights is None else find_checkpoint(Path(weights))
        checkpoint = load_checkpoint(path)
        if config.render.encode_width == 0:
            config = replace(config, render=replace(config.render, encode_width=checkpoint.width))
        field = make_field(checkpoint.model, config)
        pipeline = MappingPipeline(config, field, checkpoint.label_set, anchors=checkpoint.anchors)
        network = field.model if isinstance(field, DeviceField) else checkpoint.model
        pipeline.domain_check = find_domain_check(checkpoint, network)
        return cls(pipeline, checkpoint, path)

    @property
    def voxel_map(self) -> VoxelMap:
        """The map so far."""
        return self.pipeline.voxel_map

    @property
    def label_set(self) -> LabelSet:
        """Classes of the map."""
        return self.pipeline.label_set

    def step(self, frame: PosedFrame) -> MapUpdate:
        """Fuse one frame into the map; see ``MappingPipeline.step``.

        Raises FrameError: the frame cannot be used; the map is as it was.
        """
        return self.pipeline.step(frame)


def make_field(model: LearnedField, config: MapperConfig) -> SemanticField:
    """The renderer that a config asks for, over given weights.

    With ``sampling.mode = "streaming"`` and a model that the compiled renderer covers it is that renderer; otherwise,
    and on a GPU, it is the eager one. Raises ConfigError: ``render.device = "cuda"`` where torch sees no GPU.
    """
    if config.render.device == "cuda":
        return DeviceField(model, choose_device("cuda", 0), config.sampling, bfloat16=config.render.bfloat16)
    if isinstance(model, SRay) and config.sampling.mode == "streaming":
        return StreamingSRay(model, config.sampling)
    model.sampling = config.sampling
    return model
