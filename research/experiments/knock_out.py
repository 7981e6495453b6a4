"""A weights file of S-Ray without one of its parts, to be compared with the whole one in the same rooms.

    python -m research.experiments.knock_out attention WEIGHTS OUT
    semantic-mapper benchmark rooms --sources wide --weights WEIGHTS --weights OUT --out knocked.json

``attention``: views do not attend to each other (Eq. 10). ``view-weights``: all views that see a point as well count
alike (Eq. 11 and 12). ``both``: what is left is a vote of the views, weighted by what they see.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from semantic_mapper.errors import WeightsError
from semantic_mapper.fields.checkpoint import load_checkpoint, save_checkpoint
from semantic_mapper.fields.sray import SRay

PARTS = ("attention", "view-weights", "both")


def knock_out(part: str, weights: Path, out: Path) -> None:
    """Write ``weights`` without a part of ``PARTS`` to ``out``.

    Raises:
        WeightsError: no weights of S-Ray with tokens at the surface.
    """
    checkpoint = load_checkpoint(weights)
    model = checkpoint.model
    if not (isinstance(model, SRay) and model.at_surface):
        raise WeightsError(f"{weights}: kind '{model.kind}'; only S-Ray with tokens = \"surface\" has these parts")
    with torch.no_grad():
        if part != "view-weights":
            model.cross.out.weight.zero_()
        if part != "attention":
            model.weights.start_alike()
    save_checkpoint(checkpoint, out, half=True)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("weights", type=Path)
    parser.add_argument("out", type=Path)
    args = parser.parse_args()
    knock_out(args.part, args.weights, args.out)


if __name__ == "__main__":
    main()
