"""Groups of options that several verbs have; options of settings are made from the declarations of these."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, get_args, get_origin, get_type_hints

import typer

from semantic_mapper.config import Config, MapperConfig, load_mapper_config, parse_assignments
from semantic_mapper.setting_docs import settings_of

if TYPE_CHECKING:
    from semantic_mapper.transport.keys import ServerIdentity

OutOption = Annotated[Path, typer.Option("--out", help="Folder for the results; made if missing.")]
WeightsOption = Annotated[
    Path | None,
    typer.Option(
        "--weights",
        help="Weights file, or `rooms-computed-depth` for cameras without a depth sensor; without it the small one in "
        "the package.",
    ),
]
MaxFramesOption = Annotated[int, typer.Option("--max-frames", min=0, help="Stop after this many; 0 = all.")]


class OptionGroup:
    """Options that belong together; see ``verb``. Made with their values by name."""

    def __init__(self, **values: Any) -> None:
        self.values = values

    @classmethod
    def parameters(cls) -> list[inspect.Parameter]:
        """The options, as parameters of a command."""
        raise NotImplementedError


class SettingOptions(OptionGroup):
    """Options that set settings of ``kind``, with ``--config`` and ``--set`` for the others.

    What they say, their bounds and their defaults are those of the declaration.
    """

    kind: ClassVar[type[Config]]
    options: ClassVar[Mapping[str, str]]  # names of settings by option

    @classmethod
    def parameters(cls) -> list[inspect.Parameter]:
        """As of ``OptionGroup``."""
        declared = {setting.name: setting for setting in settings_of(cls.kind)}
        found: list[inspect.Parameter] = []
        for option, name in cls.options.items():
            setting = declared[name]
            text = f"{setting.text[:1].upper()}{setting.text[1:]}  [default: {_shown(setting.default)}]"
            info = typer.Option(option, help=text, show_default=False, min=setting.low, max=setting.high)
            found.append(_parameter(option.removeprefix("--").replace("-", "_"), setting.type | None, info))
        listed = typer.Option("--config", help="TOML file with settings; docs/settings.md lists all.")
        found.append(_parameter("config", Path | None, listed))
        assigned = typer.Option("--set", metavar="NAME=VALUE", help="Any other setting; may be repeated.")
        found.append(_parameter("set", list[str] | None, assigned))
        return found

    @property
    def path(self) -> Path | None:
        """The file of settings."""
        return self.values["config"]

    @property
    def given(self) -> dict[str, Any]:
        """What the command line says, by names of settings.

        Raises:
            ConfigError: ``--set`` is not of the form NAME=VALUE.
        """
        named = ((name, self.values[option[2:].replace("-", "_")]) for option, name in self.options.items())
        found = {name: value for name, value in named if value is not None}
        return found | parse_assignments(self.values["set"] or ())


class MapperSettings(SettingOptions):
    """Settings of the mapper."""

    kind = MapperConfig
    options: ClassVar = {
        "--voxel-size": "voxel_map.voxel_size_m",
        "--quality": "quality",
        "--depth": "depth.source",
        "--seed": "seed",
    }

    def load(self, defaults: Mapping[str, Any] | None = None) -> MapperConfig:
        """The config; see ``load_mapper_config``.

        Raises:
            ConfigError: a setting that is not valid.
        """
        return load_mapper_config(self.path, self.given, defaults)


def _parameter(name: str, kind: Any, info: Any, default: Any = None) -> inspect.Parameter:
    keyword = inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(name, keyword, default=default, annotation=Annotated[kind, info])


def _shown(default: Any) -> str:
    return str(default).lower() if isinstance(default, bool) else str(default)


class DataOptions(OptionGroup):
    """Base of groups that are dataclasses: each field is an option."""

    @classmethod
    def parameters(cls) -> list[inspect.Parameter]:
        """As of ``OptionGroup``."""
        hints = get_type_hints(cls, include_extras=True)
        found: list[inspect.Parameter] = []
        for field in dataclasses.fields(cls):  # pyright: ignore[reportArgumentType]
            kind, info = get_args(hints[field.name])
            assert get_origin(hints[field.name]) is Annotated
            found.append(_parameter(field.name, kind, info, field.default))
        return found


@dataclasses.dataclass(frozen=True)
class Remote(DataOptions):
    """By which a verb knows a mapper on another machine."""

    server: Annotated[
        str,
        typer.Option(
            "--server", help="Name, among the peers of `semantic-mapper keys`, of the machine of a mapper with keys."
        ),
    ] = ""
    keys: Annotated[
        Path | None,
        typer.Option("--keys", hidden=True, help="With --server: folder of the keys; without it this user's."),
    ] = None

    def identity(self) -> ServerIdentity | None:
        """Whom to expect at the other end; None where no server is named.

        Raises:
            TransportError: no keys.
        """
        from semantic_mapper.transport.keys import ServerIdentity, load_keys, user_key_folder

        if not self.server:
            return None
        return ServerIdentity(load_keys(self.keys or user_key_folder()), self.server)
