"""A rendered view joined with what the frame's image says by itself.

A rendered view has the image among its sources, but few rays: what lies between them is filled in. The image's own
features are classified at every coarse pixel.
"""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false
import numpy as np
import torch
from torch.nn import functional

from semantic_mapper.fields.base import EncodedViews, ImageClassifier, SemanticField
from semantic_mapper.mapping.fusion.evidence import PROBABILITY_FLOOR
from semantic_mapper.mapping.views.view_renderer import RenderedView


def add_own_image(view: RenderedView, field: SemanticField, current: EncodedViews, weight: float) -> RenderedView:
    """The weighted geometric mean of the class probabilities of both, where the view is known.

    Args:
        view: Rendered, (h, w).
        field: The view is returned as it is where this has no opinion of single images.
        current: The frame's own image, encoded.
        weight: Of what the image says by itself, 0..1; 0 = the view as it is.
    """
    if weight == 0 or not isinstance(field, ImageClassifier):
        return view
    with torch.inference_mode():
        logits = field.source_logits(current)
        if logits is None:
            return view
        own = logits.float().cpu()
        if own.shape[2:] != view.known.shape:
            own = functional.interpolate(own, size=view.known.shape, mode="bilinear", align_corners=False)
        own = torch.log_softmax(own[0].permute(1, 2, 0), dim=-1).clamp_min(float(np.log(PROBABILITY_FLOOR)))
        rendered = torch.from_numpy(view.probabilities).clamp_min(PROBABILITY_FLOOR).log()
        joined = torch.softmax(weight * own + (1 - weight) * rendered, dim=-1).numpy()
    return view._replace(probabilities=np.where(view.known[..., None], joined, view.probabilities))
