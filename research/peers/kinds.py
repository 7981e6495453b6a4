"""The peers as kinds of fields, which the entry points of this package name, and names for switches of kinds."""

from __future__ import annotations

from typing import Any

from research.peers.config import SemanticNeRFConfig
from semantic_mapper.config import Config, PanopticConfig, SamplingConfig, convert_config, to_plain
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields import learned
from semantic_mapper.fields.kinds import FieldKind, field_kinds
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.labels import LabelSet

SEMANTIC_NERF = FieldKind(SemanticNeRFConfig, "research.peers.semantic_nerf", "SemanticNeRF")
PANOPTIC_UNIFORM = FieldKind(PanopticConfig, "research.peers.uniform_panoptic", "UniformPanoptic")

# A field built by such a name is of the kind, and so is its checkpoint: the switches are part of its config.
_PAPER = {"tokens": "samples"}  # its order of attention, blending and compositing, and its ablations
PRESETS: dict[str, tuple[str, dict[str, Any]]] = {
    "sray-paper": ("sray", _PAPER | {"intra_view_attention": True, "cross_view_attention": True}),
    "sray-none": ("sray", _PAPER | {"intra_view_attention": False, "cross_view_attention": False}),
    "sray-intra": ("sray", _PAPER | {"intra_view_attention": True, "cross_view_attention": False}),
    "sray-cross": ("sray", _PAPER | {"intra_view_attention": False, "cross_view_attention": True}),
    **{f"irt-{name.lower()}": ("irt", {"variant": name}) for name in ("B", "BC", "RT", "RTT", "RTC", "RTTC")},
}


def field_names() -> tuple[str, ...]:
    """Every name that ``build_field`` takes: kinds, then presets."""
    return (*field_kinds(), *PRESETS)


def build_field(
    name: str, config: dict[str, Any] | Config, label_set: LabelSet, sampling: SamplingConfig | None = None
) -> LearnedField:
    """A field with random weights, of a kind or a preset, whose switches win over those of ``config``.

    Raises ConfigError: no such name, or a config that does not fit it.
    """
    kind, switches = PRESETS.get(name, (name, {}))
    if kind not in field_kinds():
        raise ConfigError(f"no field of kind '{name}'; there are {', '.join(sorted(field_names()))}")
    if switches:
        plain = config if isinstance(config, dict) else to_plain(config)
        config = convert_config(plain | switches, field_kinds()[kind].config, f"config of field '{name}'")
    return learned.build_field(kind, config, label_set, sampling)
