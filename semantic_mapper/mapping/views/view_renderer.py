"""The semantics of one view, with as many rays and samples as the settings, or the rate to hold, allow."""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.config import RenderConfig, SamplingConfig
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.base import EncodedViews, Sampled, SemanticField
from semantic_mapper.fields.render import render_sparse_view, render_view
from semantic_mapper.fields.volume import around_computed
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapping.rate_controller import RateController
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, UInt8

_log = get_logger(__name__)


class RenderedView(NamedTuple):
    """What a field says of a view.

    Args:
        probabilities: (h, w, L) float32.
        known: (h, w) bool, where they mean something.
        depth_m: (h, w) float32, 0 where not known.
        rays: How many were rendered.
        samples: Of a ray; 0 where the field draws its own.
    """

    probabilities: Float32
    known: NDArray[np.bool_]
    depth_m: Float32
    rays: int
    samples: int


class ViewRenderer:
    """Renders views from one field.

    Args:
        field: Whose samples a ray can be set, where a rate is to be held.
        config: Fraction of the rays, samples of views without any depth, rate.
        sampling: Of a ray with a depth prior.

    Raises:
        ConfigError: ``config.target_hz`` with a field that has no samples to set.
    """

    def __init__(self, field: SemanticField, config: RenderConfig, sampling: SamplingConfig) -> None:
        self._field = field
        self._config = config
        self._sampling = sampling
        self._rate_controller: RateController | None = None
        if config.target_hz > 0:
            if not isinstance(field, Sampled):
                raise ConfigError(f"render.target_hz needs a field whose samples can be set; {type(field)} has none")
            self._rate_controller = RateController(config.target_hz, config.ray_fraction, sampling)
        self._last = (0, 0)  # rays and samples of the last view, where its time tells of the next one's

    def exchange_field(self, field: SemanticField) -> None:
        """Render from another field, of the same kind, from now on."""
        self._field = field

    def note(self, render_ms: float, other_ms: float) -> None:
        """What the frame of the last view took: its rendering, and all else."""
        if self._rate_controller is not None:
            self._rate_controller.note(render_ms, other_ms, *self._last)

    def render(
        self,
        sources: EncodedViews,
        intrinsics: CameraIntrinsics,
        T_world_camera: Float64,
        prior_m: Float32,
        rgb: UInt8,
        *,
        measured: NDArray[np.bool_] | None = None,
        computed: bool = False,
        stamp_ns: int | None = None,
    ) -> RenderedView:
        """Render one view.

        Args:
            sources: Views to render from.
            intrinsics: Of the view, (h, w).
            T_world_camera: (4, 4).
            prior_m: (h, w) float32 depth prior, 0 = none.
            rgb: (h, w, 3) uint8 colours of the view.
            measured: (h, w), where the prior is not filled in; None = wherever there is one.
            computed: Whether the prior was computed from pictures: it may be farther off than a sensor's.
            stamp_ns: Of the view, for fields with things that move; None = such things are not there.
        """
        fraction, sampling = self._config.ray_fraction, self._sampling
        if self._rate_controller is not None:
            fraction, sampling = self._rate_controller.choose(prior_m.size)
        blind = not prior_m.any()
        if blind:
            sampling = msgspec.structs.replace(
                sampling, guided=max(self._config.samples_without_depth, sampling.guided)
            )
        elif computed:
            sampling = around_computed(sampling)
        samples = 0
        if isinstance(self._field, Sampled) and sampling.mode == "streaming":
            self._field.sampling = sampling
            samples = sampling.guided
        scene = (self._field, sources, intrinsics, T_world_camera, prior_m, sampling, self._config.rays_per_chunk)
        if fraction == 1:
            probabilities, known, depth_m = render_view(*scene, measured, stamp_ns)
            rays = prior_m.size
        else:
            probabilities, known, depth_m, rays = render_sparse_view(*scene, rgb, fraction, measured, stamp_ns)
        self._last = (0 if blind else rays, samples)
        return RenderedView(probabilities, known, depth_m, rays, samples)
