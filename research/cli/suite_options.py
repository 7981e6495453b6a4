"""Options of ``semantic-mapper-research suite``, and the settings that come of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

if TYPE_CHECKING:
    from research.suites.config import SuiteConfig

SplitOption = Annotated[Literal["test", "val"] | None, typer.Option(help="Which rooms.  [default: test]")]
RoomsOption = Annotated[
    int | None, typer.Option(min=0, help="The first this many rooms of the split; 0 = all.  [default: 0]")
]
ProtocolOption = Annotated[
    Literal["generalize", "finetune", "scratch"] | None,
    typer.Option(help="Weights as they are, fitted to each room, or random ones fitted.  [default: generalize]"),
]
KindOption = Annotated[
    list[str] | None,
    typer.Option("--kind", help="scratch and finetune: a kind of field that starts from random weights; may repeat."),
]
ViewsOption = Annotated[int | None, typer.Option(min=1, max=16, help="Source views of a query.  [default: 8]")]
SourcesOption = Annotated[
    Literal["near", "wide", "cover"] | None,
    typer.Option(
        help="generalize: source views near the query, far from it, or the mapper's keyframes.  [default: near]"
    ),
]
OwnImageOption = Annotated[
    bool | None,
    typer.Option(
        "--own-image/--no-own-image", help="generalize: the query's own image is a source view.  [default: on]"
    ),
]
CurrentOption = Annotated[
    Literal["clean", "hard"] | None,
    typer.Option(help="Query images as all others, or blurred, noisy, dark, narrow or too close.  [default: clean]"),
]
DepthOption = Annotated[
    Literal["on", "computed", "off"] | None,
    typer.Option(help="The sensor's depth, depth computed from the pictures of the walk, or none.  [default: on]"),
]
TierOption = Annotated[
    Literal["cpu", "gpu", "record"] | None,
    typer.Option(
        help="rooms: cpu = 160x120 and few samples, gpu = 320x240 and many. klevr: cpu = 52 scenes at 72x72, record = "
        "120 at 256x256, three seeds. aerial: cpu = 2 towns at 192x192, record = 6 at 512x512. "
        "streets: cpu = 3 streets, record = 10.  [default: cpu]"
    ),
]
KeyframesOption = Annotated[
    int | None, typer.Option(min=2, help="finetune and scratch: labelled keyframes a room.  [default: 12]")
]
StepsOption = Annotated[
    int | None, typer.Option(min=0, help="finetune and scratch: steps a room instead of --seconds.")
]
SecondsOption = Annotated[
    float | None,
    typer.Option(min=0, help="finetune and scratch: training time a room.  [default: 120]"),
]
MapOption = Annotated[bool, typer.Option("--map", help="generalize: also fuse each room and score the map.")]
RefineOption = Annotated[
    Path | None,
    typer.Option(
        "--refine", metavar="WEIGHTS", help="With --map: also score the maps refined by these, and smoothed instead."
    ),
]
SuiteConfigOption = Annotated[
    Path | None,
    typer.Option(
        "--config",
        help="TOML file with a SuiteConfig; klevr: a KlevrConfig; aerial: an AerialConfig; streets: a StreetsConfig.",
    ),
]
ArmOption = Annotated[
    list[str] | None, typer.Option("--arm", help="klevr, aerial and streets: what to run; may repeat.  [default: all]")
]
ClaimsOption = Annotated[bool, typer.Option("--claims", help="klevr, aerial and streets: judge the paper's claims.")]


def refuse_given(suite: str, given: Mapping[str, object]) -> None:
    """Refuse options that were given (not None) and that the suite makes no use of.

    Raises:
        typer.BadParameter: names them.
    """
    if idle := [f"--{name.replace('_', '-')}" for name, value in given.items() if value is not None]:
        raise typer.BadParameter(f"suite {suite} makes no use of it", param_hint=", ".join(idle))


def room_tier(tier: Literal["cpu", "gpu", "record"] | None) -> Literal["cpu", "gpu"] | None:
    """The tier of a run of ROOMS.

    Raises:
        typer.BadParameter: rooms have no such tier.
    """
    if tier == "record":
        raise typer.BadParameter("rooms has the tiers cpu and gpu", param_hint="--tier")
    return tier


def suite_config(
    path: Path | None, tier: Literal["cpu", "gpu"] | None, given: dict[str, Any], maps: bool = False
) -> SuiteConfig:
    """Settings from a TOML file (None = defaults), with what the command line says on top.

    Args:
        path: Holds a ``SuiteConfig``.
        tier: Replaces the file's.
        given: Values of options by name, None = not given; ``keyframes``, ``seconds`` and ``steps`` go to ``scene``.
        maps: Whether rooms are mapped, too.

    Raises:
        ConfigError: a file or value that cannot be used.
        typer.BadParameter: an option that the protocol makes no use of.
    """
    from research.suites.config import TIERS, SuiteConfig
    from semantic_mapper.config import convert_config, load_config, to_plain

    plain = to_plain(load_config(path, SuiteConfig) if path else SuiteConfig())
    if tier is not None:
        plain["tier"] = to_plain(TIERS[tier])
    given = {name: value for name, value in given.items() if value is not None}
    if given.get("steps") and "seconds" not in given:
        given["seconds"] = 0.0
    for name, value in given.items():
        section = plain["scene"] if name in ("keyframes", "seconds", "steps") else plain
        section[name] = value
    settings = convert_config(plain, SuiteConfig, "command line")
    _refuse_idle(settings.protocol, given, maps)
    return settings


def _refuse_idle(protocol: str, given: dict[str, Any], maps: bool) -> None:
    """Refuse options that the protocol makes no use of.

    Raises:
        typer.BadParameter: names them.
    """
    if protocol != "generalize" and given.keys() & {"sources", "own_image"}:
        hint = "--sources, --own-image"
        raise typer.BadParameter("go with --protocol generalize: keyframes are all there is", param_hint=hint)
    if protocol != "generalize" and maps:
        raise typer.BadParameter(
            "goes with --protocol generalize: maps are made with weights as they are", param_hint="--map"
        )
    if given.get("depth") == "computed" and given.get("current") == "hard":
        raise typer.BadParameter("is computed of a walk; images of --current hard stand alone", param_hint="--depth")
    if protocol == "generalize" and given.keys() & {"keyframes", "steps", "seconds"}:
        hint = "--steps, --seconds, --keyframes"
        raise typer.BadParameter("go with --protocol finetune and scratch", param_hint=hint)
