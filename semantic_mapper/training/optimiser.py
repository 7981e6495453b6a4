"""The optimiser of a training run: AdamW with rates of their own for the image encoder and its backbone."""

from __future__ import annotations

import torch

from semantic_mapper.fields.learned import LearnedField

BACKBONE = "backbone"
ENCODER = "encoder"
REST = "rest"


def make_optimiser(field: LearnedField, learning_rate: float, weight_decay: float) -> torch.optim.AdamW:
    """AdamW over all parameters; scales, shifts and biases do not decay."""
    encoder = field.image_encoder
    part_of: dict[int, str] = {}
    if encoder is not None:
        part_of |= {id(p): ENCODER for p in encoder.parameters()}
        part_of |= {id(p): BACKBONE for backbone in encoder.backbones() for p in backbone.parameters()}
    groups = [
        {
            "params": [p for p in field.parameters() if part_of.get(id(p), REST) == part and (p.ndim > 1) == decays],
            "weight_decay": weight_decay if decays else 0.0,
            "part": part,
        }
        for part in (BACKBONE, ENCODER, REST)
        for decays in (True, False)
    ]
    return torch.optim.AdamW([group for group in groups if group["params"]], learning_rate)


def set_rates(
    optimiser: torch.optim.Optimizer, rate: float, encoder_share: float, backbone_share: float = 1.0
) -> None:
    """Learning rate of all parameters; the encoder takes ``encoder_share`` of it, its backbone ``backbone_share`` of
    that."""
    shares = {BACKBONE: encoder_share * backbone_share, ENCODER: encoder_share, REST: 1.0}
    for group in optimiser.param_groups:
        group["lr"] = rate * shares[group["part"]]
