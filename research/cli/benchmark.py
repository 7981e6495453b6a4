"""``semantic-mapper-research suite``: score weights on rooms, or methods on other scenes, never trained on."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from research.cli import suite_options as suites
from semantic_mapper.nodes.cli.verb import JsonOption, verb

WeightsOption = Annotated[
    list[Path] | None,
    typer.Option("--weights", help="Weights file, several to compare them; the one in the package without it."),
]
OutOption = Annotated[Path | None, typer.Option("--out", metavar="FILE", help="JSON; else runs/SUITE-*.json.")]
SeedOption = Annotated[int | None, typer.Option(min=0, help="Of everything that is drawn at random.  [default: 0]")]


@verb
def benchmark(
    suite: Annotated[Literal["rooms", "klevr", "aerial", "streets"], typer.Argument(help="The suite.")] = "rooms",
    weights: WeightsOption = None,
    protocol: suites.ProtocolOption = None,
    split: suites.SplitOption = None,
    rooms: suites.RoomsOption = None,
    kind: suites.KindOption = None,
    views: suites.ViewsOption = None,
    sources: suites.SourcesOption = None,
    own_image: suites.OwnImageOption = None,
    current: suites.CurrentOption = None,
    depth: suites.DepthOption = None,
    tier: suites.TierOption = None,
    keyframes: suites.KeyframesOption = None,
    seconds: suites.SecondsOption = None,
    steps: suites.StepsOption = None,
    maps: suites.MapOption = False,
    arms: suites.ArmOption = None,
    claims: suites.ClaimsOption = False,
    refine: suites.RefineOption = None,
    config: suites.SuiteConfigOption = None,
    seed: SeedOption = None,
    out: OutOption = None,
    json: JsonOption = False,
) -> int:
    """Score weights on the rooms of a suite, one column a weights file, and draw a contact sheet.

    Query views of rooms that nothing was trained on are rendered from source views. Below them stand the same views
    without learned fusion, and by a per-image U-Net where one is among the weights. An interrupted run continues where
    it was. research/docs/benchmarks.md says what each figure means. Writes JSON, a page of HTML, the contact sheet
    and the records of the rooms.

    klevr: arms learn classes from the label maps of training scenes and are scored on novel scenes. Only --arm,
    --claims, --tier, --config, --seed, --out and --json go with it.

    aerial: arms learn a town seen from a drone from 80 views, 4 of which have labels. The same options go with it.

    streets: arms label every image of a drive from annotated boxes and noisy predicted labels. The same options go
    with it.

    Example: semantic-mapper-research suite rooms --weights a.safetensors --weights b.safetensors --out runs/ab.json
    Example: semantic-mapper-research suite rooms --sources wide --depth off --rooms 5 --json
    Example: semantic-mapper-research suite rooms --protocol scratch --kind semantic_nerf --rooms 3 --seconds 600
    Example: semantic-mapper-research suite klevr --claims --out runs/klevr.json
    Example: semantic-mapper-research suite aerial --claims --out runs/aerial.json
    Example: semantic-mapper-research suite streets --claims --out runs/streets.json
    """
    given = {"split": split, "rooms": rooms, "protocol": protocol, "views": views, "depth": depth}
    given |= {"sources": sources, "own_image": own_image, "current": current}
    given |= {"keyframes": keyframes, "steps": steps, "seconds": seconds, "seed": seed}
    if out is not None and out.is_file() and out.suffix != ".json":
        raise typer.BadParameter(f"{out} is there and does not end in .json; results would replace it")
    print_json = json
    if suite != "rooms":
        del given["seed"]
        suites.refuse_given(suite, given | {"weights": weights, "kind": kind, "map": maps or None, "refine": refine})
    if suite == "aerial":
        from research.cli.aerial import aerial_suite
        from research.cli.arm_suite import run_arm_suite

        return run_arm_suite(aerial_suite(config, tier, seed), arms or [], claims, out, print_json=print_json)
    if suite == "klevr":
        from research.cli.arm_suite import run_arm_suite
        from research.cli.klevr import klevr_suite

        return run_arm_suite(klevr_suite(config, tier, seed), arms or [], claims, out, print_json=print_json)
    if suite == "streets":
        from research.cli.arm_suite import run_arm_suite
        from research.cli.streets import streets_suite

        return run_arm_suite(streets_suite(config, tier, seed), arms or [], claims, out, print_json=print_json)
    from research.cli.suite import run_suite_verb

    suites.refuse_given("rooms", {"arm": arms, "claims": claims or None})
    settings = suites.suite_config(config, suites.room_tier(tier), given, maps)
    if refine is not None and not maps:
        raise typer.BadParameter("goes with --map", param_hint="--refine")
    return run_suite_verb(settings, weights or [], kind or [], maps, out, print_json=print_json, refine=refine)
