"""Make one weights file of several that share their beginnings: the mean of their tensors, shipped as any other.

    python -m research.train.mean_weights A.safetensors B.safetensors --out MEAN.safetensors

After Wortsman et al., Model soups (ICML 2022): runs that go on from the same weights mostly lie in one basin, and what
each learned survives the mean.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from research.train.recipe import origin, provenance
from semantic_mapper.errors import ConfigError, SemanticMapperError
from semantic_mapper.fields.checkpoint import Checkpoint, adapt_model, load_checkpoint, save_checkpoint


def mean(paths: Sequence[Path]) -> Checkpoint:
    """The mean of several files, with the network and the classes of the first; a row of the classifier is the mean of
    the files that know its class.

    Raises WeightsError: unreadable. ConfigError: of other networks, or with classes that the first lacks.
    """
    found = [load_checkpoint(path) for path in paths]
    model = found[0].model
    state = {name: torch.zeros_like(tensor, dtype=torch.float64) for name, tensor in model.state_dict().items()}
    count = dict.fromkeys(state, torch.tensor(0.0))
    for path, theirs in zip(paths, (checkpoint.model for checkpoint in found), strict=True):
        if (theirs.kind, theirs.config) != (model.kind, model.config):
            raise ConfigError(f"{path}: weights of another network than {paths[0]}")
        if unknown := sorted(set(theirs.label_set.names) - set(model.label_set.names)):
            raise ConfigError(f"{path}: knows {', '.join(unknown)}, which {paths[0]} does not; name this file first")
        knows = torch.tensor([name in theirs.label_set.names for name in model.label_set.names])
        for name, tensor in adapt_model(theirs, model.label_set).state_dict().items():
            share = knows.reshape(-1, *[1] * (tensor.ndim - 1)) if name in model.class_rows else torch.tensor(1.0)
            state[name] += tensor * share
            count[name] = count[name] + share
    model.load_state_dict({name: total / count[name] for name, total in state.items()})
    recipe = {"kind": model.kind, "width": found[0].width, "suite": found[0].recipe.get("suite")}
    recipe["origins"] = [origin(path, checkpoint.recipe) for path, checkpoint in zip(paths, found, strict=True)]
    return Checkpoint(model, (), recipe | provenance(torch.device("cpu")))


def main() -> None:
    """Write the mean, as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", type=Path, metavar="W", nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    try:
        save_checkpoint(mean(given.weights), given.out)
    except SemanticMapperError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
