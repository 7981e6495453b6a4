"""Fields with weights: a torch module and where it comes from, read from and written to weights files."""

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from torch import nn

from semantic_mapper.config import SamplingConfig, SRayConfig
from semantic_mapper.errors import WeightsError
from semantic_mapper.fields.learned import LearnedField, build_field
from semantic_mapper.fields.streaming import StreamedViews, StreamingSRay
from semantic_mapper.fields.views import EncodedViews
from semantic_mapper.fields.weights import MESSAGE, Tensors, WeightsFile, load_weights, weights_bytes
from semantic_mapper.files import write_bytes
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import PosedFrame

NEW_ROW_SPREAD = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """A field with its provenance."""

    model: LearnedField  # in evaluation mode
    anchors: tuple[PosedFrame, ...] = ()  # Frames the field was finetuned on, at working resolution
    # How it was trained: plain data (seed, steps, seconds, figures, git revision, ``train_stamps_ns``, ...)
    recipe: dict[str, Any] = field(default_factory=dict[str, Any])

    @property
    def label_set(self) -> LabelSet:
        """Classes of the field."""
        return self.model.label_set

    @property
    def weights(self) -> WeightsFile:
        """As they stand in a file; tensors on the CPU share memory."""
        model = self.model
        return WeightsFile(
            model.kind, model.config, model.label_set, tensors_of(model), tuple(self.anchors), self.recipe
        )

    @property
    def width(self) -> int:
        """As of ``WeightsFile``."""
        return self.weights.width

    @property
    def train_stamps_ns(self) -> frozenset[int]:
        """As of ``WeightsFile``."""
        return self.weights.train_stamps_ns


def tensors_of(model: nn.Module) -> dict[str, NDArray[Any]]:
    """Weights and buffers by name."""
    return {name: t.detach().cpu().contiguous().numpy() for name, t in model.state_dict().items()}


def streaming(model: LearnedField, sampling: SamplingConfig | None = None) -> StreamingSRay:
    """The compiled renderer of an S-Ray; weights on the CPU are shared."""
    assert isinstance(model.config, SRayConfig)
    return StreamingSRay(model.config, model.label_set, tensors_of(model), sampling or model.sampling)


def streamed(views: EncodedViews) -> StreamedViews:
    """What an S-Ray has encoded, as the compiled renderer takes it."""

    def array(tensor: torch.Tensor) -> NDArray[Any]:
        return tensor.detach().cpu().contiguous().numpy()

    feature, rgb, geometry = (array(t.permute(0, 2, 3, 1)) for t in (views.feature, views.rgb, views.geometry))
    lens = torch.cat((views.K.diagonal(dim1=1, dim2=2)[:, :2], views.K[:, :2, 2]), dim=1)
    labels = views.channel if (views.channel >= 0).any() else views.channel[:, :0, :0]
    poses = array(views.T_camera_world[:, :3])
    return StreamedViews(feature, rgb, geometry, np.log(geometry[..., 1]), array(lens), poses, array(labels))


def save_checkpoint(checkpoint: Checkpoint, path: Path, *, half: bool = False) -> None:
    """Write atomically; ``half`` stores weights as float16 (half the size, for shipping).
    Raises WeightsError: it cannot be written there."""
    try:
        data = checkpoint_bytes(checkpoint, half=half)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, data)
    except (SafetensorError, OSError) as error:
        raise WeightsError(f"{path}: cannot be written ({error}); give another file name") from error


def checkpoint_bytes(checkpoint: Checkpoint, *, half: bool = False) -> bytes:
    """The weights file of a checkpoint; ``half`` as of ``save_checkpoint``.
    Raises SafetensorError: tensors that the format does not know."""
    return weights_bytes(checkpoint.weights, half=half or checkpoint.model.stored_in_half)


def load_checkpoint(path: Path) -> Checkpoint:
    """Read a weights file.
    Raises WeightsError: missing, damaged, of another format or version, or weights that do not fit their own config."""
    return build_checkpoint(load_weights(path), path)


def build_checkpoint(weights: WeightsFile, path: Path | None = None) -> Checkpoint:
    """The field of weights, which were read from ``path``.
    Raises WeightsError: weights that do not fit their own config."""
    model = build_field(weights.kind, weights.config, weights.label_set)
    load_tensors(model, weights.tensors, path)
    return Checkpoint(model.eval(), weights.anchors, weights.recipe)


def load_tensors(model: nn.Module, tensors: Tensors, path: Path | None = None) -> None:
    """Put weights of a file (from ``path``) into a network. Raises WeightsError: they do not fit."""
    try:
        model.load_state_dict({name: torch.from_numpy(np.array(t)) for name, t in tensors.items()})
    except RuntimeError as error:
        first = " ".join(str(error).split())[:MESSAGE]
        where = "" if path is None else f"{path}: "
        raise WeightsError(f"{where}weights do not fit their model config: {first}") from error


def adapt_model(model: LearnedField, label_set: LabelSet) -> LearnedField:
    """A copy of a field for another label set: all weights kept, classifier rows carried over by class name. Rows of
    classes that the old set does not know start round the mean row; draws from torch's generator."""
    adapted = build_field(model.kind, model.config, label_set, model.sampling)
    state = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    for name in model.class_rows:
        old = state[name]
        spread = NEW_ROW_SPREAD if old.ndim > 1 else 0.0
        rows = [
            old[model.label_set.names.index(c)]
            if c in model.label_set.names
            else old.mean(0) + spread * torch.randn_like(old[0])
            for c in label_set.names
        ]
        state[name] = torch.stack(rows)
    adapted.load_state_dict(state)
    return adapted.to(next(model.parameters()).device)
