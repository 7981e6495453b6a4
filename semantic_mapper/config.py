"""Typed configuration with a default for every value, read from TOML. An unknown key is an error.

Every struct here is frozen; ``load_config`` fills one from a file, ``to_toml_dict`` gives it back as plain data.
"""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec

from semantic_mapper.errors import ConfigError

Positive = Annotated[float, msgspec.Meta(gt=0)]
NotNegative = Annotated[int, msgspec.Meta(ge=0)]
AtLeastZero = Annotated[float, msgspec.Meta(ge=0)]
AtLeastOne = Annotated[int, msgspec.Meta(ge=1)]
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
AtLeastTwo = Annotated[int, msgspec.Meta(ge=2)]
# Counts that memory is taken by, bounded before it is: no network, ray or store of use has more.
Channels = Annotated[int, msgspec.Meta(ge=1, le=1024)]
Layers = Annotated[int, msgspec.Meta(ge=0, le=64)]
Samples = Annotated[int, msgspec.Meta(ge=1, le=1024)]
SamplesOfTwo = Annotated[int, msgspec.Meta(ge=2, le=1024)]
Metres = Annotated[float, msgspec.Meta(gt=0, le=1000)]


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base of all configuration structs."""


class EncoderConfig(Config, frozen=True):
    """Shape of the image encoder that all kinds of fields share."""

    channels: Annotated[tuple[Channels, ...], msgspec.Meta(max_length=8)] = (
        32,
        64,
        128,
        192,
    )  # of each stage; the first works at half the size of the image
    blocks: Annotated[tuple[Layers, ...], msgspec.Meta(max_length=8)] = (1, 2, 3, 3)  # residual blocks a stage
    depth: bool = False  # whether it sees measured depth (as ``fields.surface`` puts it) beside colours


class SRayConfig(Config, frozen=True):
    """Shape of the S-Ray network; part of every checkpoint."""

    feature_dim: Channels = 32  # C of the paper
    heads: Channels = 4  # H; d_k = C / H
    encoder: EncoderConfig = EncoderConfig(depth=True)
    tau: float = 0.02  # Eq. 12: view weights lie in (tau / m, 1 / (tau m))
    positional_encoding: bool = False  # sinusoid along the ray; the paper uses none
    intra_view_attention: bool = True  # Eq. 6 to 9
    cross_view_attention: bool = True  # Eq. 10
    occlusion: bool = True  # views count by how much they see a sample; False = all alike, as in the paper
    source_labels: bool = True  # known labels of source views (finetuning keyframes) are part of their features
    attention_residual: bool = True  # M + f(M) instead of f(M) in Eq. 9 and 10; trains faster
    parity: Literal["paper", "published"] = "paper"  # "published": depart from the paper where its code does


class UNetFieldConfig(Config, frozen=True):
    """Shape of the per-image U-Net; the encoder is S-Ray's."""

    feature_dim: Channels = 32  # channels that the classifier reads
    encoder: EncoderConfig = EncoderConfig()


class NeuRayConfig(Config, frozen=True):
    """Shape of NeuRay with a semantic head; the encoder is S-Ray's."""

    feature_dim: Channels = 32  # C
    encoder: EncoderConfig = EncoderConfig()


class MVSNeRFConfig(Config, frozen=True):
    """Shape of MVSNeRF with a semantic head; the encoder is S-Ray's."""

    feature_dim: Channels = 32  # channels whose variance the cost volume holds
    encoder: EncoderConfig = EncoderConfig()
    views: Annotated[int, msgspec.Meta(ge=1, le=16)] = (
        3  # source views used: those nearest to the query; the first of them is the reference
    )
    planes: Samples = 64  # of the sweep, uniform in inverse depth
    plane_near_m: float = 0.3
    plane_far_m: float = 8.0
    volume_channels: Channels = 8  # of the neural encoding volume
    width: Channels = 64  # of the MLP
    depth: Layers = 4  # layers of the MLP
    position_frequencies: Layers = 6


class SemanticNeRFConfig(Config, frozen=True):
    """Shape of Semantic-NeRF, and the box that it can describe: one scene."""

    width: Channels = 128
    depth: Layers = 4  # layers before the heads; the encoded position enters the middle one again
    position_frequencies: Layers = 10
    direction_frequencies: Layers = 4
    centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the box, world
    half_extent_m: float = 8.0  # half the side of the box


class SamplingConfig(Config, frozen=True):
    """Where a ray is sampled."""

    mode: Literal["reference", "streaming"] = "streaming"
    coarse: SamplesOfTwo = 64  # reference: uniform in inverse depth
    fine: Samples = 64  # reference: drawn from the coarse weights
    guided: SamplesOfTwo = 8  # streaming: round the depth prior, or uniform in inverse depth where there is none
    free_space: NotNegative = 1  # of the guided samples: between the camera and the guided interval
    guided_sigma: Positive = 0.02  # half width of the guided interval: guided_sigma * z + guided_floor_m
    guided_floor_m: Positive = 0.04
    least_weight: Share = 0.0  # streaming: samples of a smaller share of their ray's weight get no look of their own
    near_m: Metres = 0.3
    far_m: Metres = 8.0

    def __post_init__(self) -> None:
        if self.far_m <= self.near_m:
            raise ValueError(f"far_m must lie beyond near_m ({self.near_m:g}), got {self.far_m:g}")
        if self.guided - self.free_space < 2:
            raise ValueError(
                f"free_space must leave at least 2 of the {self.guided} guided samples, got {self.free_space}"
            )


class KeyframeConfig(Config, frozen=True):
    """When a frame becomes a source view, and which views a query uses."""

    translation_m: Positive = 0.15  # new keyframe when moved this far from the nearest one, or ...
    rotation_deg: Positive = 12.0  # ... turned this far
    capacity: Annotated[int, msgspec.Meta(ge=1, le=4096)] = (
        64  # keyframes kept; the one whose loss costs least coverage goes first
    )
    source_views: Annotated[int, msgspec.Meta(ge=1, le=16)] = 8  # m of the paper
    use_current_view: bool = True  # the frame being mapped is itself a source view of its rendering


class VoxelMapConfig(Config, frozen=True):
    """The fused map."""

    voxel_size_m: Positive = 0.02
    truncation_voxels: Positive = 4.0
    depth_max_m: Positive = 5.0
    max_weight: Positive = 255.0  # cap of the TSDF weight, so that the map stays able to change
    initial_blocks: AtLeastOne = 2000  # capacity at start; grows by half when full
    max_blocks: AtLeastOne = 200_000  # refuse to grow past this, with a clear error
    memory_mb: NotNegative = 0  # for voxels; what was used longest ago goes to disk; 0 = no limit
    vote_discount: Share = 0.75  # rho: how much a repeated view of a voxel repeats what earlier views said
    vote_band_voxels: Positive = 2.0  # only voxels this near the surface take class votes
    evidence: Literal["float32", "int16"] = "float32"  # "int16": half the memory for classes (``mapping/evidence.py``)


class HistoryConfig(Config, frozen=True):
    """Fused frames kept on disk, so that the map can follow corrected poses (loop closures)."""

    # Corrections reach the last so many frames, and at times up to an eighth more; older ones stay in the map where
    # they are. 0 = keep none.
    max_frames: NotNegative = 0
    # In the folder for temporary files, for frames and for what the map was before each eighth of them (the blocks that
    # changed, ``mapping/map_journal``, some three times as large): the oldest eighth leaves earlier for it.
    max_disk_mb: AtLeastOne = 4000


class VirtualViewConfig(Config, frozen=True):
    """Views from where no camera stood, rendered from keyframes, that add class votes where the map is in doubt."""

    # After every so many frames, in time that ``render.target_hz`` knows nothing of; 0 = only where asked for.
    every_n_frames: NotNegative = 0
    views: Annotated[int, msgspec.Meta(ge=1, le=64)] = 1  # at a time
    weight: Annotated[float, msgspec.Meta(gt=0, lt=1)] = 0.3  # of their votes, against those of a frame
    max_votes: Positive = 0.3  # only voxels with fewer take theirs; a frame's vote from up to 2 m, head on, is 1
    keyframes: AtLeastTwo = 2  # that must see a surface for a virtual view to look at it


class RenderConfig(Config, frozen=True):
    """Resolution and chunking of the rendered view."""

    # Rendered rays a side, relative to the frame; lifted to full size along image edges.
    scale: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.25
    # 1 = rays for all its pixels; below, for every fourth a side and, up to this share, where these do not tell enough.
    share: Share = 0.2
    blind_samples: SamplesOfTwo = 32  # a ray, of views of which neither sensor nor map knows any depth
    target_hz: Annotated[float, msgspec.Meta(ge=0)] = (
        0.0  # hold this rate by fewer rays and samples than set; 0 = off, for maps that repeat
    )
    encode_width: Annotated[int, msgspec.Meta(ge=0, le=4096)] = (
        0  # of the source images when they are encoded; 0 = what the weights were trained at
    )
    rays_per_chunk: Annotated[int, msgspec.Meta(ge=0, le=1 << 20)] = 0  # 0 = 2,048 on a CPU, 32,768 on a GPU
    device: Literal["cpu", "cuda"] = "cpu"  # where views are encoded and rendered; the map is always the CPU's
    bfloat16: bool = False  # on a GPU: networks compute in bfloat16; geometry and logits never do

    def __post_init__(self) -> None:
        if self.bfloat16 and self.device == "cpu":
            raise ValueError('bfloat16 is for device = "cuda"')


Quality = Literal["custom", "fast", "balanced", "reference"]
QUALITIES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {  # of ``sampling`` and of ``render``
    "fast": ({"mode": "streaming", "guided": 2, "free_space": 0, "least_weight": 0.05}, {"share": 0.12}),
    "balanced": ({"mode": "streaming", "guided": 4, "free_space": 1, "least_weight": 0.02}, {"share": 0.2}),
    "reference": ({"mode": "reference", "coarse": 64, "fine": 64}, {"share": 1.0, "target_hz": 0.0}),
}


class MapperConfig(Config, frozen=True):
    """Everything ``MappingPipeline`` needs. The defaults are those of the "balanced" quality."""

    sampling: SamplingConfig = SamplingConfig(guided=4, least_weight=0.02)
    keyframes: KeyframeConfig = KeyframeConfig()
    voxel_map: VoxelMapConfig = VoxelMapConfig()
    history: HistoryConfig = HistoryConfig()
    virtual: VirtualViewConfig = VirtualViewConfig()
    render: RenderConfig = RenderConfig()
    quality: Quality = "custom"  # any other sets samples and rays; see ``with_quality``
    seed: int = 0


def with_quality(config: MapperConfig) -> MapperConfig:
    """The config with the settings that its ``quality`` stands for; "custom" leaves all as they are.

    "reference" renders all rays with 64 + 64 samples, "balanced" and "fast" at most 0.2 and 0.12 of them, with 4 and 2
    samples near the depth prior. Whatever the config says of these settings is replaced; see ``check_quality``.
    """
    if config.quality == "custom":
        return config
    sampling, render = msgspec.to_builtins(config.sampling), msgspec.to_builtins(config.render)
    samples, rays = QUALITIES[config.quality]
    return msgspec.structs.replace(
        config,
        sampling=msgspec.convert({**sampling, **samples}, SamplingConfig),
        render=msgspec.convert({**render, **rays}, RenderConfig),
    )


def check_quality(data: Mapping[str, Any], quality: Quality, where: str) -> None:
    """Refuse what a file says of settings that a quality sets otherwise: one of the two would be without effect.

    Args:
        data: The mapper's config as the file has it, of the right form.
        quality: In force, whether the file asks for it or somebody else.
        where: The file's name.

    Raises:
        ConfigError: names the settings.
    """
    if quality == "custom":
        return
    clashes = [
        f"{section}.{name} = {data[section][name]!r} ({quality}: {value!r})"
        for section, settings in zip(("sampling", "render"), QUALITIES[quality], strict=True)
        for name, value in settings.items()
        if data.get(section, {}).get(name, value) != value
    ]
    if clashes:
        raise ConfigError(
            f'{where}: quality "{quality}" sets these settings of the file otherwise: {", ".join(clashes)}; leave them '
            'out, or the quality, or ask for quality "custom"'
        )


ConfigT = TypeVar("ConfigT", bound=msgspec.Struct)


def load_config(path: Path, kind: type[ConfigT]) -> ConfigT:
    """Read a TOML file onto ``kind``.

    Raises:
        ConfigError: file missing, not TOML, unknown key (with the nearest valid one), or a value of the wrong type.
    """
    return convert_config(read_toml(path), kind, str(path))


def read_toml(path: Path) -> dict[str, Any]:
    """A TOML file as plain data.

    Raises:
        ConfigError: file missing, or not TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: no such file") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from error


def convert_config(data: Any, kind: type[ConfigT], where: str) -> ConfigT:
    """Check plain data against ``kind``; see ``load_config``."""
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{where}: {error}{_nearest_key(str(error), kind)}") from error


def to_plain(config: msgspec.Struct) -> dict[str, Any]:
    """Config -> nested dicts and lists of plain values."""
    return msgspec.to_builtins(config)


def _nearest_key(message: str, kind: type[msgspec.Struct]) -> str:
    if "unknown field" not in message:
        return ""
    wrong = message.split("unknown field")[1].split("`")[1]
    keys = sorted(_keys_at(message, kind) - {wrong})
    near = difflib.get_close_matches(wrong, keys, n=1, cutoff=0.5)
    return f"; did you mean `{near[0]}`?" if near else f"; valid keys are {', '.join(keys)}"


def _keys_at(message: str, kind: type[msgspec.Struct]) -> set[str]:
    """Keys of the section that msgspec names ("... - at `$.voxel_map`"), else of all sections."""
    path = message.rpartition(" - at `$.")[2].rstrip("`").split(".") if " - at `$." in message else []
    section = kind
    for name in path:
        inner = next((item.type for item in msgspec.structs.fields(section) if item.name == name), None)
        if not (isinstance(inner, type) and issubclass(inner, msgspec.Struct)):
            return _all_keys(kind)
        section = inner
    return {item.name for item in msgspec.structs.fields(section)}


def _all_keys(kind: type[msgspec.Struct]) -> set[str]:
    keys: set[str] = set()
    for item in msgspec.structs.fields(kind):
        keys.add(item.name)
        if isinstance(item.type, type) and issubclass(item.type, msgspec.Struct):
            keys |= _all_keys(item.type)
    return keys
