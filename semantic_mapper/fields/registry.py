"""The kinds of learned fields by name: what a checkpoint, a training config and an evaluation may ask for."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, NamedTuple

import msgspec

from semantic_mapper.config import (
    Config,
    GridFieldConfig,
    IRTConfig,
    PanopticConfig,
    SamplingConfig,
    SRayConfig,
    UNetFieldConfig,
    convert_config,
)
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.labels import LabelSet


class FieldKind(NamedTuple):
    """A kind of field: its settings, and the module and class that make it, imported when one is built."""

    config: type[Config]
    module: str
    class_name: str


KINDS: dict[str, FieldKind] = {
    "sray": FieldKind(SRayConfig, "semantic_mapper.fields.sray", "SRay"),
    "unet": FieldKind(UNetFieldConfig, "semantic_mapper.fields.unet_field", "UNetField"),
    "grid": FieldKind(GridFieldConfig, "semantic_mapper.fields.scene.grid", "GridField"),
    "irt": FieldKind(IRTConfig, "semantic_mapper.fields.scene.irt", "IRT"),
    "panoptic": FieldKind(PanopticConfig, "semantic_mapper.fields.scene.panoptic", "Panoptic"),
}
GROUP = "semantic_mapper.fields"  # entry points of other packages, each a ``FieldKind``


@cache
def field_kinds() -> dict[str, FieldKind]:
    """The kinds of this package, and those that installed packages add by entry points."""
    return KINDS | {entry.name: entry.load() for entry in entry_points(group=GROUP)}


# A name for some switches of a kind. The field built is of that kind, and so is its checkpoint: the switches are part
# of the config that is saved, so nothing but a choice of names depends on this table.
_PAPER = {"tokens": "samples"}  # its order of attention, blending and compositing, and its ablations
PRESETS: dict[str, tuple[str, dict[str, Any]]] = {
    "sray-paper": ("sray", _PAPER | {"intra_view_attention": True, "cross_view_attention": True}),
    "sray-none": ("sray", _PAPER | {"intra_view_attention": False, "cross_view_attention": False}),
    "sray-intra": ("sray", _PAPER | {"intra_view_attention": True, "cross_view_attention": False}),
    **{f"irt-{name.lower()}": ("irt", {"variant": name}) for name in ("B", "BC", "RT", "RTT", "RTC", "RTTC")},
    "sray-cross": ("sray", _PAPER | {"intra_view_attention": False, "cross_view_attention": True}),
}


def field_names() -> tuple[str, ...]:
    """Every name that ``build_field`` takes: kinds, then presets."""
    return (*field_kinds(), *PRESETS)


def field_config(name: str, config: dict[str, Any] | Config) -> Config:
    """The full config that a field of this name is built with: defaults filled in, a preset's switches set.

    Args:
        name: A kind or a preset. The switches of a preset win over those of ``config``.
        config: Of that kind, or plain data for it.

    Raises:
        ConfigError: no such name, or a config that does not fit it.
    """
    kind, switches = PRESETS.get(name, (name, {}))
    if kind not in field_kinds():
        raise ConfigError(f"no field of kind '{name}'; there are {', '.join(sorted(field_names()))}")
    config_type = field_kinds()[kind].config
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
        name: A kind or a key of ``PRESETS``; the ``kind`` of the field is that of the preset's base.
        config: Of that kind, or plain data for it.

    Raises:
        ConfigError: no such name, or a config that does not fit it.
    """
    full = field_config(name, config)
    kind = field_kinds()[PRESETS[name][0] if name in PRESETS else name]
    field_type: type[LearnedField] = getattr(import_module(kind.module), kind.class_name)
    return field_type(full, label_set, sampling)
