"""The map of a stream of frames, in this process: weights, renderer and pipeline in one object."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace

from semantic_mapper.config import MapperConfig, SRayConfig, load_config, with_quality
from semantic_mapper.errors import WeightsError
from semantic_mapper.fields.base import StreamField
from semantic_mapper.fields.domain_check import find_domain_check
from semantic_mapper.fields.streaming import StreamingSRay
from semantic_mapper.fields.weights import WeightsFile, default_checkpoint_path, load_weights
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import MapUpdate, PosedFrame

if TYPE_CHECKING:
    from semantic_mapper.fields.learned import LearnedField


@dataclass(frozen=True, slots=True, eq=False)
class Mapper:
    """A mapping pipeline and the weights that it renders with; ``Mapper.load`` makes one."""

    pipeline: MappingPipeline  # what every frame goes through, live or replayed
    weights: WeightsFile  # what the field is made of, its classes and its training
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
        path = default_checkpoint_path() if weights is None else Path(weights)
        found = load_weights(path)
        if config.render.encode_width == 0:
            config = replace(config, render=replace(config.render, encode_width=found.width))
        try:
            field = make_field(found, config)
        except WeightsError as error:
            raise WeightsError(f"{path}: {error}") from error
        pipeline = MappingPipeline(config, field, found.label_set, anchors=found.anchors)
        pipeline.domain_check = find_domain_check(found, field)
        return cls(pipeline, found, path)

    @property
    def model(self) -> LearnedField:
        """The field in torch, which evaluation looks into and finetuning starts from; loads torch."""
        from semantic_mapper.fields.checkpoint import build_checkpoint

        built = getattr(self.pipeline.field, "model", None)
        return built or build_checkpoint(self.weights, self.weights_path).model

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


def make_field(weights: WeightsFile, config: MapperConfig, like: StreamField[Any] | None = None) -> StreamField[Any]:
    """The renderer that a config asks for, over given weights; of torch for all but S-Ray on the CPU.

    ``like``: one whose encoder has the same weights, which is shared where it can be. Raises ConfigError: a GPU is
    requested that is not there. WeightsError: weights that do not fit their own config."""
    if weights.kind == "sray" and config.sampling.mode == "streaming" and config.render.device == "cpu":
        assert isinstance(weights.config, SRayConfig)
        shared = like if isinstance(like, StreamingSRay) else None
        return StreamingSRay(weights.config, weights.label_set, weights.tensors, config.sampling, like=shared)
    # Loads for seconds and takes half a gigabyte.
    from semantic_mapper.fields.checkpoint import build_checkpoint
    from semantic_mapper.fields.device import DeviceField, choose_device

    model = build_checkpoint(weights).model
    device = choose_device("cuda" if config.render.device == "cuda" else "cpu", 0)
    return DeviceField(model, device, config.sampling, bfloat16=config.render.bfloat16)
