"""A second opinion of what a frame shows: a network for single images that has learned from photographs.

Any model in ONNX, or OpenVINO's IR, and next to it a table that says how pictures are put in and what its classes are
here. It has no vote of its own. For a class c of the map that the model has, P(answer | c) is 1 - ``miss`` where the
answer is c, ``false_alarm`` where it is another class of the map, and ``miss`` where the map lacks it. For
classes that the model lacks it is ``false_alarm`` where the answer is a class of the map, else 1 - ``false_alarm``. The
rendered probability of c times the expected likelihood of the answer, to the power ``weight``, is the joint one (Bayes'
rule, with errors of the two taken for independent). A model that misses most tables thereby says little where it sees
none, and much where it sees one.

Every n-th frame is shown to the model. Frames between take the answer over where their depth, and the pose, lead to the
surface that the answer was about; elsewhere nothing is known.
"""

# OpenVINO leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
from __future__ import annotations

import hashlib
from collections import Counter
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import cv2
import msgspec
import numpy as np
import openvino as ov

from semantic_mapper.config import Config, Fraction, Positive, SegmenterConfig, load_config, nearest, nearest_path
from semantic_mapper.errors import ConfigError, FrameError
from semantic_mapper.fields.inference import compile_request, core
from semantic_mapper.geometry import invert_pose, nearest_pixels, transform, unproject
from semantic_mapper.imaging import FrameViews
from semantic_mapper.labels import PROVIDED, LabelSet
from semantic_mapper.mapping.rendering import RenderedView
from semantic_mapper.types import Bool, CameraIntrinsics, Float32, Float64, UInt8

STEP = 32  # pixels by which the sides of pictures differ, where the model takes any: networks halve five times
MARGIN_M, MARGIN_PER_M = 0.05, 0.02  # between depth of two frames that is one surface
ROUNDING = 1e-3  # by which probabilities of a pixel may miss a sum of 1
MOVES = 0.5  # probability of classes that move from which on a pixel is one of them
MOST_CLASSES = 4096

Triple = tuple[float, float, float]


class SegmenterTable(Config, frozen=True):
    """What the table next to a model says."""

    model: str  # file, next to the table
    width: Annotated[int, msgspec.Meta(ge=STEP, le=4096)]  # of the longer side of pictures, for a model of any size
    # in the order of the outputs
    classes: Annotated[tuple[str, ...], msgspec.Meta(min_length=2, max_length=MOST_CLASSES)]
    # Class of ours, by class of the model; the model's other classes have no counterpart
    names: dict[str, str] = msgspec.field(default_factory=dict)
    moving: tuple[str, ...] = ()  # classes of the model that ``moving.classes`` leaves out of the map
    channels: Literal["rgb", "bgr"] = "rgb"
    mean: Triple = (0.0, 0.0, 0.0)  # the input is (value - mean) * scale, of values 0 to 255
    scale: Triple = (1.0, 1.0, 1.0)
    output: Literal["logits", "probabilities"] = "logits"  # of floats; whole numbers are those of classes
    output_name: str = ""  # of a model with several outputs
    temperature: Positive = 1.0  # that logits are divided by
    miss: Fraction = 0.5  # of pixels of a class of ours: those that the model gives to none
    false_alarm: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.02  # of pixels of other classes: those given to one
    weight: Fraction = 1.0
    source: str = ""  # where the model is from, for people
    licence: str = ""
    sha256: str = ""  # of the model's file; checked where there is one

    def __post_init__(self) -> None:
        for where, given in (("names", self.names), ("moving", self.moving)):
            for name in given:
                if name not in self.classes:
                    raise ValueError(f"{where}: the model has no class '{name[:80]}'{nearest(name[:80], self.classes)}")


class _Answer(NamedTuple):
    likelihood: Float32  # (h, w, G + 1) of groups of classes, and the probability that the pixel moves
    depth_m: Float32  # (h, w)
    intrinsics: CameraIntrinsics  # of (h, w)
    T_world_camera: Float64


class Opinion(NamedTuple):
    """What is known of a frame at its coarse pixels (h, w)."""

    likelihood: Float32  # (h, w, G), 1 where there is no answer
    group: tuple[int, ...]  # of each of the L classes
    moving: Bool  # (h, w)

    def join(self, view: RenderedView) -> RenderedView:
        """The view (h, w) with the joint probabilities."""
        joint = view.probabilities * self.likelihood[..., self.group]
        joint /= np.maximum(joint.sum(axis=2, keepdims=True), np.float32(1e-12))
        return view._replace(probabilities=joint)


class Segmenter:
    """A model and the answer that it gave last. Deterministic.

    Raises ConfigError: the table or the model is missing or invalid, or no class is in ``label_set`` and none moves."""

    def __init__(self, config: SegmenterConfig, label_set: LabelSet) -> None:
        path = Path(config.table)
        table = load_config(path, SegmenterTable)
        self._every = config.every_n_frames
        self._model = _Model(path.parent / table.model, table, str(path))
        used = {k: label_set.names.index(n) for k, n in table.names.items() if n in label_set.names}
        known = {name for labels in PROVIDED.values() for name in labels.names} | set(label_set.names)
        if wrong := sorted(set(table.names.values()) - known):
            raise ConfigError(f"{path}: names: no label set has '{wrong[0]}'{nearest(wrong[0], sorted(known))}")
        if not used and not table.moving:
            raise ConfigError(
                f"{path}: names: none of the classes of '{label_set.name}' is among them: "
                f"{', '.join(label_set.names)}; name at least one, or classes in `moving`"
            )
        ours = sorted(set(used.values()))
        self._group = tuple(ours.index(i) if i in ours else len(ours) for i in range(len(label_set)))
        answers = [ours.index(used[name]) if name in used else len(ours) for name in table.classes]
        self._answers, self._groups = answers, len(ours)
        self._moving = np.array([name in table.moving for name in table.classes], np.float32)
        self._use(table)
        self.moves = bool(self._moving.any())
        self._counts = Counter[str]()  # frames seen, by camera
        self._last: dict[str, _Answer] = {}

    def _use(self, table: SegmenterTable) -> None:
        likelihoods = _likelihoods(self._answers, self._groups, table.miss, table.false_alarm)
        self.table, self._columns = table, np.column_stack((likelihoods, self._moving))

    def look(self, views: FrameViews, coarse: CameraIntrinsics) -> Opinion:
        """What the model says of a frame at ``coarse`` pixels (h, w), or said of one before."""
        frame, camera = views.frame, views.frame.camera_id
        if self._counts[camera] % self._every == 0:
            values = self._ask(frame.rgb, (coarse.height, coarse.width))
            if not np.isfinite(values).all():
                raise FrameError(
                    f"frame seq={frame.seq}: the segmenter's model gives values that are no numbers for it"
                )
            self._last[camera] = _Answer(values, views.depth(coarse), coarse, frame.T_world_camera)
        else:
            values = _carried(self._last[camera], views.depth(coarse), coarse, frame.T_world_camera)
        self._counts[camera] += 1
        return Opinion(values[..., :-1], self._group, values[..., -1] >= MOVES)

    def clear(self) -> None:
        """Forget the answers: poses of frames to come are in another world."""
        self._last.clear()
        self._counts.clear()

    def _ask(self, rgb: UInt8, size: tuple[int, int]) -> Float32:
        """(h, w, G + 1) of an image (H, W, 3), at ``size``."""
        return self._likelihood(self._model.run(self._prepared(rgb)), size)

    def _prepared(self, rgb: UInt8) -> Float32:
        """What is put in, (H, W, 3), of an image."""
        height, width = self._model.input_size(rgb.shape[0], rgb.shape[1], self.table.width)
        shrinks = width < rgb.shape[1]
        picture = cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
        if self.table.channels == "bgr":
            picture = picture[..., ::-1]
        mean, scale = (np.array(of, np.float32) for of in (self.table.mean, self.table.scale))
        return (picture.astype(np.float32) - mean) * scale

    def _likelihood(self, outputs: Float32, size: tuple[int, int]) -> Float32:
        """(h, w, G + 1) of outputs (a, b, K), or numbers of classes (a, b)."""
        if outputs.ndim == 2:
            at = cv2.resize(outputs, size[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
            likelihood = self._columns[at.astype(np.int64)]
        else:
            likelihood = _probabilities(_spread(outputs, size), self.table) @ self._columns
        likelihood[..., :-1] **= np.float32(self.table.weight)
        return likelihood


class _Model:
    """A network for images of any size, or of its own. ConfigError: a file that is missing or no such network."""

    def __init__(self, path: Path, table: SegmenterTable, where: str) -> None:
        try:
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
        except OSError as error:
            hint = nearest_path(path) if isinstance(error, FileNotFoundError) else ""
            raise ConfigError(f"{where}: model: {path} cannot be read ({error.strerror}){hint}") from error
        if table.sha256 and digest != table.sha256.lower():
            raise ConfigError(f"{where}: sha256 is not that of {path} ({digest}); fetch the model again")
        try:
            self._network = network = _with_one_output(core().read_model(path), table.output_name)
            (taken,), (given,) = network.inputs, network.outputs
            self._channels_last = taken.partial_shape[3] == 3
            sides = [taken.partial_shape[i] for i in ((1, 2) if self._channels_last else (2, 3))]
            self._fixed = None if any(n.is_dynamic for n in sides) else (sides[0].get_length(), sides[1].get_length())
            self._reshape(*self.input_size(table.width, table.width, table.width))
            shape, taken_shape = list(given.get_shape()), list(taken.get_shape())
        except (RuntimeError, ValueError, IndexError) as error:
            reason = str(error).strip().splitlines()[-1][:300]
            raise ConfigError(
                f"{where}: model: {path} is no network of one picture (1, 3, H, W) or (1, H, W, 3) and one output that "
                f"OpenVINO reads ({reason})"
            ) from error
        self._count = count = len(table.classes)
        self._classes_last = len(shape) == 4 and shape[3] == count
        one = shape[1:] if len(shape) == 3 else [n for n in shape[1:] if n != 1]
        self._gives_numbers = given.element_type.is_integral() and shape[0] == 1 and len(one) == 2
        if not self._gives_numbers and (len(shape) != 4 or shape[0] != 1 or count not in (shape[1], shape[3])):
            raise ConfigError(
                f"{where}: {path} makes {shape} of {taken_shape}; it has to make {count} values a pixel, as many as "
                "`classes`, or the whole number of one, of one picture of three channels"
            )
        self._where = where
        self._requests: dict[tuple[int, int], Any] = {}
        self._try(table)

    def _try(self, table: SegmenterTable) -> None:
        """Show it a grey picture as wide as a camera's."""
        values = self.run(np.zeros((*self.input_size(480, 640, table.width), 3), np.float32))
        if self._gives_numbers:
            return
        sums = bool(values.min() >= -ROUNDING and np.abs(values.sum(axis=2) - 1).max() <= ROUNDING)
        if sums != (table.output == "probabilities"):
            raise ConfigError(
                f'{self._where}: output: "{table.output}", but values of a pixel {"sum" if sums else "do not sum"} to '
                f'1; say "{"probabilities" if sums else "logits"}"'
            )

    def input_size(self, height: int, width: int, longer: int) -> tuple[int, int]:
        """Height and width of the picture that is put in, for an image of a size."""
        if self._fixed:
            return self._fixed
        sides = (longer - STEP * round(longer * (1 - n / max(height, width)) / STEP) for n in (height, width))
        height, width = (max(STEP, n) for n in sides)
        return height, width

    def run(self, picture: Float32) -> Float32:
        """Outputs (h, w, K) of a prepared picture (H, W, 3), or numbers of classes (h, w). ConfigError: the model takes
        none of its size, or gives a class that the table lacks."""
        size = picture.shape[0], picture.shape[1]
        if size not in self._requests:
            try:
                self._reshape(*size)
                self._requests[size] = compile_request(self._network)
            except RuntimeError as error:
                reason = str(error).strip().splitlines()[-1][:300]
                raise ConfigError(
                    f"{self._where}: model: it takes no picture of {size[1]}x{size[0]} ({reason}); export it for one "
                    "size, or for any"
                ) from error
        request = self._requests[size]
        put_in = picture if self._channels_last else picture.transpose(2, 0, 1)
        request.infer([np.ascontiguousarray(put_in)[None]], share_inputs=True)
        out = np.asarray(request.get_output_tensor(0).data, np.float32)[0]
        if self._gives_numbers:
            if not 0 <= out.min() <= out.max() < self._count:
                raise ConfigError(
                    f"{self._where}: classes: the model gives classes {out.min():.0f} to {out.max():.0f}, but "
                    f"{self._count} are named, from 0; name all, in its order"
                )
            return out.reshape(out.shape[:2] if out.shape[-1] == 1 else out.shape[-2:])
        return out if self._classes_last else out.transpose(1, 2, 0)

    def _reshape(self, height: int, width: int) -> None:
        self._network.reshape([1, height, width, 3] if self._channels_last else [1, 3, height, width])


def _with_one_output(network: ov.Model, name: str) -> ov.Model:
    """The network without what only other outputs need. ValueError: it is not clear which one is meant."""
    names = [min(output.names, key=len, default=str(i)) for i, output in enumerate(network.outputs)]
    if name not in names and (name or len(names) > 1):
        raise ValueError(
            f'say `output_name = "{names[0]}"` in the table, or another of its outputs: {", ".join(names)}'
        )
    return ov.Model([network.get_results()[names.index(name) if name else 0]], network.get_parameters())  # pyright: ignore[reportGeneralTypeIssues]


def _likelihoods(answers: list[int], count: int, miss: float, false_alarm: float) -> Float32:
    """(K, G + 1): P(answer | group) of each class of the model, which is of a group, or of none: ``count``."""
    table = np.full((len(answers), count + 1), false_alarm, np.float32)
    for row, answer in zip(table, answers, strict=True):
        if answer == count:
            row[:count], row[count] = miss, 1 - false_alarm
        else:
            row[answer] = 1 - miss
    return table


def _spread(values: Float32, size: tuple[int, int]) -> Float32:
    """(h, w, K) at another size. Corners stay corners, as in networks that stride over sides of 8 n + 1 pixels."""
    (h, w), (height, width) = values.shape[:2], size
    x = np.tile(np.linspace(0, w - 1, width, dtype=np.float32), (height, 1))
    y = np.tile(np.linspace(0, h - 1, height, dtype=np.float32)[:, None], (1, width))
    parts = [cv2.remap(np.ascontiguousarray(values[..., i]), x, y, cv2.INTER_LINEAR) for i in range(values.shape[2])]
    return np.stack(parts, axis=2).astype(np.float32, copy=False)


def _probabilities(values: Float32, table: SegmenterTable) -> Float32:
    """(h, w, K) of what the model gives."""
    if table.output == "probabilities":
        return values
    values = values / np.float32(table.temperature)
    values = np.exp(values - values.max(axis=2, keepdims=True))
    return values / values.sum(axis=2, keepdims=True)


def _carried(last: _Answer, depth_m: Float32, intrinsics: CameraIntrinsics, T_world_camera: Float64) -> Float32:
    """The answer (h, w, G + 1) about surface that another frame sees at depth (h, w)."""
    values = np.ones((*depth_m.shape, last.likelihood.shape[2]), np.float32)
    values[..., -1] = 0
    rows, columns = np.nonzero(depth_m)
    points = unproject(depth_m, intrinsics)[rows, columns]
    seen = transform(invert_pose(last.T_world_camera) @ T_world_camera, points)
    inside, v, u = nearest_pixels(seen, last.intrinsics)
    same = inside & (np.abs(last.depth_m[v, u] - seen[:, 2]) <= MARGIN_M + MARGIN_PER_M * seen[:, 2])
    values[rows[same], columns[same]] = last.likelihood[v[same], u[same]]
    return values
