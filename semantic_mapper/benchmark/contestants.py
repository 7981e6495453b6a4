"""Weights files as contestants of a run."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import torch

from semantic_mapper.benchmark.protocols import Contestant
from semantic_mapper.errors import WeightsError
from semantic_mapper.fields.checkpoint import load_checkpoint


def load_contestants(paths: Sequence[Path]) -> list[Contestant]:
    """Load weights files onto the GPU where there is one, else the CPU; each is named by its file or its folder.

    Raises:
        WeightsError: a file that cannot be used, or one given twice.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    checkpoints = [load_checkpoint(path) for path in paths]
    digests = [hashlib.sha256(path.read_bytes()).hexdigest()[:16] for path in paths]
    if len(set(digests)) < len(digests):
        raise WeightsError("the same weights are given twice; a difference to themselves says nothing")
    names = _names(paths)
    return [
        Contestant(name, digest, checkpoint.model.to(device).eval())
        for name, digest, checkpoint in zip(names, digests, checkpoints, strict=True)
    ]


def _names(paths: Sequence[Path]) -> list[str]:
    """Names of the files; of their folders where all files are called alike, as training does; else whole paths."""
    for names in ([path.stem for path in paths], [path.resolve().parent.name for path in paths]):
        if len(set(names)) == len(names):
            return names
    return [str(path) for path in paths]
