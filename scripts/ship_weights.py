"""Put trained weights into the package, as float16, with the figures that the benchmark found for them.

semantic-mapper eval --suite rooms --weights W --json on.json
semantic-mapper eval --suite rooms --weights W --json off.json --depth off
python scripts/ship_weights.py W --figures on.json --figures off.json
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from semantic_mapper.benchmark.contestants import load_contestants
from semantic_mapper.errors import ConfigError, SemanticMapperError, WeightsError
from semantic_mapper.fields.checkpoint import default_checkpoint_path, load_checkpoint, save_checkpoint

MOST_BYTES = 16_000_000
SETTINGS = ("split", "protocol", "views", "baseline", "depth")
FIGURES = ("rooms", "images", "data_set", "psnr_db", "ssim", "depth_abs_rel", "ece", "consistency")


def figures_of(weights: Path, table: Path) -> dict[str, Any]:
    """What a table of the benchmark says of these very weights.

    Raises:
        ConfigError: not a finished table of the whole split, or one of other weights.
    """
    try:
        found = json.loads(table.read_text(encoding="utf-8"))
        suite, complete, entries = found["suite"], found["complete"], found["weights"].values()
    except (OSError, ValueError, KeyError) as error:
        raise ConfigError(f"{table}: not a table of `eval --suite rooms` ({error})") from error
    if not complete or suite["rooms"]:
        raise ConfigError(f"{table}: does not hold all rooms of its split; run the same command to its end")
    digest = load_contestants([weights])[0].digest
    entry = next((e for e in entries if e["digest"] == digest), None)
    if entry is None:
        raise ConfigError(f"{table}: holds no figures of {weights}; evaluate that file")
    return {key: suite[key] for key in SETTINGS} | {key: entry["figures"].get(key) for key in FIGURES}


def ship(weights: Path, tables: list[Path], out: Path) -> None:
    """Write ``weights`` to ``out`` with the figures of ``tables`` in its recipe.

    Raises:
        WeightsError: unreadable, too large, or trained by code that no commit holds.
        ConfigError: see ``figures_of``.
    """
    checkpoint = load_checkpoint(weights)
    revision = checkpoint.recipe.get("git_revision")
    if not revision or revision.endswith("-dirty"):
        raise WeightsError(f"{weights}: trained at revision {revision}; commit first, so that it can be trained again")
    recipe = checkpoint.recipe | {"figures": [figures_of(weights, table) for table in tables]}
    part = out.with_name(out.name + ".new")
    save_checkpoint(replace(checkpoint, recipe=recipe), part, half=True)
    size = part.stat().st_size
    if size > MOST_BYTES:
        part.unlink()
        raise WeightsError(f"{weights}: {size / 1e6:.1f} MB as float16, the package takes {MOST_BYTES / 1e6:.0f} MB")
    part.replace(out)
    print(f"{out}: {size / 1e6:.1f} MB, trained at {revision}")


def main() -> int:
    """Ship what the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", type=Path, metavar="W")
    parser.add_argument("--figures", type=Path, action="append", required=True, metavar="JSON", help="may repeat")
    given = parser.parse_args()
    try:
        ship(given.weights, given.figures, default_checkpoint_path())
    except SemanticMapperError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
