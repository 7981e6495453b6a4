"""Where a field computes, which of its parts compute in bfloat16 there, and a field for a GPU."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
import copy
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import nn

from semantic_mapper.config import DeviceName, SamplingConfig
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.base import CHUNK, Rays, Rendered, WorkingView
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.views import EncodedViews, stack_views
from semantic_mapper.geometry import camera_matrix
from semantic_mapper.kernels import processor_flags
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import Float32, RayBatch, SourceViews

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
    return device.type != "cpu" or "amx_bf16" in processor_flags()  # older PyTorch does not tell


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


GPU_CHUNK = 32768  # rays rendered at once: enough to fill one, as long as
GPU_PAIRS = GPU_CHUNK * 16**2  # pairs of samples that attend to each other are no more: 1 GB of scores for 8 views


class DeviceField:
    """Inference-only field of torch on a device. Satisfies ``StreamField``.

    Weights, features of keyframes and rays stay on the device. Sums on a GPU come in no fixed order: its renders repeat
    but for the last digits. A model on the device is shared; with ``bfloat16`` ``BFLOAT16_PARTS`` of a copy compute in
    that.
    """

    def __init__(
        self, model: LearnedField, device: torch.device, sampling: SamplingConfig, *, bfloat16: bool = False
    ) -> None:
        shared = not bfloat16 and next(model.parameters()).device.type == device.type
        self.model = (model if shared else copy.deepcopy(model).to(device)).eval()
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

    @property
    def rays_per_chunk(self) -> int:
        """As many as the device has memory for."""
        sampling = self.sampling
        samples = sampling.guided if sampling.mode == "streaming" else sampling.coarse + sampling.fine
        return CHUNK if self.device.type == "cpu" else max(1, min(GPU_CHUNK, GPU_PAIRS // samples**2))

    @property
    def holds_scene(self) -> bool:
        """As of its kind."""
        return self.model.holds_scene

    def encode(self, view: WorkingView) -> EncodedViews:
        """Encode a view; its features are on the device."""
        tensor = partial(torch.tensor, dtype=torch.float32)
        channel, sigma_m = view.channel, view.depth_sigma_m
        views = SourceViews(
            rgb=torch.from_numpy(view.rgb).permute(2, 0, 1).float().div(255)[None],
            depth_m=torch.from_numpy(view.depth_m)[None],
            K=tensor(camera_matrix(view.intrinsics))[None],
            T_world_camera=tensor(view.T_world_camera)[None],
            channel=None if channel is None else torch.from_numpy(channel)[None],
            depth_sigma_m=None if sigma_m is None else torch.from_numpy(sigma_m)[None],
        )
        with torch.inference_mode():
            return self.model.encode(to_device(views, self.device))

    def stack(self, views: Sequence[EncodedViews]) -> EncodedViews:
        """As ``stack_views``."""
        return stack_views(views)

    def source_logits(self, sources: EncodedViews) -> Float32 | None:
        """Logits (h, w, L) of an encoded view by itself; None where the kind has none."""
        with torch.inference_mode():
            logits = self.model.source_logits(sources)
            return None if logits is None else logits[0].permute(1, 2, 0).float().cpu().numpy()

    def release(self) -> None:
        """Nothing: it holds no more than its weights."""

    def render(self, rays: Rays, sources: EncodedViews) -> Rendered:
        """Render rays from views that ``encode`` has encoded."""
        near, far = (torch.full((len(rays.origin),), bound) for bound in (rays.near_m, rays.far_m))
        origin, direction, prior, measured = map(
            torch.from_numpy, (rays.origin, rays.direction, rays.prior_depth_m, rays.measured)
        )
        self.model.sampling = self.sampling
        batch = RayBatch(origin, direction, near, far, prior, measured, rays.stamp_ns)
        with torch.inference_mode():
            found = self.model.render(to_device(batch, self.device), sources)
            parts = found.logits, found.depth_m, found.opacity, found.rgb, found.known
            return Rendered(*(part.cpu().numpy() for part in parts))
