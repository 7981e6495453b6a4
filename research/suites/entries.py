"""Weights files, and kinds of fields with random weights, as entries of a run."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

import torch

from research.peers.kinds import build_field
from research.scenes.suite import ROOMS_SUITE
from research.suites.protocols import Entry
from semantic_mapper.config import to_plain
from semantic_mapper.errors import ConfigError, WeightsError
from semantic_mapper.fields.checkpoint import load_checkpoint
from semantic_mapper.fields.learned import LearnedField


def load_entries(paths: Sequence[Path], kinds: Sequence[str] = ()) -> list[Entry]:
    """Load weights files onto the GPU where there is one, else the CPU; each is named by its file or its folder.

    Raises WeightsError: a file that cannot be used, or one given twice. ConfigError: no such kind, or one given twice.

    Args:
        kinds: Names of ``fields.learned`` that take part with random weights and default settings, after the files.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    checkpoints = [load_checkpoint(path) for path in paths]
    # The config too: a file of before may lack a setting, whose default changes what the weights do.
    digests = [
        _digest(path.read_bytes(), checkpoint.model) for path, checkpoint in zip(paths, checkpoints, strict=True)
    ]
    if len(set(digests)) < len(digests):
        raise WeightsError("the same weights are given twice; a difference to themselves says nothing")
    names = _names(paths)
    if twice := sorted({kind for kind in kinds if [*names, *kinds].count(kind) > 1}):
        raise ConfigError(f"--kind {', '.join(twice)}: the name of another column; give each once")
    return [
        Entry(name, digest, checkpoint.model.to(device).eval(), path.name)
        for name, digest, checkpoint, path in zip(names, digests, checkpoints, paths, strict=True)
    ] + [_of_kind(kind, device) for kind in kinds]


def _of_kind(kind: str, device: torch.device) -> Entry:
    field = build_field(kind, {}, ROOMS_SUITE.label_set).to(device).eval()
    return Entry(kind, _digest(b"", field), field)


def _digest(data: bytes, field: LearnedField) -> str:
    shape = json.dumps([field.kind, to_plain(field.config)], sort_keys=True)
    return hashlib.sha256(data + shape.encode()).hexdigest()[:16]


def _names(paths: Sequence[Path]) -> list[str]:
    """Names of the files; of their folders where all files are called alike, as training does; else whole paths."""
    for names in ([path.stem for path in paths], [path.resolve().parent.name for path in paths]):
        if len(set(names)) == len(names):
            return names
    return [str(path) for path in paths]
