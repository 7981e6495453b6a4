"""What all verbs of the command line share: options, process set-up, one clear line for an error, exit codes.

The parameters of a verb's function are what it takes: those before ``*`` are arguments, those behind it options. What
the help says of one is the comment at it, its bounds are those of its type (``msgspec.Meta``), as of any setting.

0 done; 1 failed; 2 wrong usage; 3 a map that cannot be trusted; 4 an empty map; 130 after Ctrl-C, 143 after SIGTERM
(what was done so far is written where a verb says so); 1 too where a result is negative (``doctor`` finds something
missing).
"""

from __future__ import annotations

import functools
import inspect
import sys
from collections.abc import Callable, Generator, Iterable, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeVar, get_args, get_origin, get_type_hints

import msgspec
import structlog
import typer
from rich.text import Text
from typer.models import ParameterInfo

from semantic_mapper import setting_docs
from semantic_mapper.config import (
    Config,
    MapperConfig,
    NotNegative,
    assign,
    convert_config,
    load_mapper_config,
    nearest_path,
    parse_assignments,
    read_toml,
)
from semantic_mapper.errors import ConfigError, EmptyMapError, LogError, SemanticMapperError
from semantic_mapper.nodes.console import Output, stderr_console
from semantic_mapper.nodes.process import failure_message, prepare_process
from semantic_mapper.plain_text import visible, without_secrets
from semantic_mapper.transport.launches import LIVE, read_launch_note, running_launches

if TYPE_CHECKING:
    from semantic_mapper.transport.keys import ServerIdentity

EXIT_FAILED = 1
EXIT_USAGE = 2
EXIT_UNTRUSTED = 3  # poses contradict depth or pictures, or most computed depth is at the end of its range
EXIT_EMPTY = 4  # a map has no surface, or next to none
EXIT_INTERRUPTED = 130
LISTED = 10  # lines of one kind that are shown one by one

_log = structlog.get_logger(__name__)

ConfigT = TypeVar("ConfigT", bound=Config)
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON alone (docs/json.md)")]
JsonOutput = Annotated[Output, JsonOption]  # of a verb that has this option
WeightsOption = Annotated[Path | None, typer.Option("--weights", help="A weights file; the default ships")]
MaxFramesOption = Annotated[NotNegative, typer.Option(help="Stop after this many; 0 = all")]
Port = Annotated[int, msgspec.Meta(ge=0, le=65535)]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace what is there")]


def set_option(completed: Callable[..., list[str]]) -> Any:
    """The option ``--set``, and what a shell completes it with."""
    return typer.Option("--set", metavar="NAME=VALUE", help="Any setting; may be repeated", autocompletion=completed)


def complete(settings: Iterable[setting_docs.Setting], incomplete: str) -> list[str]:
    """NAME=VALUE of settings that begin so, with each value that is possible, else with the default."""
    found: list[str] = []
    for setting in settings:
        is_plain = isinstance(setting.default, int | float | str)
        values = [setting.default] if is_plain else [""]
        if get_origin(setting.type) is Literal:
            values = get_args(setting.type)
        elif setting.type is bool:
            values = ("true", "false")
        found += [f"{setting.name}={value}" for value in values]
    return [text for text in found if text.startswith(incomplete)]


def complete_launch(incomplete: str) -> list[str]:
    """Launches that run here, by name; nothing before the first letter, so that a shell shows files."""
    if not incomplete:
        return []
    names = [read_launch_note(folder).launch.removesuffix(".toml") for folder in running_launches()]
    return [name for name in dict.fromkeys((LIVE, *names)) if name.startswith(incomplete)]


UpOption = Annotated[
    str, typer.Option("--up", metavar="AXIS", help="Up in the world: z, -y, ..., or 0,0,1; auto = away from the floor")
]


class _UsageError(ConfigError):
    """The command line, or a file of settings that it names, is wrong."""


@contextmanager
def wrong_usage(kind: type[SemanticMapperError] = ConfigError) -> Generator[None]:
    """Within, an error of this kind, such as of what cannot be a setting or an option, is wrong usage (exit code 2)."""
    try:
        yield
    except kind as error:
        raise _UsageError(str(error)) from error


class Settings:
    """Options that stand before the verb."""

    verbose = False


class Options(msgspec.Struct, frozen=True):
    """Options that several verbs share: a field each, with its help in the comment there."""

    hidden: ClassVar[bool] = False  # from the help

    @classmethod
    def parameters(cls) -> list[inspect.Parameter]:
        """The options, as parameters of a command."""
        hints, texts = get_type_hints(cls, include_extras=True), setting_docs.comments_of(cls)
        return [
            _option(field.name, hints[field.name], field.default, texts[field.name], hidden=cls.hidden)
            for field in msgspec.structs.fields(cls)
        ]


class SettingOptions:
    """Options that set settings of ``kind``, with ``--config`` and ``--set`` for the others.

    What they say and their defaults are those of the declaration. Made with their values by name.
    """

    kind: ClassVar[type[Config]]
    options: ClassVar[Mapping[str, str]]  # names of settings by option

    def __init__(self, *, config: Path | None = None, set: list[str] | None = None, **values: Any) -> None:  # noqa: A002
        self.path = config
        named = {name: values.get(_parameter_name(option)) for option, name in self.options.items()}
        self._named = {name: value for name, value in named.items() if value is not None}
        self._assigned = set or []

    @classmethod
    def parameters(cls) -> list[inspect.Parameter]:
        """As of ``Options``."""
        declared = {setting.name: setting for setting in setting_docs.settings_of(cls.kind)}
        found: list[inspect.Parameter] = []
        for option, name in cls.options.items():
            setting = declared[name]
            default = str(setting.default).lower() if isinstance(setting.default, bool) else setting.default
            info = typer.Option(option, help=f"{_sentence(setting.text)}  [default: {default}]", show_default=False)
            bounded = Annotated[setting.type, msgspec.Meta(ge=setting.low, le=setting.high)]
            found.append(_parameter(_parameter_name(option), bounded, info, None))
        completed = set_option(lambda incomplete: complete(setting_docs.settings_of(cls.kind), incomplete))
        listed = typer.Option("--config", help="TOML file of settings (docs/settings.md)")
        return [*found, _parameter("config", Path | None, listed, None), _parameter("set", list[str], completed, None)]

    @property
    @wrong_usage()
    def given(self) -> dict[str, Any]:
        """What the command line says, by names of settings. Raises ConfigError: ``--set`` is not of the form
        NAME=VALUE, or names no setting."""
        return self._named | parse_assignments(self._assigned, self.kind)

    @wrong_usage()
    def table(self) -> dict[str, Any]:
        """File and command line together, as a TOML file would have them. Raises ConfigError: a file that is no TOML,
        or ``given`` is not."""
        data = read_toml(self.path) if self.path else {}
        for name, value in self.given.items():
            assign(data, name, value, "--set")
        return data

    @wrong_usage()
    def convert(self, kind: type[ConfigT]) -> ConfigT:
        """The settings. Raises ConfigError: one that is not valid."""
        return convert_config(self.table(), kind, str(self.path or "command line"))


class MapperSettings(SettingOptions):
    """Settings of the mapper."""

    kind = MapperConfig
    options: ClassVar = {"--voxel-size": "voxel_map.voxel_size_m", "--quality": "quality", "--depth": "depth.source"}

    @wrong_usage()
    def load(self, defaults: Mapping[str, Any] | None = None) -> MapperConfig:
        """The config; see ``load_mapper_config``. Raises ConfigError: a setting that is not valid."""
        return load_mapper_config(self.path, self.given, defaults)


class Remote(Options, frozen=True):
    """By which a verb knows a mapper on another machine."""

    server: str = ""  # mapper with keys: its machine, as `keys` calls it
    keys: Path | None = None  # --server: folder of the keys

    def identity(self) -> ServerIdentity | None:
        """Whom to expect at the other end; see ``server_identity``, also for errors."""
        from semantic_mapper.transport.keys import server_identity

        return server_identity(self.server, self.keys)

    def refuse_unless(self, live: bool) -> None:
        """Refuse these options with what is no running mapper. Raises typer.BadParameter: one was given."""
        refuse_options((self != type(self)() and not live, "--server, --keys", "go with a running mapper"))


def verb(function: Callable[..., int | None]) -> Callable[..., None]:
    """Make a command of a function that returns an exit code (None = 0) and raises ``SemanticMapperError``.

    A parameter whose type is ``Options`` or ``SettingOptions`` stands for the options of the group; ``output`` is where
    to print. As a ``JsonOutput`` it brings the option ``--json``.
    """
    signature = inspect.signature(function, eval_str=True)
    texts = setting_docs.comments_of_parameters(function)
    groups: dict[str, type[Options | SettingOptions]] = {}
    parameters: list[inspect.Parameter] = []
    for name, parameter in signature.parameters.items():
        kind = parameter.annotation
        if isinstance(kind, type) and issubclass(kind, Options | SettingOptions):
            groups[name] = kind
            parameters += kind.parameters()
        elif name != "output":
            make = _option if parameter.kind is inspect.Parameter.KEYWORD_ONLY else _argument
            parameters.append(make(name, kind, parameter.default, texts.get(name, "")))
    output = signature.parameters.get("output")
    with_json = output is not None and output.annotation == JsonOutput
    if with_json:
        parameters.append(_parameter("json", JsonOption, typer.Option(), False))

    bounds = {parameter.name: setting_docs.without_bounds(parameter.annotation)[1:] for parameter in parameters}

    @functools.wraps(function)
    def command(**values: Any) -> None:
        prepare_process(verbose=Settings.verbose)
        for name, value in values.items():
            _check_bounds(name, value, *bounds[name])
        try:
            for name, group in groups.items():
                values[name] = group(**{option.name: values.pop(option.name) for option in group.parameters()})
            if output is not None:
                values["output"] = Output.guarded()
                values["output"].quiet = with_json and values.pop("json")
            code = function(**values)
        except KeyboardInterrupt:
            show_error("interrupted")
            code = EXIT_INTERRUPTED
        except BrokenPipeError:  # the reader of our stdout is gone (`... | head`): nothing is left to be said
            code = EXIT_FAILED
        except Exception as error:
            if not (message := str(error) if isinstance(error, SemanticMapperError) else failure_message(error)):
                raise
            if Settings.verbose:
                _log.exception("failed")
            show_error(message)
            codes = {_UsageError: EXIT_USAGE, EmptyMapError: EXIT_EMPTY}
            code = codes.get(type(error), EXIT_FAILED)
        sys.stderr.flush()
        raise typer.Exit(code or 0)

    command.__signature__ = signature.replace(parameters=parameters)  # pyright: ignore[reportAttributeAccessIssue]
    command.__annotations__ = {p.name: p.annotation for p in parameters}
    # Click joins the lines of a paragraph but for those after a backspace: an example is there to be copied.
    command.__doc__ = inspect.cleandoc(function.__doc__ or "").replace("\n\nExample:", "\n\n\b\nExample:", 1)
    return command


def refuse_options(*rules: tuple[object, str, str]) -> None:
    """Refuse options that do not go together: whether they are wrong, their names, and why. Raises typer.BadParameter:
    the first that are wrong."""
    for wrong, options, why in rules:
        if wrong:
            raise typer.BadParameter(why, param_hint=options)


def _option(name: str, kind: Any, default: Any, text: str, *, hidden: bool = False) -> inspect.Parameter:
    said = "--" + name.rstrip("_").replace("_", "-")
    if setting_docs.without_bounds(kind)[0] is bool and default:
        said += f"/--no-{said[2:]}"
    metavar = "<str>" if get_origin(setting_docs.without_bounds(kind)[0]) is list else None
    shown = default not in (0, "0")
    info = typer.Option(said, help=_sentence(text), show_default=shown, hidden=hidden, metavar=metavar)
    return _parameter(name, kind, info, default)


def _argument(name: str, kind: Any, default: Any, text: str) -> inspect.Parameter:
    return _parameter(name, kind, typer.Argument(help=_sentence(text)), default)


def _parameter(name: str, kind: Any, info: ParameterInfo, default: Any) -> inspect.Parameter:
    """A parameter as Typer wants it; what its type says to Typer goes before ``info``."""
    given = next((note for note in get_args(kind) if isinstance(note, ParameterInfo)), None)
    if given is not None:
        given.help, given.metavar = given.help or info.help, given.metavar or info.metavar
        given.show_default = info.show_default
    else:
        declared, low, high = setting_docs.without_bounds(kind)
        kind = Annotated[declared | None if default is None else declared, info, msgspec.Meta(ge=low, le=high)]
    default = inspect.Parameter.empty if default is msgspec.NODEFAULT else default
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)


def _parameter_name(option: str) -> str:
    return option.removeprefix("--").replace("-", "_")


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]


def must_be_there(*paths: Path) -> None:
    """Refuse what is missing, or neither a file nor a folder, before the packages that read it are loaded. Raises
    LogError: one of them is."""
    for path in paths:
        if not path.is_file() and not path.is_dir():
            missing = f"no such file or folder{nearest_path(path)}"
            what = "it is no regular file; copy its content to one" if path.exists() else missing
            raise LogError(f"{path}: cannot be read: {what}")


def _check_bounds(name: str, value: object, low: float | None, high: float | None) -> None:
    """Refuse numbers beyond what the declaration allows, and those that nothing can be computed with, as NaN."""
    low, high = -setting_docs.BOUNDLESS if low is None else low, setting_docs.BOUNDLESS if high is None else high
    for item in value if isinstance(value, tuple | list) else (value,):
        if isinstance(item, int | float) and not low <= item <= high:
            hint = f"--{name.rstrip('_').replace('_', '-')}"
            raise typer.BadParameter(f"{item:g}: give a number from {low:g} to {high:g}", param_hint=hint)


def show_error(message: str) -> None:
    """One red line on stderr."""
    message = without_secrets(" ".join(message.split("\n")))
    line = Text.assemble(("error: ", "bold red"), (visible(message), "red"))
    stderr_console().print(line, soft_wrap=True)
