"""Typed configuration with a default for every value, read from TOML. An unknown key is an error.

Every struct here is frozen; ``load_config`` fills one from a file, ``to_toml_dict`` gives it back as plain data.
"""

import difflib
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar

import msgspec
from msgspec import inspect

from semantic_mapper.errors import ConfigError
from semantic_mapper.files import decode_text, read_regular

MAX_FILE_BYTES = 1 << 20  # of a file of settings
MAX_NUMBER = 1e12  # the largest float of any setting
MAX_DURATION_S = 1e6  # eleven days; the longest time that every system call takes in milliseconds
MAX_COUNT = 2**31 - 1
MAX_STORED = 2**63 - 1  # the largest whole number: stamps in nanoseconds
_MESSAGE = 400  # letters of what a file says, in a message

Positive = Annotated[float, msgspec.Meta(gt=0, le=1e6)]
NotNegative = Annotated[int, msgspec.Meta(ge=0)]
AtLeastZero = Annotated[float, msgspec.Meta(ge=0)]
HeightM = Annotated[float, msgspec.Meta(ge=0, le=20)]  # of a camera over a floor: more are other units
AtLeastOne = Annotated[int, msgspec.Meta(ge=1, le=MAX_COUNT)]
Fraction = Annotated[float, msgspec.Meta(ge=0, le=1)]
AtLeastTwo = Annotated[int, msgspec.Meta(ge=2, le=MAX_COUNT)]
# Counts that memory is taken by, bounded before it is: no network, ray or store of use has more.
Channels = Annotated[int, msgspec.Meta(ge=1, le=1024)]
Layers = Annotated[int, msgspec.Meta(ge=0, le=64)]
Samples = Annotated[int, msgspec.Meta(ge=1, le=1024)]
SamplesOfTwo = Annotated[int, msgspec.Meta(ge=2, le=1024)]
Metres = Annotated[float, msgspec.Meta(gt=0, le=1000)]
DeviceName = Literal["auto", "cpu", "cuda"]  # "auto": a GPU where there is one


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base of all configuration structs."""


class EncoderConfig(Config, frozen=True):
    """Shape of the image encoder that all kinds of fields share."""

    # of each stage; the first works at half the size of the image
    channels: Annotated[tuple[Channels, ...], msgspec.Meta(max_length=8)] = (32, 64, 128, 192)
    blocks: Annotated[tuple[Layers, ...], msgspec.Meta(max_length=8)] = (1, 2, 3, 3)  # residual blocks a stage
    # "efficientnet-lite0": a network that may start from ImageNet weights, between a small stem and a decoder;
    # ``channels`` and ``blocks`` are the decoder's then
    backbone: Literal["residual", "efficientnet-lite0"] = "residual"
    depth: bool = False  # whether it sees measured depth (as ``fields.surface_maps`` puts it) next to colours
    # Whether it has learned from depth that was computed from pictures, too (``pool.computed_depth`` of a training).
    # An encoder that has not is shown none: it would be misled.
    computed_depth: bool = False

    def __post_init__(self) -> None:
        channels, blocks, pretrained = self.channels, self.blocks, self.backbone != "residual"
        if not channels or len(channels) != len(blocks) or min(channels) < 1 or min(blocks) < 1 - pretrained:
            raise ConfigError(
                "encoder: channels and blocks need one positive number a stage each; "
                f"got {list(channels)} and {list(blocks)}"
            )
        if pretrained and (not 2 <= len(channels) <= 5 or blocks[-1] != 0):
            raise ConfigError(
                "encoder: this backbone has 2 to 5 stages, the last one without blocks (0); got "
                f"{list(channels)} and {list(blocks)}"
            )


class SRayConfig(Config, frozen=True):
    """Shape of the S-Ray network; part of every checkpoint."""

    feature_dim: Channels = 32  # C of the paper
    heads: Channels = 4  # H; d_k = C / H
    encoder: EncoderConfig = EncoderConfig(depth=True)
    # What attention and view weights work on: one token a view, at the surface that the ray meets (untrained, a vote of
    # the views); or, as in the paper, one token a view and sample. "surface" also compares the views' colours, and
    # takes a lens's focal length into account where it predicts depth
    tokens: Literal["surface", "samples"] = "surface"
    intra_view_attention: bool = False  # Eq. 6 to 9, in the paper's order
    cross_view_attention: bool = True  # Eq. 10


class UNetFieldConfig(Config, frozen=True):
    """Shape of the per-image U-Net; the encoder is S-Ray's."""

    feature_dim: Channels = 32  # channels that the classifier reads
    encoder: EncoderConfig = EncoderConfig()


class GridConfig(Config, frozen=True):
    """The box of a scene grid: its vertices lie at ``origin_m`` + ``voxel_m`` * (i, j, k) in the world."""

    origin_m: tuple[float, float, float] = (-4.0, -4.0, -1.0)
    voxel_m: Positive = 0.1
    shape: tuple[AtLeastTwo, AtLeastTwo, AtLeastTwo] = (81, 81, 41)  # vertices along x, y and z


class GridFieldConfig(Config, frozen=True):
    """A scene grid as a field."""

    grid: GridConfig = GridConfig()
    # Features a vertex of a grid of half the resolution, for colours that depend on the direction and for kinds that
    # read classes from them; 0 = none
    features: Annotated[int, msgspec.Meta(ge=0, le=64)] = 0
    trunk_width: Channels = 128  # of the MLP behind the features


IRTVariant = Literal["B", "BC", "RT", "RTT", "RTC", "RTTC"]


class IRTConfig(GridFieldConfig, frozen=True):
    """Shape of an Implicit Ray-Transformer: a scene grid with features, and what reads classes from it."""

    features: Annotated[int, msgspec.Meta(ge=1, le=64)] = 16
    trunk_width: Channels = 64
    # B: each point by itself. RT: the points of a ray attend to each other. RTT: with a token of the image's texture.
    # BC, RTC: texture next to the composited points. RTTC: token and texture
    variant: IRTVariant = "BC"
    # Labelled frames whose labels are carried over to where their surface is seen again, and the size of their images;
    # 0 = labels only teach
    carried: NotNegative = 0
    carried_size: tuple[AtLeastOne, AtLeastOne] = (1, 1)  # height and width


class BoxConfig(Config, frozen=True):
    """A primitive that a field was fitted with (``fields.scene.primitives.Primitive``)."""

    id: Annotated[int, msgspec.Meta(ge=1, le=65535)]
    class_name: str
    shape: Literal["box", "ellipsoid", "prism", "mesh"]
    T_world_box: tuple[tuple[float, float, float, float], ...]
    size: tuple[float, float, float]
    thing: bool
    polygon: tuple[tuple[float, float], ...] | None = None
    vertices: tuple[tuple[float, float, float], ...] | None = None
    faces: tuple[tuple[int, int, int], ...] | None = None
    stamps: tuple[tuple[int, tuple[tuple[float, float, float, float], ...]], ...] | None = None  # of one that moves


class PanopticConfig(GridFieldConfig, frozen=True):
    """Shape of a Panoptic NeRF: a scene grid with features, a head for classes, and boxes."""

    features: Annotated[int, msgspec.Meta(ge=1, le=64)] = 16
    trunk_width: Channels = 64
    # What may be outside of all boxes. stuff: the classes that are no things, and those that no box has that stands
    # still. empty: nothing
    uncovered: Literal["stuff", "empty"] = "stuff"
    classes: Literal["learned", "fixed"] = "learned"  # what is rendered; fixed: what the boxes say, as an ablation
    boxes: tuple[BoxConfig, ...] = ()
    merge: dict[str, tuple[str, ...]] = {}  # by class of the pseudo labels: those that they cannot tell from it


class SamplingConfig(Config, frozen=True):
    """Where a ray is sampled."""

    mode: Literal["reference", "streaming"] = "streaming"
    coarse: SamplesOfTwo = 64  # reference: uniform in inverse depth
    fine: Samples = 64  # reference: drawn from the coarse weights
    guided: SamplesOfTwo = 8  # streaming: round the depth prior, or uniform in inverse depth without one
    free_space: NotNegative = 1  # of the guided samples: between the camera and the guided interval
    guided_sigma: Positive = 0.02  # half width of the guided interval: guided_sigma * z + guided_floor_m
    guided_floor_m: Positive = 0.04
    # streaming: samples with a smaller fraction of their ray's weight are pruned: they take no part in the attention
    sample_weight_threshold: Fraction = 0.0
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

    translation_m: Positive = 0.15  # new keyframe when moved this far from the nearest one, or turned by 12 degrees
    # keyframes kept; the one whose loss costs least coverage goes first
    capacity: Annotated[int, msgspec.Meta(ge=1, le=4096)] = 64
    source_views: Annotated[int, msgspec.Meta(ge=1, le=16)] = 8  # m of the paper
    use_current_view: bool = True  # the frame being mapped is itself a source view of its rendering
    # Weight of what its image says by itself, against the rendered view, in what it tells the map; its own labels are
    # those of the rendered view. A quarter of it where finetuned keyframes are among the source views.
    own_image_weight: Fraction = 0.8
    # Whether the map keeps features of views that its sensor measured (45 kB each, 300 at most), by which it is found
    # again: `query MAP relocalize LOG`, `up --set mapper.map=...`, `merge`. Images can be guessed from them.
    save_places: bool = True


class VoxelMapConfig(Config, frozen=True):
    """The fused map."""

    voxel_size_m: Annotated[float, msgspec.Meta(ge=1e-4, le=10)] = 0.02  # edge of a voxel, metres
    depth_max_m: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 5.0
    max_blocks: AtLeastOne = 200_000  # refuse to grow past this, with a clear error
    memory_mb: NotNegative = 0  # for voxels; what was used longest ago goes to disk; 0 = no limit
    # Labels of less confidence read as unknown, 0 = none do. Below 0.5 a label is more likely wrong than right
    unknown_below: Fraction = 0.5
    clear_free_space: bool = True  # forget surfaces that frames with sensor depth see through (``mapping/clearing.py``)

    # The same for all maps:
    truncation_voxels: ClassVar[float] = 4.0
    max_weight: ClassVar[float] = 255.0  # cap of the TSDF weight and of votes, so that the map stays able to change
    initial_blocks: ClassVar[int] = 2000  # capacity at start; grows by half when full
    vote_discount: ClassVar[float] = 0.75  # rho: how much a view of a voxel repeats what earlier views said
    vote_band_voxels: ClassVar[float] = 2.0  # only voxels this near the surface take class votes


class PoseRefinerConfig(Config, frozen=True):
    """How given poses are made to fit the pictures; see ``bundle/refiner.py``."""

    # One sigma of given poses where frames tell none (``pose_sigma`` 0), to a twentieth where they fit pictures ...
    sigma_m: Positive = 0.02
    sigma_deg: Positive = 0.5  # ... and of their rotations


class HistoryConfig(Config, frozen=True):
    """Fused frames kept on disk, so that the map can follow corrected poses (loop closures)."""

    # Corrections reach at least the last this many frames, at most twice as many; older ones stay put. 0 = none.
    max_frames: NotNegative = 0
    # In the folder for temporary files; the oldest frames leave earlier for it.
    max_disk_mb: AtLeastOne = 4000


class VirtualViewConfig(Config, frozen=True):
    """Views from where no camera stood, rendered from keyframes, that add class votes where the map is unsure."""

    # One after every n frames, in time that ``render.target_hz`` knows nothing of; 0 = only where requested.
    every_n_frames: NotNegative = 0


class RenderConfig(Config, frozen=True):
    """Resolution and chunking of the rendered view."""

    # Rendered rays a side, relative to the frame; upsampled to full size along image edges.
    scale: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.25
    # 1 = rays for all its pixels; below, for every fourth a side and, up to this fraction, where these are uncertain.
    ray_fraction: Fraction = 0.2
    # hold this rate by fewer rays and samples than set; 0 = off, for maps that repeat
    target_hz: Annotated[float, msgspec.Meta(ge=0, le=1000)] = 0.0
    # Of the source images when they are encoded; 0 = what the weights were trained at.
    encode_width: Annotated[int, msgspec.Meta(ge=0, le=4096)] = 0
    device: Literal["cpu", "cuda"] = "cpu"  # where views are encoded and rendered; the map is always the CPU's
    bfloat16: bool = False  # on a GPU: networks compute in bfloat16; geometry and logits never do

    def __post_init__(self) -> None:
        if self.bfloat16 and self.device == "cpu":
            raise ValueError('bfloat16 is for device = "cuda"')


class DepthFromMotionConfig(Config, frozen=True):
    """How depth is computed from posed pictures, where no sensor measures it."""

    width: Annotated[int, msgspec.Meta(ge=32, le=1280)] = 160  # pixels that are matched; more cost time, not error
    planes: Annotated[int, msgspec.Meta(ge=16, le=256, multiple_of=16)] = 64  # depths tried, uniform in inverse depth
    near_m: Metres = 0.4
    far_m: Metres = 8.0
    # A frame waits for this many later ones, which see it from the other side: more accurate. 0 = live.
    delay_frames: Annotated[int, msgspec.Meta(ge=0, le=64)] = 0

    def __post_init__(self) -> None:
        if not self.near_m < self.far_m:
            raise ValueError(f"near_m = {self.near_m} must be less than far_m = {self.far_m}")


DepthSource = Literal["auto", "sensor", "computed", "off"]


class DepthConfig(Config, frozen=True):
    """Where the depth of frames comes from."""

    # "auto": the sensor's, else computed from pictures; "computed": always; "sensor": rendered by the field where a
    # frame has none; "off": always rendered
    source: DepthSource = "auto"
    from_motion: DepthFromMotionConfig = DepthFromMotionConfig()
    # Whether given poses are made to fit the pictures where depth is computed from these; without, poses that are some
    # pixels off give depth that is far off.
    refine_poses: bool = True  # in images from 320 pixels of width on
    # Whether bundles of poses run in a thread of their own, so that no frame waits for them; poses then depend on the
    # time that they take. A mapper whose ``delivery`` is "newest" does so.
    refine_in_background: bool = False
    poses: PoseRefinerConfig = PoseRefinerConfig()


Quality = Literal["custom", "fast", "balanced", "reference"]
QUALITIES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {  # of ``sampling`` and of ``render``
    "fast": (
        {"mode": "streaming", "guided": 2, "free_space": 0, "sample_weight_threshold": 0.05},
        {"ray_fraction": 0.12},
    ),
    "balanced": (
        {"mode": "streaming", "guided": 4, "free_space": 1, "sample_weight_threshold": 0.02},
        {"ray_fraction": 0.2},
    ),
    "reference": ({"mode": "reference", "coarse": 64, "fine": 64}, {"ray_fraction": 1.0, "target_hz": 0.0}),
}


class MovingConfig(Config, frozen=True):
    """What moves is left out of the map (``mapping/moving.py``): it would be a wall where it has gone by."""

    motion: bool = True  # where measured depth shows something in space that was free within the last seconds
    classes: bool = False  # where the rendered class moves by itself (``labels.MOVING_NAMES``)


class SegmenterConfig(Config, frozen=True):
    """A network that has seen photographs, next to the field (``mapping/segmenter.py``)."""

    # Its table (.toml), next to an ONNX or OpenVINO model; "" = none. ``moving.classes`` leaves its people and vehicles
    # out
    table: str = ""
    # Of so many frames it sees one; the others take its answer over by depth
    every_n_frames: AtLeastOne = 8


class MapperConfig(Config, frozen=True):
    """Everything ``MappingPipeline`` needs. The defaults are those of the "balanced" quality."""

    sampling: SamplingConfig = SamplingConfig(guided=4, sample_weight_threshold=0.02)
    depth: DepthConfig = DepthConfig()
    keyframes: KeyframeConfig = KeyframeConfig()
    voxel_map: VoxelMapConfig = VoxelMapConfig()
    history: HistoryConfig = HistoryConfig()
    virtual: VirtualViewConfig = VirtualViewConfig()
    moving: MovingConfig = MovingConfig()
    segmenter: SegmenterConfig = SegmenterConfig()
    render: RenderConfig = RenderConfig()
    quality: Quality = "custom"  # few, some or all rays; "custom": as set
    seed: Annotated[int, msgspec.Meta(ge=0)] = 0  # of everything that is drawn at random


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
    """Refuse what the file ``where`` says, ``data`` of the right form, of settings that the quality in force sets
    otherwise: one of the two would be without effect. Raises ConfigError: names the settings.
    """
    if quality not in QUALITIES:  # "custom"; what is not valid at all is refused with the other settings
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

    Raises ConfigError: file missing, not TOML, unknown key (with the nearest valid one), or a value of the wrong type.
    """
    return convert_config(read_toml(path), kind, str(path))


def load_mapper_config(
    path: Path | None, settings: Mapping[str, Any] | None = None, defaults: Mapping[str, Any] | None = None
) -> MapperConfig:
    """The mapper's config: a TOML file, what goes before it, and what stands in where it says nothing.

    ``settings`` by dotted name ("voxel_map.voxel_size_m") replace what the file says (None = not given); ``defaults``
    stand in for what neither says. Raises ConfigError: see ``load_config`` and ``check_quality``.
    """
    data = read_toml(path) if path else {}
    where = str(path) if path else "settings of the mapper"
    in_file = convert_config(data, MapperConfig, where)
    given = {name: value for name, value in (settings or {}).items() if value is not None}
    check_quality(data, given.get("quality", in_file.quality), where)
    for name, value in (defaults or {}).items():
        assign(data, name, value, where, replace=False)
    for name, value in given.items():
        assign(data, name, value, where)
    return convert_config(data, MapperConfig, where)


def parse_assignments(texts: Iterable[str], kind: type[msgspec.Struct]) -> dict[str, Any]:
    """What ``--set NAME=VALUE`` says, by dotted name; values as of ``parse_value``. Raises ConfigError: not of this
    form, or ``kind`` has no such setting (the nearest one is named)."""
    found = {name: parse_value(value) for name, value in map(split_assignment, texts)}
    known = list(setting_names(kind)) if found else []
    for name in found:
        if not any(f"{name}.".startswith(f"{k}.") or k.startswith(f"{name}.") for k in known):
            by_last = {k.rpartition(".")[2]: k for k in known} | {k: k for k in known}
            near = difflib.get_close_matches(name, by_last, n=1, cutoff=0.5)
            hint = f"did you mean `{by_last[near[0]]}`?" if near else "docs/settings.md lists all"
            raise ConfigError(f"--set {name}: there is no such setting; {hint}")
    return found


def setting_names(kind: type[msgspec.Struct], prefix: str = "") -> Iterator[str]:
    """Dotted names of the settings of a struct, and of the structs in it."""
    for item in msgspec.structs.fields(kind):
        if isinstance(item.type, type) and issubclass(item.type, msgspec.Struct):
            yield from setting_names(item.type, f"{prefix}{item.encode_name}.")
        else:
            yield prefix + item.encode_name


def split_assignment(text: str) -> tuple[str, str]:
    """Name and value of NAME=VALUE. Raises ConfigError: not of this form."""
    name, equals, value = text.partition("=")
    if not equals or not name:
        raise ConfigError(f"--set {text}: write NAME=VALUE; docs/settings.md lists the names")
    return name, value


def parse_value(text: str) -> Any:
    """A value as in TOML; bare words are text."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):  # a path, or a number of thousands of digits
        return text


def assign(data: dict[str, Any], name: str, value: Any, where: str, *, replace: bool = True) -> None:
    """Set a value of nested tables by its dotted name, making the tables on the way.

    ``replace`` says whether a value that is there gives way; ``where`` names the file in messages. Raises ConfigError:
    a part of the name is a value already, not a table.
    """
    *tables, last = name.split(".")
    for key in tables:
        inner = data.setdefault(key, {})
        if not isinstance(inner, dict):
            raise ConfigError(f"{where}: {name}: `{key}` is a value, not a table")
        data = inner
    if replace or last not in data:
        data[last] = value


def read_toml(path: Path) -> dict[str, Any]:
    """A TOML file as plain data.

    Raises ConfigError: file missing, no regular file, larger than ``MAX_FILE_BYTES``, or not TOML.
    """
    text = _read(path)
    try:
        return tomllib.loads(text.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:  # of TOML, UTF-8, and whole numbers of thousands of digits
        raise ConfigError(f"{path}: not valid TOML: {error}") from error


JsonT = TypeVar("JsonT")


def read_json(path: Path, kind: type[JsonT], limit: int = MAX_FILE_BYTES) -> JsonT:
    """A JSON file of at most ``limit`` bytes as ``kind`` (``dict`` or a struct).

    Raises ConfigError: file missing, no regular file, larger than ``limit``, not JSON, of another form, or with a
    number that nothing has.
    """
    try:
        data = msgspec.json.decode(decode_text(_read(path, limit)), type=kind)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{path}: {error}") from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"{path}: not valid JSON: {error}") from error
    check_values(msgspec.to_builtins(data), str(path))
    return data


def convert_config(data: Any, kind: type[ConfigT], where: str) -> ConfigT:
    """Check plain data against ``kind``; see ``load_config``.

    Raises ConfigError: an unknown key (with the nearest valid one), a value of the wrong type or out of its range, or
    one that ``check_values`` refuses.
    """
    check_values(data, where)
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{where}: {_explain(str(error), kind)[:_MESSAGE]}") from error


def check_values(data: Any, where: str, name: str = "") -> None:
    """Refuse what no setting can be: numbers that are not finite or too large to compute with, text that is no name.

    ``where`` and the dotted ``name`` of the setting are for messages. Raises ConfigError: names the setting.
    """
    match data:
        case Mapping():
            for key, value in data.items():
                check_values(value, where, f"{name}.{key}" if name else str(key))
        case list() | tuple():
            for number, value in enumerate(data):
                check_values(value, where, f"{name}[{number}]")
        case int() | float():
            limit = MAX_DURATION_S if name.endswith("_s") else MAX_STORED if isinstance(data, int) else MAX_NUMBER
            if not -limit <= data <= limit:  # NaN is not, either
                text = f"{data:g}" if isinstance(data, float) else f"a number of {data.bit_length()} bits"
                raise ConfigError(f"{where}: {name} = {text}: give a number between -{limit:g} and {limit:g}")
        case str() if re.search("[\0\ud800-\udfff]", data):  # halves of pairs: what the command line cannot decode
            raise ConfigError(f"{where}: {name} holds a NUL character or is not UTF-8, as no path and no name may")
        case _:
            pass


def _read(path: Path, limit: int = MAX_FILE_BYTES) -> bytes:
    try:
        return read_regular(path, limit)
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: no such file{nearest_path(path)}") from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror or error})") from error


def to_plain(config: msgspec.Struct) -> dict[str, Any]:
    """Config -> nested dicts and lists of plain values."""
    return msgspec.to_builtins(config)


_TOML_WORDS = {
    "str": "a text",
    "int": "a whole number",
    "float": "a number",
    "bool": "true or false",
    "array": "a list",
    "object": "a table",
    "null": "empty",
}


def _explain(message: str, kind: type[msgspec.Struct]) -> str:
    """msgspec's message for the author of the file: which key, what it must be, the nearest valid name."""
    what, _, path = message.partition(" - at `$")
    path = path.rstrip("`").removeprefix(".")
    at = f"`{path}`: " if path else ""
    found = re.fullmatch(r"(\D*?)[`'](.*?)[`'](?:, got `(\w+)`)?", what, re.DOTALL)
    if found is None:
        return f"{at}{what}"
    text, name, actual = found.groups()
    if "missing required field" in text:
        return f"{at}the key `{name}` is missing"
    if "unknown field" in text or "enum value" in text:
        places = _types_at(path, kind)
        keys = {item.encode_name for at in places for item in getattr(at, "fields", ())}
        values = {str(value) for at in places for value in getattr(at, "values", ())}
        wrong = f"unknown key `{name}`" if "unknown field" in text else f"'{name}' is not valid"
        return f"{at}{wrong}{nearest(name[:_MESSAGE], sorted(keys | values))}"
    if actual is not None:
        wanted = " or ".join(_TOML_WORDS.get(word, word) for word in name.split(" | "))
        return f"{at}must be {wanted}, not {_TOML_WORDS.get(actual, actual)}"
    return f"{at}{what}"


def nearest(wrong: str, valid: Sequence[str]) -> str:
    """How a message about a wrong name ends: with the valid one that is nearest, else with all."""
    near = difflib.get_close_matches(wrong, valid, n=3, cutoff=0.5)
    near.sort(key=lambda name: sorted(name) != sorted(wrong))  # letters that have changed places come first
    return f"; did you mean `{near[0]}`?" if near else f"; there are {', '.join(valid) or 'none'}"


def nearest_path(path: Path) -> str:
    """How a message about a path that is missing ends: with the one whose name is nearest, if any is near."""
    with suppress(OSError, ValueError):  # a folder that cannot be listed; nothing is missing
        *_, wrong = (part for part in (path, *path.parents) if not part.exists())
        near = difflib.get_close_matches(wrong.name, sorted(p.name for p in wrong.parent.iterdir()), n=1)
        return f"; did you mean `{wrong.with_name(near[0]) / path.relative_to(wrong)}`?" if near else ""
    return ""


def _types_at(path: str, kind: type[msgspec.Struct]) -> list[inspect.Type]:
    """What a value may be at a place that msgspec names ("node[0].kind"), unions taken apart."""
    found = _members(inspect.type_info(kind))
    for step in re.findall(r"\[[^\]]*\]|[^.\[\]]+", path):
        found = [member for outer in found for inner in _inside(outer, step) for member in _members(inner)]
    return found


def _inside(outer: Any, step: str) -> list[inspect.Type]:
    """What may stand in a value: at a field, or at any index or key."""
    fields = [item.type for item in getattr(outer, "fields", ()) if item.encode_name == step]
    inner = [getattr(outer, name) for name in ("item_type", "value_type") if hasattr(outer, name)]
    return [*fields, *inner, *getattr(outer, "item_types", ())]


def _members(found: inspect.Type) -> list[inspect.Type]:
    return [m for part in found.types for m in _members(part)] if isinstance(found, inspect.UnionType) else [found]
