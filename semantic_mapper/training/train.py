"""Train S-Ray to generalize: rooms without end, one query view rendered from others in each step."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from semantic_mapper.config import Config, SRayConfig, to_plain
from semantic_mapper.fields.checkpoint import Checkpoint
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.sampling import sample_guided
from semantic_mapper.fields.sray import SRay
from semantic_mapper.labels import ROOMS
from semantic_mapper.scenes import SUITE_VERSION, TRAIN_SEEDS, VALIDATION_SEEDS
from semantic_mapper.training.rooms import RoomPool, RoomPoolConfig, RoomViews, render_room
from semantic_mapper.training.schedule import budget_fraction, cosine_rate
from semantic_mapper.training.step import StepConfig, pick_views, training_loss
from semantic_mapper.training.views import query_rays, stack_sources, to_device


class TrainConfig(Config, frozen=True):
    """A training run."""

    seconds: float = 1500.0  # wall-clock budget; 0 = only steps count
    steps: int = 0  # step budget; 0 = only seconds count
    learning_rate: float = 1e-3
    final_learning_rate: float = 5e-5
    weight_decay: float = 1e-4
    gradient_clip: float = 10.0
    validations: int = 8  # over the whole budget
    validation_rooms: int = 6
    validation_rays: int = 1500  # a room
    validation_views: int = 8  # source views
    seed: int = 0
    model: SRayConfig = SRayConfig()
    pool: RoomPoolConfig = RoomPoolConfig()
    step: StepConfig = StepConfig(views_min=3, views_max=5)


@dataclass(frozen=True, slots=True)
class TrainProgress:
    """State after a step: budget used, smoothed loss, last validation mIoU (NaN before the first)."""

    step: int
    fraction: float
    loss: float
    validation_miou: float


def train(config: TrainConfig, on_progress: Callable[[TrainProgress], None] | None = None) -> Checkpoint:
    """Train from scratch on the training rooms; returns the weights that were best on the validation rooms."""
    torch.manual_seed(config.seed)
    generator = torch.Generator().manual_seed(config.seed)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    model = SRay(config.model, ROOMS).to(device)
    pool = RoomPool(config.pool, first_seed=config.seed * 10_000 % len(TRAIN_SEEDS))
    validation = [render_room(seed, config.pool) for seed in VALIDATION_SEEDS[: config.validation_rooms]]
    optimiser = torch.optim.AdamW(model.parameters(), config.learning_rate, weight_decay=config.weight_decay)
    began, step, smoothed, validated = time.monotonic(), 0, float("nan"), 0
    miou, best_miou, best_state = float("nan"), -1.0, model.state_dict()
    history: list[dict[str, float]] = []
    while (fraction := budget_fraction(step, time.monotonic() - began, steps=config.steps, seconds=config.seconds)) < 1:
        for group in optimiser.param_groups:
            group["lr"] = learning_rate(fraction, config)
        room = pool.draw(generator)
        query, sources = pick_views(len(room.views), config.step, generator)
        loss = training_loss(model, room.views, query, sources, config.step, generator)
        step += 1
        if loss is None:
            continue
        optimiser.zero_grad()
        loss.total.backward()  # pyright: ignore[reportUnknownMemberType]
        torch.nn.utils.clip_grad_norm_(model.parameters(), config.gradient_clip)
        optimiser.step()
        value = float(loss.total.detach())
        smoothed = value if np.isnan(smoothed) else 0.98 * smoothed + 0.02 * value
        fraction = budget_fraction(step, time.monotonic() - began, steps=config.steps, seconds=config.seconds)
        if fraction * config.validations >= validated + 1 or fraction >= 1:
            validated = int(fraction * config.validations)
            miou, accuracy = validate(model, validation, config)
            history.append({"step": step, "loss": smoothed, "miou": miou, "accuracy": accuracy})
            if miou > best_miou:
                best_miou, best_state = miou, {n: t.detach().clone() for n, t in model.state_dict().items()}
        if on_progress is not None:
            on_progress(TrainProgress(step, min(fraction, 1.0), smoothed, miou))
    model.load_state_dict(best_state)
    recipe: dict[str, Any] = {
        "kind": "train",
        "width": config.pool.width,
        "config": to_plain(config),
        "suite": f"rooms v{SUITE_VERSION}",
        "steps": step,
        "rooms": pool.rooms_rendered,
        "seconds": round(time.monotonic() - began, 1),
        "device": str(device),
        "validation_miou": best_miou,
        "history": history,
    }
    return Checkpoint(model.cpu().eval(), (), recipe)


def learning_rate(fraction: float, config: TrainConfig) -> float:
    """Cosine from the first to the final learning rate, after a short linear warm-up."""
    cosine = cosine_rate(fraction, config.learning_rate, config.final_learning_rate)
    return cosine * min(1.0, fraction / 0.01 + 0.1)


def validate(model: LearnedField, rooms: Sequence[RoomViews], config: TrainConfig) -> tuple[float, float]:
    """mIoU (over the classes present) and accuracy: in each room one view rendered from the others, with depth."""
    device = next(model.parameters()).device
    generator = torch.Generator().manual_seed(1)
    classes = len(model.label_set)
    confusion = torch.zeros(classes, classes)
    sampling = config.step.sampling
    model.eval()
    with torch.inference_mode():
        for room in rooms:
            query = len(room.views) // 2
            others = [i for i in range(len(room.views)) if i != query][: config.validation_views]
            view = room.views[query]
            flat = (view.channel.flatten() >= 0).nonzero()[:, 0]
            flat = flat[torch.randint(len(flat), (config.validation_rays,), generator=generator)]
            prior = view.depth_m.flatten()[flat]
            rays, targets = query_rays(view, flat, near_m=sampling.near_m, far_m=sampling.far_m, prior=prior)
            encoded = model.encode(to_device(stack_sources([room.views[i] for i in others]), device))
            rays = to_device(rays, device)
            render, _ = model.render_samples(rays, sample_guided(rays, sampling), encoded)
            index = targets.channel * classes + render.logits.argmax(1).cpu()
            confusion += torch.bincount(index, minlength=classes**2).view(classes, classes)
    model.train()
    right = confusion.diag()
    union = confusion.sum(0) + confusion.sum(1) - right
    present = confusion.sum(1) > 0
    return float((right / union.clamp_min(1))[present].mean()), float(right.sum() / confusion.sum())
