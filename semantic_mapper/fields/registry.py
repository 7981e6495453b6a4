"""The kinds of learned fields by name: what a checkpoint, a training config and an evaluation may ask for."""

from __future__ import annotations

from typing import Any

from semantic_mapper.config import Config, SamplingConfig, SRayConfig, convert_config
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.sray import SRay
from semantic_mapper.labels import LabelSet

KINDS: dict[str, tuple[type[Config], type[LearnedField]]] = {SRay.kind: (SRayConfig, SRay)}


def build_field(
    kind: str, config: dict[str, Any] | Config, label_set: LabelSet, sampling: SamplingConfig | None = None
) -> LearnedField:
    """A field of a kind with random weights.

    Args:
        kind: A key of ``KINDS``.
        config: Of that kind, or plain data for it.

    Raises:
        ConfigError: no such kind, or a config that does not fit it.
    """
    if kind not in KINDS:
        raise ConfigError(f"no field of kind '{kind}'; there are {', '.join(sorted(KINDS))}")
    config_type, field_type = KINDS[kind]
    if isinstance(config, dict):
        config = convert_config(config, config_type, f"config of field '{kind}'")
    if not isinstance(config, config_type):
        raise ConfigError(f"field '{kind}' takes a {config_type.__name__}, got a {type(config).__name__}")
    return field_type(config, label_set, sampling)
