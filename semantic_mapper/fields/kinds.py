"""The kinds of fields there are, without torch: what each is made from."""

from functools import cache
from importlib.metadata import entry_points
from typing import Any, NamedTuple

from semantic_mapper.config import (
    Config,
    GridFieldConfig,
    IRTConfig,
    PanopticConfig,
    SRayConfig,
    UNetFieldConfig,
    convert_config,
)
from semantic_mapper.errors import ConfigError


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


def field_config(kind: str, config: dict[str, Any] | Config) -> Config:
    """A config of that kind, or one made of plain data.
    Raises ConfigError: no such kind, or a config that does not fit it."""
    found = KINDS.get(kind) or field_kinds().get(kind)  # those of other packages may load torch
    if found is None:
        raise ConfigError(f"no field of kind '{kind}'; there are {', '.join(sorted(field_kinds()))}")
    config_type = found.config
    if isinstance(config, dict):
        return convert_config(config, config_type, f"config of field '{kind}'")
    if not isinstance(config, config_type):
        raise ConfigError(f"field '{kind}' takes a {config_type.__name__}, got a {type(config).__name__}")
    return config
