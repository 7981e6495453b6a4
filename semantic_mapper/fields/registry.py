"""The kinds of learned fields by name: what a checkpoint, a training config and an evaluation may ask for."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import msgspec

from semantic_mapper.config import (
    Config,
    GridFieldConfig,
    IRTConfig,
    MVSNeRFConfig,
    NeuRayConfig,
    PanopticConfig,
    SamplingConfig,
    SemanticNeRFConfig,
    SRayConfig,
    UNetFieldConfig,
    convert_config,
)
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.labels import LabelSet

# kind -> its config, and the module and class of the field. A peer's module is imported when the kind is built.
KINDS: dict[str, tuple[type[Config], str, str]] = {
    "sray": (SRayConfig, "semantic_mapper.fields.sray", "SRay"),
    "unet": (UNetFieldConfig, "semantic_mapper.fields.peers.unet_field", "UNetField"),
    "neuray": (NeuRayConfig, "semantic_mapper.fields.peers.neuray", "NeuRay"),
    "mvsnerf": (MVSNeRFConfig, "semantic_mapper.fields.peers.mvsnerf", "MVSNeRF"),
    "semantic_nerf": (SemanticNeRFConfig, "semantic_mapper.fields.peers.semantic_nerf", "SemanticNeRF"),
    "grid": (GridFieldConfig, "semantic_mapper.fields.grid.field", "GridField"),
    "irt": (IRTConfig, "semantic_mapper.fields.irt", "IRT"),
    "panoptic": (PanopticConfig, "semantic_mapper.fields.panoptic", "Panoptic"),
}

# A name for some switches of a kind. The field built is of that kind, and so is its checkpoint: the switches are part
# of the config that is saved, so nothing but a choice of names depends on this table.
_PAPER = {"tokens": "samples"}  # its order of attention, blending and compositing, and its ablations
PRESETS: dict[str, tuple[str, dict[str, Any]]] = {
    "sray-paper": ("sray", _PAPER | {"intra_view_attention": True, "cross_view_attention": True}),
    "sray-none": ("sray", _PAPER | {"intra_view_attention": False, "cross_view_attention": False}),
    "sray-intra": ("sray", _PAPER | {"intra_view_attention": True, "cross_view_attention": False}),
    **{f"irt-{name.lower()}": ("irt", {"variant": name}) for name in ("B", "BC", "RT", "RTT", "RTC", "RTTC")},
    "irt-colour": ("irt", {"variant": "RTTC", "texture": "colour"}),
    "sray-cross": ("sray", _PAPER | {"intra_view_attention": False, "cross_view_attention": True}),
}


def field_names() -> tuple[str, ...]:
    """Every name that ``build_field`` takes: kinds, then presets."""
    return (*KINDS, *PRESETS)


def field_config(name: str, config: dict[str, Any] | Config) -> Config:
    """The full config that a field of this name is built with: defaults filled in, a preset's switches set.

    Args:
        name: A kind or a preset. The switches of a preset win over those of ``config``.
        config: Of that kind, or plain data for it.

    Raises:
        ConfigError: no such name, or a config that does not fit it.
    """
    kind, switches = PRESETS.get(name, (name, {}))
    if kind not in KINDS:
        raise ConfigError(f"no field of kind '{name}'; there are {', '.join(sorted(field_names()))}")
    config_type, _, _ = KINDS[kind]
    if isinstance(config, dict):
        config = convert_config(config, config_type, f"config of field '{name}'")
    if not isinstance(config, config_type):
        raise ConfigError(f"field '{name}' takes a {config_type.__name__}, got a {type(config).__name__}")
    return msgspec.structs.replace(config, **switches)


def build_field(
    name: str, config: dict[str, Any] | Config, label_set: LabelSet, sampling: SamplingConfig | None = None
) -> LearnedField:
    """A field with random weights.

    Args:
        name: A key of ``KINDS`` or ``PRESETS``; the ``kind`` of the field is that of the preset's base.
        config: Of that kind, or plain data for it.

    Raises:
        ConfigError: no such name, or a config that does not fit it.
    """
    full = field_config(name, config)
    _, module, class_name = KINDS[PRESETS[name][0] if name in PRESETS else name]
    field_type: type[LearnedField] = getattr(import_module(module), class_name)
    return field_type(full, label_set, sampling)
