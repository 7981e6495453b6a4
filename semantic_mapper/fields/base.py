"""The seam that streaming asks fields through: encode a view once, render any number of rays from encoded views.

Arrays are numpy's. ``StreamingSRay`` computes in them; ``DeviceField`` puts fields of torch behind this seam.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.config import SamplingConfig
from semantic_mapper.errors import WeightsError
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import Bool, CameraIntrinsics, Float32, Float64, UInt8

MAX_SOURCE_VIEWS = 16
CHUNK = 2048  # rays rendered at once on a CPU: what fits in a core's cache
EncodedSize = tuple[tuple[int, ...], tuple[int, ...]]  # of the feature and the label maps


@dataclass(frozen=True, slots=True, eq=False)
class WorkingView:
    """One image at the size that a field encodes."""

    rgb: UInt8  # (H, W, 3)
    depth_m: Float32  # (H, W), 0 = no measurement; all 0 for a view without depth
    intrinsics: CameraIntrinsics
    T_world_camera: Float64  # (4, 4)
    # (H, W) class channels that are known of the view, -1 = none; None for a view without labels
    channel: NDArray[np.integer] | None = None
    # (H, W) one-sigma spread of ``depth_m`` where it was computed from pictures, 0 where measured; None = all was
    depth_sigma_m: Float32 | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """R query rays in world coordinates, float32."""

    origin: Float32  # (R, 3) metres
    direction: Float32  # (R, 3): ``origin + z * direction`` has camera depth z (not of unit length)
    near_m: float  # z bounds of the search
    far_m: float
    prior_depth_m: Float32  # (R,) z from a sensor or a map, 0 = none
    measured: Bool  # (R,), where the prior is measured at the very pixel rather than filled in from others
    stamp_ns: int | None = None  # when they are, for fields with things that move; None = such things are not there


class Rendered(NamedTuple):
    """What a field renders for R rays."""

    logits: Float32  # (R, L) class logits (S-Ray Eq. 13); zeros where ``known`` is False
    depth_m: Float32  # (R,) expected z depth
    opacity: Float32  # (R,) in [0, 1]
    rgb: Float32  # (R, 3) in [0, 1]
    known: Bool  # (R,) False where no source view sees the ray: an explicit "unknown", not a guess


class Encoded(Protocol):
    """An encoded view, or several of one size, which only their field looks into."""

    @property
    def size(self) -> EncodedSize:
        """Views of one size can be rendered from together."""
        ...

    def at(self, T_world_camera: Float64) -> Self:
        """One view with another pose (4, 4)."""
        ...


EncodedT = TypeVar("EncodedT")


class StreamField(Protocol[EncodedT]):
    """What streaming asks of a field."""

    @property
    def holds_scene(self) -> bool:
        """Whether its density is the geometry of the one scene that it was fitted to."""
        ...

    @property
    def rays_per_chunk(self) -> int:
        """Rays to render at once."""
        ...

    sampling: SamplingConfig  # where ``render`` samples rays; may be exchanged between two renders

    @property
    def label_set(self) -> LabelSet:
        """Classes of the rendered logits, in channel order."""
        ...

    def encode(self, view: WorkingView) -> EncodedT:
        """Encode a view by itself; the result may be kept."""
        ...

    def stack(self, views: Sequence[EncodedT]) -> EncodedT:
        """Join encoded views of one size. Raises ShapeError: none or too many views, or different sizes."""
        ...

    def render(self, rays: Rays, sources: EncodedT) -> Rendered:
        """Render rays from encoded source views."""
        ...

    def source_logits(self, sources: EncodedT) -> Float32 | None:
        """Logits (h, w, L) of an encoded view by itself; None where the field has no opinion of single images."""
        ...

    def release(self) -> None:
        """Give up what ``encode`` made to be fast, and makes again the next time."""
        ...


def check_classes(field: StreamField[Any], label_set: LabelSet) -> None:
    """Refuse a field for a map of other classes. Raises WeightsError: naming both."""
    if field.label_set != label_set:
        raise WeightsError(
            f"the field renders label set '{field.label_set.name}' ({len(field.label_set)} classes), "
            f"the map holds '{label_set.name}' ({len(label_set)}); use weights made for this label set"
        )
