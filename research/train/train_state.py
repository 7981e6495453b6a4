"""All that a training run needs to go on where it stopped, in one file.

Safetensors with JSON metadata: reading one runs no code. Random draws of a step follow from (seed, rank, step), and the
rooms of the pool from the number of draws, so the step number stands for the generators and for the pool.
"""

from __future__ import annotations

# torch and safetensors leave parts of their interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import nn

from semantic_mapper.errors import ConfigError, WeightsError
from semantic_mapper.fields.weights import save_tensors

FORMAT = "semantic-mapper-training"
VERSION = 3
LOSS_PARTS = ("total", "semantic", "colour", "depth")


@dataclass(slots=True)
class Progress:
    """How far a run is; everything but model and optimiser.

    Args:
        step: Steps done.
        draws: Rooms drawn from the pool.
        elapsed_s: Time spent in the loop, over all sittings.
        validated: How many of the validations that the budget holds are done.
        losses: (4,) float64 on the training device: sums of ``LOSS_PARTS`` since the last such line of the history.
        history: Lines of plain data; see ``train_log``.
        best: Weights to keep: of the validation that scored best, or of the last one; None before the first.
        best_step, best_score: Of ``best``; the score is what validation ranks by.
        depth_grown: The encoder's network for views with depth has grown from the one for colours.
        past_images: Steps on images alone are over, once and for all.
        images_steps, images_s: Steps and seconds that they took, once they are over.
        finished: The budget is used up.
        origins: Of what the run started from, see ``recipe.origin``.
    """

    losses: torch.Tensor
    step: int = 0
    draws: int = 0
    elapsed_s: float = 0.0
    validated: int = 0
    history: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])
    best: dict[str, torch.Tensor] | None = None
    best_step: int = 0
    best_score: float = -1.0
    depth_grown: bool = False
    past_images: bool = False
    images_steps: int = 0
    images_s: float = 0.0
    finished: bool = False
    origins: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])


def save_state(
    path: Path, progress: Progress, model: nn.Module, optimiser: torch.optim.Optimizer, config: dict[str, Any]
) -> None:
    """Write everything, whole or not at all: under another name, to the disk, then renamed into place.

    Args:
        config: Of the run, as plain data; ``load_state`` refuses to go on with another.
    """
    tensors = {f"model.{name}": t for name, t in model.state_dict().items()}
    tensors |= {f"best.{name}": t for name, t in (progress.best or {}).items()}
    for number, slots in optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser.{number}.{name}": torch.as_tensor(value) for name, value in slots.items()}
    tensors["losses"] = progress.losses
    metadata = {
        "format": FORMAT,
        "version": str(VERSION),
        "config": json.dumps(config),
        "step": str(progress.step),
        "draws": str(progress.draws),
        "elapsed_s": repr(progress.elapsed_s),
        "validated": str(progress.validated),
        "best_step": str(progress.best_step),
        "best_score": repr(progress.best_score),
        "depth_grown": str(progress.depth_grown),
        "past_images": str(progress.past_images),
        "images_steps": str(progress.images_steps),
        "images_s": repr(progress.images_s),
        "finished": str(progress.finished),
        "history": json.dumps(progress.history),
        "origins": json.dumps(progress.origins),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    save_tensors({name: t.detach().cpu().contiguous().numpy().copy() for name, t in tensors.items()}, path, metadata)


def unfinished_step(path: Path) -> int | None:
    """Step at which the run of a state stopped before its budget was used up; None where it was not stopped.

    Raises WeightsError: missing, damaged or of another version.
    """
    _, metadata = _read(path, only_metadata=True)
    return None if metadata.get("finished") == "True" else int(metadata["step"])


def load_state(path: Path, model: nn.Module, optimiser: torch.optim.Optimizer, config: dict[str, Any]) -> Progress:
    """Put model and optimiser where the run stopped.

    Raises WeightsError: missing, damaged, of another version, or of another network. ConfigError: the run had another
    config.
    """
    tensors, metadata = _read(path)
    try:
        _check_same(json.loads(metadata["config"]), config, path)
        model.load_state_dict(_part(tensors, "model."))
        _load_optimiser(optimiser, _part(tensors, "optimiser."))
        best = _part(tensors, "best.")
        return Progress(
            losses=tensors["losses"].to(next(model.parameters()).device),
            step=int(metadata["step"]),
            draws=int(metadata["draws"]),
            elapsed_s=float(metadata["elapsed_s"]),
            validated=int(metadata["validated"]),
            history=json.loads(metadata["history"]),
            # Runs of before did not note these three.
            origins=json.loads(metadata.get("origins", "[]")),
            images_steps=int(metadata.get("images_steps", 0)),
            images_s=float(metadata.get("images_s", 0.0)),
            best=best or None,
            best_step=int(metadata["best_step"]),
            best_score=float(metadata["best_score"]),
            depth_grown=metadata["depth_grown"] == "True",
            past_images=metadata["past_images"] == "True",
        )
    except ConfigError:
        raise
    except (KeyError, ValueError, IndexError, RuntimeError) as error:
        raise WeightsError(f"{path}: does not fit this training ({error}); restart in another folder") from error


def _read(path: Path, *, only_metadata: bool = False) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    if not path.is_file():
        raise WeightsError(f"{path}: no such training state; train without --resume first, or check --out")
    try:
        with safe_open(path, framework="pt") as stored:
            metadata = dict(stored.metadata() or {})
            names = [] if only_metadata else list(stored.keys())
            tensors = {name: stored.get_tensor(name) for name in names}
    except (SafetensorError, OSError) as error:
        raise WeightsError(f"{path}: not a readable training state ({error}); delete it to restart") from error
    if metadata.get("format") != FORMAT or metadata.get("version") != str(VERSION):
        raise WeightsError(f"{path}: not a training state of this version ({FORMAT} {VERSION}); delete it to restart")
    return tensors, metadata


def _part(tensors: dict[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    return {name.removeprefix(prefix): t for name, t in tensors.items() if name.startswith(prefix)}


def _load_optimiser(optimiser: torch.optim.Optimizer, stored: dict[str, torch.Tensor]) -> None:
    parameters = [p for group in optimiser.param_groups for p in group["params"]]
    state: dict[int, dict[str, torch.Tensor]] = {}
    for name, value in stored.items():
        number, slot = name.split(".", 1)
        like = parameters[int(number)]
        # In the parameter's own memory format: another order of the same sums would give other last bits.
        placed = value if value.ndim == 0 else torch.empty_like(like).copy_(value)
        state.setdefault(int(number), {})[slot] = placed
    optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})


def _check_same(stored: dict[str, Any], wanted: dict[str, Any], path: Path) -> None:
    wanted = json.loads(json.dumps(wanted))  # as it would have been stored: tuples become lists
    other = sorted(k for k in stored.keys() | wanted.keys() if stored.get(k) != wanted.get(k))
    if other:
        said = "; ".join(f"{k} was {stored.get(k)}, is {wanted.get(k)}" for k in other)
        raise ConfigError(f"{path}: cannot go on with another config ({said}); restart in another folder")
