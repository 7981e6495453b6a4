"""Where a field computes, which of its parts compute in bfloat16 there, and a field for a GPU."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
import copy
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import nn

from semantic_mapper.config import DeviceName, SamplingConfig
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.base import EncodedViews
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import FieldRender, RayBatch, SourceViews

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

BatchT = TypeVar("BatchT", bound="DataclassInstance")

# Networks between features and features. Depths, densities and logits stay float32: eight bits of mantissa are 8 mm at
# 2 m, and no camera's pixel.
BFLOAT16_PARTS = ("encoder", "radial", "cross", "semantic")


def choose_device(name: DeviceName, local_rank: int) -> torch.device:
    """``auto`` takes a GPU where there is one; of several, each rank of this machine takes its own.
    Raises ConfigError: ``cuda`` is requested and there are fewer GPUs than ranks."""
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if name == "cpu" or (name == "auto" and count == 0):
        return torch.device("cpu")
    if local_rank >= count:
        raise ConfigError(
            f"process {local_rank} on this machine has no GPU: torch sees {count}; start fewer processes, "
            'or set device = "cpu"'
        )
    torch.cuda.set_device(local_rank)
    return torch.device("cuda", local_rank)


def to_device(batch: BatchT, device: torch.device) -> BatchT:
    """A copy of a dataclass of tensors (``SourceViews``, ``RayBatch``, ``RayTargets``) on another device."""
    values = {f.name: getattr(batch, f.name) for f in fields(batch)}
    return replace(batch, **{n: v.to(device) if isinstance(v, torch.Tensor) else v for n, v in values.items()})


def bfloat16_is_fast(device: torch.device) -> bool:
    """GPUs, and CPUs with matrix units (AMX); elsewhere float32 is faster."""
    return device.type != "cpu" or bool(torch.cpu.get_capabilities().get("amx_bf16", False))


def compute_in_bfloat16(model: nn.Module, names: Sequence[str], device_type: str) -> None:
    """Let the named parts of ``model`` compute in bfloat16 under autocast and hand back float32."""
    parts = dict(model.named_modules())
    for name in names:
        part: Any = parts[name]
        part.forward = _in_bfloat16(part.forward, device_type)


@contextmanager
def encoder_in_bfloat16(model: LearnedField, device: torch.device) -> Generator[None]:
    """Meanwhile the image encoder computes in bfloat16, where that is fast; see ``compute_in_bfloat16``."""
    encoder: Any = model.image_encoder
    if encoder is None or not bfloat16_is_fast(device):
        yield
        return
    encoder.forward = _in_bfloat16(encoder.forward, device.type)
    try:
        yield
    finally:
        del encoder.forward  # what is left is the method of its class


def _in_bfloat16(forward: Callable[..., Any], device_type: str) -> Callable[..., Any]:
    def autocast_forward(*args: Any, **kwargs: Any) -> Any:
        with torch.autocast(device_type, torch.bfloat16):
            return _to_float32(forward(*args, **kwargs))

    return autocast_forward


def _to_float32(result: Any) -> Any:
    if isinstance(result, tuple):
        return tuple(_to_float32(r) for r in result)  # pyright: ignore[reportUnknownVariableType]
    return result.float()


class DeviceField:
    """Inference-only field on a device. Satisfies ``SemanticField``.

    Weights, features of keyframes and rays stay on the device. Sums on a GPU come in no fixed order: its renders repeat
    but for the last digits. The model is copied; with ``bfloat16`` its ``BFLOAT16_PARTS`` compute in that.
    """

    def __init__(
        self, model: LearnedField, device: torch.device, sampling: SamplingConfig, *, bfloat16: bool = False
    ) -> None:
        self.model = copy.deepcopy(model).to(device).eval()
        self.device = device
        self.sampling = sampling
        torch.backends.cudnn.allow_tf32 = False  # torch's default rounds convolutions to 10 bits, those of depths, too
        if bfloat16:
            parts = dict(self.model.named_children())
            compute_in_bfloat16(self.model, [name for name in BFLOAT16_PARTS if name in parts], device.type)

    @property
    def label_set(self) -> LabelSet:
        """Classes of the rendered logits, in channel order."""
        return self.model.label_set

    def encode(self, views: SourceViews) -> EncodedViews:
        """Encode views from anywhere; their features are on the device."""
        with torch.inference_mode():
            return self.model.encode(to_device(views, self.device))

    def source_logits(self, sources: EncodedViews) -> torch.Tensor | None:
        """Logits (m, L, h, w) of the encoded images by themselves, on the device; None where the kind has none."""
        with torch.inference_mode():
            return self.model.source_logits(sources)

    def render(self, rays: RayBatch, sources: EncodedViews) -> FieldRender:
        """Render rays of the device from views that ``encode`` has encoded; not differentiable."""
        self.model.sampling = self.sampling
        with torch.inference_mode():
            return self.model.render(rays, sources)
