"""The optimiser of a training run: AdamW with a rate of its own for the image encoder."""

from __future__ import annotations

import torch

from semantic_mapper.fields.learned import LearnedField

ENCODER = "encoder"
REST = "rest"


def make_optimiser(field: LearnedField, learning_rate: float, weight_decay: float) -> torch.optim.AdamW:
    """AdamW over all parameters; scales, shifts and biases do not decay."""
    encoder = field.image_encoder
    in_encoder = set() if encoder is None else {id(p) for p in encoder.parameters()}
    groups = [
        {
            "params": [p for p in field.parameters() if (id(p) in in_encoder) == inside and (p.ndim > 1) == decays],
            "weight_decay": weight_decay if decays else 0.0,
            "part": ENCODER if inside else REST,
        }
        for inside in (True, False)
        for decays in (True, False)
    ]
    return torch.optim.AdamW([group for group in groups if group["params"]], learning_rate)


def set_rates(optimiser: torch.optim.Optimizer, rate: float, encoder_share: float) -> None:
    """Learning rate of all parameters; the encoder takes ``encoder_share`` of it."""
    for group in optimiser.param_groups:
        group["lr"] = rate * (encoder_share if group["part"] == ENCODER else 1.0)
