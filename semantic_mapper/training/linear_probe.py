"""A head start for finetuning: the classifier alone, on features as they are, before the first ray is rendered."""

from __future__ import annotations

# pyright: reportUnknownMemberType=false
from collections.abc import Sequence

import torch

from semantic_mapper.fields.base import EncodedViews
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.training.losses import image_loss
from semantic_mapper.training.views import LabelledView

RATE = 0.03  # of Adam: rows of classes that are new to the weights start from nothing
BALANCE = 0.5  # see ``image_loss``


def fit_class_rows(model: LearnedField, encoded: EncodedViews, views: Sequence[LabelledView], steps: int) -> bool:
    """Fit the class rows of ``model`` to the labelled pixels of ``views``; nothing else changes.

    Convex, since the classifier is linear, and cheap, since nothing is rendered or encoded: what is left for the steps
    on rays is what they alone can do. Kinds of fields that say nothing of images by themselves are left as they are.

    Args:
        encoded: The same views, encoded by ``model``.
        views: Their labels count, at the size of the features.
        steps: Over all views at once.

    Returns:
        Whether anything was fitted.
    """
    rows = [model.get_parameter(name) for name in model.class_rows]
    channel = torch.stack([view.channel for view in views]).to(encoded.feature.device)
    optimiser = torch.optim.Adam(rows, RATE)
    for _ in range(steps):
        logits = model.source_logits(encoded)
        if logits is None:
            return False
        gradients = torch.autograd.grad(image_loss(logits, channel, BALANCE), rows)
        for row, gradient in zip(rows, gradients, strict=True):
            row.grad = gradient
        optimiser.step()
    optimiser.zero_grad()
    return steps > 0
