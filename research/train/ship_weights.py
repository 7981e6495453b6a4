"""Put trained weights into the package, as float16, with the figures that the benchmark found for that very float16.

Convert, measure what was converted with depth and without, ship it; shipping also renews the table of the model card:

    python -m research.train.ship_weights W --half-only HALF
    semantic-mapper-research suite rooms --weights HALF --out on.json
    semantic-mapper-research suite rooms --weights HALF --out off.json --depth off
    python -m research.train.ship_weights HALF --figures on.json --figures off.json

Renew that table alone, from what the weights in the package say of themselves:

    python -m research.train.ship_weights --card
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from research.suites.entries import load_entries
from semantic_mapper.errors import ConfigError, SemanticMapperError, WeightsError
from semantic_mapper.fields.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from semantic_mapper.fields.weights import default_checkpoint_path

CARD = Path(__file__).resolve().parents[2] / "docs" / "model-card.md"
BEGIN, END = "<!-- metadata -->", "<!-- /metadata -->"
MOST_BYTES = 16_000_000
SETTINGS = ("split", "protocol", "views", "sources", "own_image", "depth")
FIGURES = ("rooms", "images", "data_set", "depth_abs_rel", "ece", "consistency")
COMMIT = re.compile(r"[0-9a-f]{40}")


def chain(recipe: dict[str, Any]) -> list[dict[str, Any]]:
    """The recipes of all runs that weights come from, each once, from those that began with random weights (or with
    others') to their own."""
    runs: list[dict[str, Any]] = []

    def visit(run: dict[str, Any]) -> None:
        if run not in runs:
            for before in _before(run):
                visit(before)
            runs.append(run)

    visit(recipe)
    return runs


def _before(run: dict[str, Any]) -> list[dict[str, Any]]:
    return [o["recipe"] for o in run.get("origins") or () if not _of_others(o)]


def _of_others(origin: dict[str, Any]) -> bool:
    """Whether these are published weights that no run of this project has made."""
    return origin["recipe"].get("kind") == "imagenet"


def check_chain(weights: Path, recipe: dict[str, Any]) -> None:
    """See to it that every run behind ``weights`` can be done again.

    Raises WeightsError: a run of code that no commit holds.
    """
    for run in chain(recipe):
        config, revision = run.get("config", {}), run.get("git_revision")
        if not COMMIT.fullmatch(str(revision)):
            raise WeightsError(
                f"{weights}: a run on {_data(config)} is of revision {revision}; commit first, to be able to repeat it"
            )


def figures_of(weights: Path, table: Path) -> dict[str, Any]:
    """What a table of the benchmark says of this very file, whose digest goes with it as ``measured``.

    Raises ConfigError: not a finished table of the whole split, or one of other weights.
    """
    try:
        found = json.loads(table.read_text(encoding="utf-8"))
        suite, complete, entries = found["suite"], found["complete"], found["weights"].values()
    except (OSError, ValueError, KeyError) as error:
        raise ConfigError(f"{table}: not a table of `suite rooms` ({error})") from error
    if not complete or suite["rooms"]:
        raise ConfigError(f"{table}: does not hold all rooms of its split; run the same command to its end")
    digest = load_entries([weights])[0].digest
    entry = next((e for e in entries if e["digest"] == digest), None)
    if entry is None:
        raise ConfigError(f"{table}: holds no figures of {weights}; evaluate that file")
    figures = {key: entry["figures"].get(key) for key in FIGURES}
    return {key: suite[key] for key in SETTINGS} | figures | {"measured": digest}


def both_figures(weights: Path, tables: Sequence[Path]) -> list[dict[str, Any]]:
    """Figures with depth and without, in this order.

    Raises ConfigError: other tables than one with and one without depth that agree in all else; see ``figures_of``.
    """
    figures = sorted((figures_of(weights, table) for table in tables), key=lambda figure: figure["depth"] != "on")
    alike = {tuple(figure[key] for key in SETTINGS if key != "depth") for figure in figures}
    if [figure["depth"] for figure in figures] != ["on", "off"] or len(alike) != 1:
        raise ConfigError("--figures: give two tables of the same settings, one with and one without `--depth off`")
    return figures


def convert(weights: Path, out: Path) -> None:
    """Write ``weights`` to ``out`` as they will be shipped, to be measured.

    Raises WeightsError: unreadable, too large, or of a run that nobody can do again.
    """
    checkpoint = load_checkpoint(weights)
    check_chain(weights, checkpoint.recipe)
    _save(checkpoint, out)


def ship(half: Path, tables: Sequence[Path], out: Path, card: Path) -> None:
    """Write what ``convert`` made to ``out`` with the figures of ``tables`` in its recipe, and their table to ``card``.

    Raises WeightsError: unreadable, of a run that nobody can do again, or not float16 yet. ConfigError: see
    ``both_figures``.
    """
    checkpoint = load_checkpoint(half)
    check_chain(half, checkpoint.recipe)
    if any(not torch.equal(tensor, as_stored(tensor, name)) for name, tensor in checkpoint.model.state_dict().items()):
        raise WeightsError(f"{half}: not what would be shipped; convert it with --half-only and evaluate that file")
    recipe = checkpoint.recipe | {"figures": both_figures(half, tables)}
    _save(replace(checkpoint, recipe=recipe), out)
    renew_card(card, out)


def as_stored(tensor: torch.Tensor, name: str) -> torch.Tensor:
    """A tensor of a model as it comes back from a file of half precision."""
    return tensor.half().float() if tensor.is_floating_point() and "running_" not in name else tensor


def renew_card(card: Path, weights: Path) -> None:
    """Replace what lies between the two marks of ``card`` by ``metadata_block``.

    Raises ConfigError: the marks are missing.
    """
    text = card.read_text(encoding="utf-8")
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise ConfigError(f"{card}: must hold a line `{BEGIN}` and, behind it, a line `{END}`")
    card.write_text(f"{before}{BEGIN}\n{metadata_block(weights)}{END}{after}", encoding="utf-8")


def metadata_block(weights: Path) -> str:
    """What a file says of itself, as Markdown: the network, the runs that made it, and what was measured."""
    checkpoint = load_checkpoint(weights)
    model, recipe = checkpoint.model, checkpoint.recipe
    parameters = sum(p.numel() for p in model.parameters())
    head = [
        f"Field `{model.kind}`, {parameters / 1e6:.1f} M parameters, {weights.stat().st_size / 1e6:.1f} MB; label set "
        f"`{model.label_set.name}`, {len(model.label_set)} classes; images {checkpoint.width} pixels wide; "
        f"training rooms of suite `{recipe.get('suite')}`.",
        "",
        f"The runs, the first from {_first_weights(recipe)}; seconds of one core or GPU:",
        "",
    ]
    parts = [*head, *_run_table(recipe), "", *_figure_table(recipe.get("figures") or ())]
    return "\n".join(parts) + "\n"


def _first_weights(recipe: dict[str, Any]) -> str:
    others = [o for run in chain(recipe) for o in run.get("origins") or () if _of_others(o)]
    if not others:
        return "random ones"
    named = (f"`{o['file']}` ({o['recipe'].get('licence')}, SHA-256 `{o['sha256'][:12]}`)" for o in others)
    return f"random ones but for the backbone of the image encoder, ImageNet weights {', '.join(named)}"


def _run_table(recipe: dict[str, Any]) -> list[str]:
    rows = [("run", "from", "trained on", "encoder sees", "steps", "weights kept", "rooms", "seed", "revision", "s")]
    runs = chain(recipe)
    for number, run in enumerate(runs, 1):
        config, trained = run.get("config", {}), "steps" in run
        validations = config.get("validation", {}).get("times")
        kept = "last" if config.get("keep") == "last" else f"best of {validations}: step {run.get('best_step')}"
        rows.append(
            (
                str(number),
                ", ".join(str(runs.index(before) + 1) for before in _before(run)) or "-",
                _data(config) if trained else "their mean",
                _depth(config) if trained else "-",
                _count(run.get("steps")),
                kept if trained else "-",
                _count(run.get("rooms")),
                str(run.get("seed", "-")),
                f"`{str(run.get('git_revision'))[:7]}`",
                _count(run.get("seconds")),
            )
        )
    return _markdown(rows)


def _figure_table(figures: Sequence[dict[str, Any]]) -> list[str]:
    if not figures:
        return ["Nothing was measured."]
    first = figures[0]
    own = " with the query's own image" if first["own_image"] else ""
    title = (
        f"Measured with these weights on {first['rooms']} rooms of the {first['split']} split, {first['images']}"
        f" images, protocol `{first['protocol']}`, {first['views']} views, sources `{first['sources']}`{own}:"
    )
    rows = [("", *("sensor depth" if figure["depth"] == "on" else "no depth" for figure in figures))]
    for name, key in (("mIoU", "miou"), ("total accuracy", "total_accuracy"), ("average accuracy", "average_accuracy")):
        rows.append((name, *(_percent(figure["data_set"].get(key)) for figure in figures)))
    rows.append(("calibration error", *(_percent(figure.get("ece")) for figure in figures)))
    rows.append(("agreement of neighbouring views", *(_percent(figure.get("consistency")) for figure in figures)))
    rows.append(("depth, relative error", *(_percent(figure.get("depth_abs_rel")) for figure in figures)))
    return [title, "", *_markdown(rows)]


def _markdown(rows: Sequence[tuple[str, ...]]) -> list[str]:
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return [lines[0], "|" + "---|" * len(rows[0]), *lines[1:]]


def _data(config: dict[str, Any]) -> str:
    images = config.get("images", {})
    share, later = images.get("fraction", images.get("share", 0.0)), images.get("later", 0.0)
    rays = f"rays and, {later:.0%} of the steps, images" if later else "rays"
    return "images" if share == 1 else rays if share == 0 else f"images, from {share:.0%} of the steps on {rays}"


def _depth(config: dict[str, Any]) -> str:
    depth = config.get("field", {}).get("encoder", {}).get("depth")
    return {True: "colours and depth", False: "colours", None: "as by default"}[depth]


def _count(number: float | None) -> str:
    return "-" if number is None else f"{number:,.0f}"


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f} %"


def _save(checkpoint: Checkpoint, out: Path) -> None:
    part = out.with_name(out.name + ".new")
    save_checkpoint(checkpoint, part, half=True)
    size = part.stat().st_size
    if size > MOST_BYTES:
        part.unlink()
        raise WeightsError(f"{out}: {size / 1e6:.1f} MB as float16, the package takes {MOST_BYTES / 1e6:.0f} MB")
    part.replace(out)
    print(f"{out}: {size / 1e6:.1f} MB, trained at {checkpoint.recipe['git_revision']}")


def main() -> int:
    """Convert, ship, or renew the card, as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", type=Path, metavar="W", nargs="?")
    verb = parser.add_mutually_exclusive_group(required=True)
    verb.add_argument("--half-only", type=Path, metavar="OUT", help="convert only, so that it can be measured")
    verb.add_argument("--figures", type=Path, action="append", metavar="JSON", help="twice: with and without depth")
    verb.add_argument("--card", action="store_true", help="renew the table of the model card, and print it")
    given = parser.parse_args()
    if (given.weights is None) != given.card:
        parser.error("--card takes the weights of the package" if given.card else "which weights?")
    package = default_checkpoint_path()
    try:
        if given.half_only:
            convert(given.weights, given.half_only)
        elif given.figures:
            ship(given.weights, given.figures, package, CARD)
        else:
            renew_card(CARD, package)
            print(metadata_block(package), end="")
    except SemanticMapperError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
