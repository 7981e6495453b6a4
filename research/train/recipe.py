"""Where weights come from: what a checkpoint says of its training."""

from __future__ import annotations

import hashlib
import platform
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

import semantic_mapper

_PACKAGE = Path(semantic_mapper.__file__).resolve().parent


def provenance(device: torch.device) -> dict[str, Any]:
    """Versions, device and git revision, as plain data."""
    on_gpu = device.type == "cuda"
    return {
        "version": semantic_mapper.__version__,
        "git_revision": git_revision(_PACKAGE),
        "torch": torch.__version__,
        "device": torch.cuda.get_device_name(device) if on_gpu else f"cpu, {torch.get_num_threads()} threads",
        "platform": platform.platform(),
    }


def origin(path: Path, recipe: dict[str, Any]) -> dict[str, Any]:
    """What weights say of the file that they started from: its name, its digest, and how it was made in its turn."""
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return {"file": path.name, "sha256": digest, "recipe": {k: v for k, v in recipe.items() if k != "history"}}


def rooms_before(origins: Sequence[Mapping[str, Any]]) -> int:
    """How many rooms the runs of ``origin`` and theirs have seen.

    A run goes on behind them: on rooms that its encoder was fitted to, features are surer than they will ever be again,
    and all that reads them would learn to trust them.
    """
    recipes = [origin["recipe"] for origin in origins]
    return sum(int(recipe.get("rooms", 0)) + rooms_before(recipe.get("origins", ())) for recipe in recipes)


def git_revision(package: Path) -> str | None:
    """Commit of the checkout whose top folder holds ``package``, with "-dirty" where files differ from it.

    None where the package is installed rather than checked out, or where git is missing.
    """
    top = _git(package, "rev-parse", "--show-toplevel")
    if top is None or Path(top).resolve() != package.parent:
        return None
    return _git(package, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *arguments], capture_output=True, text=True, check=False, timeout=30
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None
