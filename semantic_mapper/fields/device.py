"""Where a field computes, and which of its parts compute in bfloat16 there."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import torch
from torch import nn

from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.learned import LearnedField

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

BatchT = TypeVar("BatchT", bound="DataclassInstance")

DeviceName = Literal["auto", "cpu", "cuda"]


def choose_device(name: DeviceName, local_rank: int) -> torch.device:
    """``auto`` takes a GPU where there is one; of several, each rank of this machine takes its own.

    Raises:
        ConfigError: ``cuda`` is requested and there are fewer GPUs than ranks.
    """
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
    """Let the named parts of ``model`` compute in bfloat16 under autocast and hand back float32.

    Only named parts: reprojection in bfloat16, whose mantissa has 8 bits, would miss its pixel by several pixels.
    Weights stay float32, as do names in the state dict.

    Raises:
        ConfigError: no part of that name.
    """
    check_parts(model, names)
    parts = dict(model.named_modules())
    for name in names:
        part: Any = parts[name]
        part.forward = _in_bfloat16(part.forward, device_type)


def check_parts(model: nn.Module, names: Sequence[str]) -> None:
    """Refuse names of parts that ``model`` does not have.

    Raises:
        ConfigError: no part of that name.
    """
    parts = dict(model.named_modules())
    for name in names:
        if not name or name not in parts:
            children = ", ".join(child for child, _ in model.named_children())
            raise ConfigError(f"bfloat16: the field has no part '{name}'; there are {children}")


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
