"""Weights files: safetensors with everything needed to use them (model config, label set, recipe, anchors).

What reads them here needs no torch; ``checkpoint`` makes a network of them.

A finetuned file carries its *anchors*: the labelled keyframes it was finetuned on, as images at working resolution
with depth, labels and pose. They are source views of every later render in the same scene.
"""

# safetensors leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import json
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from semantic_mapper.config import Config, nearest, to_plain
from semantic_mapper.errors import SemanticMapperError, WeightsError
from semantic_mapper.fields.kinds import field_config
from semantic_mapper.files import write_bytes
from semantic_mapper.geometry import check_pose
from semantic_mapper.imaging import resize_depth, resize_label, resize_rgb, resize_spread, working_intrinsics
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import CameraIntrinsics, Float32, PosedFrame

Tensors = Mapping[str, NDArray[Any]]

FORMAT = "semantic-mapper-weights"
VERSION = 3
MAP_KIND = "nesf"  # of weights that ``fields.nesf`` reads
MESSAGE = 300  # characters of an error's message that are shown: some name every tensor
MAX_WIDTH = 4096  # as ``render.encode_width``
DEFAULT_WIDTH = 320  # of weights whose recipe does not say
DEPTH_UNITS_PER_M = 4000.0  # anchors' depth as uint16: a quarter of a millimetre, up to 16 m
# Names of modules that ``encode`` of a kind uses, where that is known.
ENCODING_PARTS = {"sray": ("encoder", "geometry_init")}
SHIPPED = Path(str(resources.files("semantic_mapper"))) / "weights"


class _Recipe(msgspec.Struct):
    width: Annotated[int, msgspec.Meta(ge=4, le=MAX_WIDTH)] = DEFAULT_WIDTH
    train_stamps_ns: list[int] = []


@dataclass(frozen=True, slots=True, eq=False)
class WeightsFile:
    """What a weights file holds."""

    kind: str  # of field
    config: Config  # of that kind: the shape of its networks
    label_set: LabelSet  # classes of the field
    tensors: Tensors  # by the names of torch's modules; float32, poses float64
    anchors: tuple[PosedFrame, ...] = ()  # Frames the field was finetuned on, at working resolution
    # How it was trained: plain data (seed, steps, seconds, figures, git revision, ``train_stamps_ns``, ...)
    recipe: dict[str, Any] = field(default_factory=dict[str, Any])

    @property
    def width(self) -> int:
        """Image width that the field was trained at, in pixels."""
        return msgspec.convert(self.recipe, _Recipe).width

    @property
    def train_stamps_ns(self) -> frozenset[int]:
        """Stamps of the frames whose labels the field has seen; evaluation leaves them out."""
        return frozenset(msgspec.convert(self.recipe, _Recipe).train_stamps_ns)


def default_checkpoint_path() -> Path:
    """The small checkpoint that ships with the package."""
    return SHIPPED / "rooms.safetensors"


def weights_bytes(weights: WeightsFile, *, half: bool = False) -> bytes:
    """The content of a weights file; with ``half`` weights are float16.
    Raises SafetensorError: tensors that the format does not know."""
    tensors = {f"model.{name}": np.asarray(t, order="C") for name, t in weights.tensors.items()}
    if half:
        for name, tensor in tensors.items():
            # Not poses (float64), which it would move, nor running variances, which span more powers of ten.
            if tensor.dtype == np.float32 and "running_" not in name:
                tensors[name] = tensor.astype(np.float16)
    metadata = describe(weights.kind, weights.config, weights.label_set, weights.recipe)
    if weights.anchors:
        anchor_tensors, metadata["anchors"] = _pack_anchors(weights.anchors)
        tensors |= anchor_tensors
    return save(tensors, metadata)


def describe(kind: str, config: Config, label_set: LabelSet, recipe: dict[str, Any]) -> dict[str, str]:
    """The metadata of a weights file."""
    return {
        "format": FORMAT,
        "version": str(VERSION),
        "field": kind,
        "model_config": json.dumps(to_plain(config)),
        "label_set": msgspec.json.encode(label_set).decode(),
        "recipe": json.dumps(recipe),
    }


def save_tensors(tensors: Tensors, path: Path, metadata: dict[str, str]) -> None:
    """``safetensors.save_file``, whole or not at all. Raises SafetensorError, OSError: it cannot be written."""
    write_bytes(path, save(dict(tensors), metadata))


def load_weights(path: Path) -> WeightsFile:
    """Read a weights file.
    Raises WeightsError: missing, damaged, of another format or version, or weights that hold NaN."""
    tensors, metadata = open_weights(path)
    if metadata.get("field") == MAP_KIND:
        raise WeightsError(f"{path}: they refine saved maps (`refine --weights`) and label no frames")
    with refusing_damage(path):
        label_set = unpack_label_set(metadata["label_set"])
        recipe = json.loads(metadata["recipe"])
        msgspec.convert(recipe, _Recipe)
        anchors = _unpack_anchors(tensors, json.loads(metadata["anchors"])) if "anchors" in metadata else ()
        kind = metadata["field"]
        config = field_config(kind, json.loads(metadata["model_config"]))
    found = {n.removeprefix("model."): t for n, t in tensors.items() if n.startswith("model.")}
    return WeightsFile(kind, config, label_set, as_float32(found, path), anchors, recipe)


def as_float32(tensors: Tensors, path: Path) -> Tensors:
    """Tensors of a file as networks take them. Raises WeightsError: they hold NaN."""
    if not all(np.isfinite(t).all() for t in tensors.values()):
        raise WeightsError(f"{path}: weights hold NaN or infinity; training diverged, train again")
    return _Widened(tensors)


class _Widened(Mapping[str, NDArray[Any]]):
    """Tensors as they are stored, of which those of 16 bits are read as float32: networks copy what they take."""

    def __init__(self, stored: Tensors) -> None:
        self._stored = stored

    def __getitem__(self, name: str) -> NDArray[Any]:
        tensor = self._stored[name]
        return tensor.astype(np.float32) if tensor.dtype == np.float16 else tensor

    def __iter__(self) -> Iterator[str]:
        return iter(self._stored)

    def __len__(self) -> int:
        return len(self._stored)


@contextmanager
def refusing_damage(path: Path) -> Generator[None]:
    """Meanwhile the metadata of a file is read. Raises WeightsError: it is damaged."""
    try:
        yield
    except (LookupError, TypeError, ValueError, ArithmeticError, RuntimeError, SemanticMapperError) as error:
        reason = " ".join(str(error).split())[:MESSAGE]
        raise WeightsError(f"{path}: its metadata is damaged: {type(error).__name__}: {reason}") from error


def open_weights(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, str]]:
    """Tensors and metadata of a weights file of this project, of any kind.
    Raises WeightsError: missing, damaged, of another format or version."""
    if path.exists() and not path.is_file():
        raise WeightsError(f"{path}: is no regular file; copy its content to one")
    if not path.exists():
        names = sorted(file.name for file in path.parent.glob("*.safetensors"))
        near = nearest(path.name, names) if names else "; without one, the weights of the package are used"
        raise WeightsError(f"{path}: no such weights file{near}")
    try:
        with safe_open(path, framework="np") as stored:
            metadata = dict(stored.metadata() or {})
            tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118 - not a dict
    except (SafetensorError, OSError) as error:
        raise WeightsError(f"{path}: not a readable safetensors file ({error}); fetch or train it again") from error
    found = metadata.get("format"), metadata.get("version")
    if found != (FORMAT, str(VERSION)):
        raise WeightsError(f"{path}: not weights of this project that this version reads ({FORMAT} {VERSION})")
    return tensors, metadata


def check_same_shape(path: Path, like: WeightsFile) -> None:
    """Make sure that a file holds weights of the same network and classes, before anything is made as it says.
    Raises WeightsError: no weights file, or one of another network or of other classes."""
    _, metadata = open_weights(path)
    with refusing_damage(path):
        shape = metadata["field"], json.loads(metadata["model_config"]), unpack_label_set(metadata["label_set"])
    if shape != (like.kind, json.loads(json.dumps(to_plain(like.config))), like.label_set):
        raise WeightsError(
            f"{path.name}: of another network than those in use, or of another label set than '{like.label_set.name}' "
            f"({len(like.label_set)} classes); finetune those in use, not others"
        )


def encode_alike(a: WeightsFile, b: WeightsFile) -> bool:
    """Whether what a field of one of two weights has encoded is, to the bit, what the other's would have made of it."""
    parts = ENCODING_PARTS.get(a.kind)
    if a.kind != b.kind or a.config != b.config or not parts:
        return False
    shared = [name for name in a.tensors if name.split(".")[0] in parts]
    return all(np.array_equal(a.tensors[name], b.tensors[name]) for name in shared)


def anchor_from_frame(frame: PosedFrame, width: int) -> PosedFrame:
    """A frame at working width, with depth rounded as the file stores it."""
    intrinsics = working_intrinsics(frame.intrinsics, width)
    depth = None if frame.depth_m is None else resize_depth(frame, intrinsics)
    return replace(
        frame,
        rgb=resize_rgb(frame, intrinsics),
        depth_m=_depth_from_units(_depth_to_units(depth)),
        depth_sigma_m=_depth_from_units(_depth_to_units(resize_spread(frame, intrinsics))),
        label=None if frame.label is None else resize_label(frame.label, intrinsics),
        label_is_pseudo=False,
        world=0,
        intrinsics=intrinsics,
    )


def _depth_to_units(depth_m: Float32 | None) -> NDArray[np.uint16] | None:
    if depth_m is None:
        return None
    return np.rint(np.clip(depth_m, 0, 65535 / DEPTH_UNITS_PER_M) * DEPTH_UNITS_PER_M).astype(np.uint16)


def _depth_from_units(units: NDArray[np.uint16] | None) -> Float32 | None:
    return None if units is None else units.astype(np.float32) / np.float32(DEPTH_UNITS_PER_M)


def _pack_anchors(anchors: Sequence[PosedFrame]) -> tuple[dict[str, NDArray[Any]], str]:
    tensors: dict[str, NDArray[Any]] = {}
    described: list[dict[str, Any]] = []
    for i, a in enumerate(anchors):
        images = {"rgb": a.rgb, "label": a.label}
        images |= {"depth": _depth_to_units(a.depth_m), "depth_sigma": _depth_to_units(a.depth_sigma_m)}
        for name, image in images.items():
            if image is not None:
                tensors[f"anchor.{i}.{name}"] = np.ascontiguousarray(image)
        k = a.intrinsics
        about = {"stamp_ns": a.stamp_ns, "seq": a.seq, "camera_id": a.camera_id}
        about |= {"intrinsics": [k.fx, k.fy, k.cx, k.cy, k.width, k.height]}
        about |= {"T_world_camera": a.T_world_camera.tolist()}
        described.append(about)
    return tensors, json.dumps(described)


def _unpack_anchors(tensors: Tensors, described: list[dict[str, Any]]) -> tuple[PosedFrame, ...]:
    anchors: list[PosedFrame] = []
    for i, d in enumerate(described):
        pose = np.array(d["T_world_camera"], np.float64)
        check_pose(pose, f"anchor {i}")
        depth, label, sigma = (tensors.get(f"anchor.{i}.{name}") for name in ("depth", "label", "depth_sigma"))
        anchors.append(
            PosedFrame(
                stamp_ns=int(d["stamp_ns"]),
                seq=int(d["seq"]),
                camera_id=str(d["camera_id"]),
                rgb=tensors[f"anchor.{i}.rgb"],
                depth_m=_depth_from_units(depth),
                depth_sigma_m=_depth_from_units(sigma),
                label=label,
                intrinsics=CameraIntrinsics(*d["intrinsics"]),
                T_world_camera=pose,
            )
        )
    return tuple(anchors)


def unpack_label_set(packed: str) -> LabelSet:
    """Classes as they stand in the metadata. Raises MsgspecError, LabelError: there is something else."""
    return msgspec.json.decode(packed, type=LabelSet)
