"""Train a field to generalize: rooms without end, query views rendered from other views of the same room."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from research.peers.kinds import build_field
from research.scenes import SUITE_VERSION
from research.train.folder_lock import sole_use_of
from research.train.images import ImageBatch, images_loss
from research.train.ranks import Ranks, joined, ranks_from_environment
from research.train.recipe import provenance, rooms_before
from research.train.room_feed import FeedMaker, open_feed
from research.train.rooms import RoomPool, RoomViews, draw_images
from research.train.start import grow_depth, start_from_imagenet, take_over, take_over_encoder
from research.train.step import StepBatch, batch_loss, draw_batch, pick_views_on_path
from research.train.train_checks import check_field, check_nothing_is_overwritten, check_settings
from research.train.train_config import TrainConfig
from research.train.train_log import TrainLog
from research.train.train_state import LOSS_PARTS, Progress, load_state, save_state
from research.train.validation import Scores, validate, validation_rooms
from semantic_mapper.config import to_plain
from semantic_mapper.errors import ConfigError, WeightsError
from semantic_mapper.fields.checkpoint import Checkpoint, save_checkpoint
from semantic_mapper.fields.device import bfloat16_is_fast, choose_device, compute_in_bfloat16
from semantic_mapper.fields.encoder import calibrate
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.labels import ROOMS
from semantic_mapper.log_events import get_logger
from semantic_mapper.training.fit import budget_fraction, cosine_rate, make_optimiser, set_rates
from semantic_mapper.training.views import stack_sources

STATE_FILE = "state.safetensors"
WEIGHTS_FILE = "weights.safetensors"
IMAGES_FILE = "after-images.safetensors"  # what steps on images alone have come to
WARM_UP = 0.01  # fraction of each part of a training
ROOMS_A_SEED = 61_803  # places between the first rooms of two seeds: far apart, and no two seeds have the same
_FREE = ("seconds", "steps", "device", "workers", "save_every_s")  # may differ when a run goes on

_log = get_logger(__name__)


@dataclass(frozen=True, slots=True)
class TrainProgress:
    """State after a step: budget used, mean loss of the last line of the history, last validation (None before)."""

    step: int
    fraction: float
    loss: float | None
    scores: Scores | None


def train(
    config: TrainConfig,
    folder: Path | None = None,
    *,
    resume: bool = False,
    on_progress: Callable[[TrainProgress], None] | None = None,
    stopped: Callable[[], object] = bool,
    feed: FeedMaker = open_feed,
) -> Checkpoint:
    """Train on the training rooms; returns the weights that ``config.keep`` asks for.

    Raises ConfigError: a config that cannot be used, another one than that of the run to go on with, or a folder in use
    or with the state of another run in it. WeightsError: no state to go on with, weights to start from that cannot be
    read, or training has diverged.

    Args:
        folder: For the state, the history, the curves and the weights kept so far; None writes nothing.
        resume: Go on with the state in ``folder``. The budget may be another one, the rest of the config may not.
        stopped: Asked once a step; when it says yes, all is saved and the weights kept so far are returned.
        feed: Makes the rooms; every feed gives the same ones.
    """
    ranks = ranks_from_environment()
    device = choose_device(config.device, ranks.local)
    check_settings(config)
    if folder is None and resume:
        raise ConfigError("to go on with a run its folder is needed")
    if folder is not None and not resume:
        check_nothing_is_overwritten(folder / STATE_FILE)
    with sole_use_of(folder if ranks.first else None), joined(ranks, device):
        run = _Run(config, folder, ranks, device, feed)
        if resume:
            run.restore()
        else:
            run.begin()
        return run.loop(on_progress, stopped)


def step_seed(seed: int, rank: int, step: int) -> int:
    """Seed of all random draws of one step of one rank: a run goes on at any step without a generator's state."""
    return int(np.random.SeedSequence((seed, rank, step)).generate_state(1, np.uint64)[0] >> np.uint64(1))


class _StepLoss(nn.Module):
    """The loss of a step as a module, which is what gradients are shared through."""

    def __init__(self, field: LearnedField, config: TrainConfig) -> None:
        super().__init__()
        self.field = field
        self._config = config

    def forward(self, batch: ImageBatch | Sequence[StepBatch]) -> torch.Tensor:
        """(4,) the ``LOSS_PARTS``."""
        if isinstance(batch, ImageBatch):
            loss = images_loss(self.field, batch, self._config.images)
        else:
            together = self._config.encode_together
            loss = batch_loss(self.field, batch, self._config.step.loss, encode_together=together)
        return torch.stack([getattr(loss, part) for part in LOSS_PARTS])


class _Run:
    """One training run on one rank."""

    def __init__(
        self, config: TrainConfig, folder: Path | None, ranks: Ranks, device: torch.device, feed: FeedMaker
    ) -> None:
        torch.manual_seed(config.seed)
        self.config, self.folder, self.ranks, self.device, self.feed = config, folder, ranks, device, feed
        self.field = build_field(config.kind, config.field, ROOMS).to(device)
        check_field(self.field, config)
        trained = config.imagenet or config.start or config.encoder_from
        self.frozen: list[nn.Module] = []
        if config.backbone_rate == 0 and trained and self.field.image_encoder is not None:
            self.frozen += self.field.image_encoder.backbones()
            self.field.image_encoder.freeze(*self.frozen)
        self.loss: nn.Module = _StepLoss(self.field, config)
        if ranks.world > 1:  # parts that a config switches off (an attention, say) get no gradient
            self.loss = DistributedDataParallel(self.loss, find_unused_parameters=True)
        self.optimiser = make_optimiser(self.field, config.learning_rate, config.weight_decay)
        self.progress = Progress(torch.zeros(len(LOSS_PARTS), dtype=torch.float64, device=device))
        self.scores: Scores | None = None
        self.last_loss: float | None = None

    def begin(self) -> None:
        """Weights to start from, where the config names some.

        Raises WeightsError: they cannot be read. ConfigError: they are of another kind, shape or label set.
        """
        if self.config.start:
            self.progress.origins.append(take_over(self.field, Path(self.config.start)))
        if self.config.imagenet:
            self.progress.origins.append(start_from_imagenet(self.field))
        if self.config.encoder_from:
            self.progress.origins.append(take_over_encoder(self.field, Path(self.config.encoder_from)))

    def restore(self) -> None:
        assert self.folder is not None
        self.progress = load_state(self.folder / STATE_FILE, self.field, self.optimiser, self._identity())
        done = int(min(self._fraction(self.progress.elapsed_s), 1.0) * self.config.validation.times)
        self.progress.validated = min(self.progress.validated, done)  # fewer where the budget has grown
        self.progress.finished = False
        if self.config.images.fraction == 1:  # there are no rays to go on with, so a larger budget holds more images
            self.progress.past_images = False
        _log.info("training_resumed", step=self.progress.step, elapsed_s=round(self.progress.elapsed_s))

    def loop(self, on_progress: Callable[[TrainProgress], None] | None, stopped: Callable[[], object]) -> Checkpoint:
        config, progress = self.config, self.progress
        rooms = validation_rooms(config.validation, config.pool, self.ranks, self.device)
        self._choose_precision()
        encoder = self.field.image_encoder
        if encoder is not None and encoder.uncalibrated and config.images.fraction == 0 and rooms:
            calibrate(encoder, stack_sources(rooms[0].resident))
        pool = RoomPool(
            config.pool,
            config.seed * ROOMS_A_SEED + rooms_before(progress.origins) + self.ranks.rank,
            stride=self.ranks.world,
            draws=progress.draws,
            workers=config.workers,
            device=self.device,
            feed=self.feed,
        )
        log = TrainLog(self.folder if self.ranks.first else None, progress.history)
        self._announce()
        with pool, log:
            saved = time.monotonic()
            began = saved - progress.elapsed_s
            while True:
                progress.elapsed_s = time.monotonic() - began
                asked = float(bool(stopped()))
                fraction, stop = self.ranks.largest(min(self._fraction(progress.elapsed_s), 1.0), asked)
                due = int(fraction * config.validation.times)
                if due > progress.validated:
                    self._validate(rooms, pool, log, due)
                    self._save()
                    saved = time.monotonic()
                if fraction >= self._colours_until():
                    self._grow_depth()
                if not progress.past_images and fraction >= config.images.fraction > 0:
                    self._keep_after_images(pool)
                progress.finished = fraction >= 1
                if progress.finished or stop:
                    break
                self._step(pool, log, fraction)
                if time.monotonic() - saved >= config.save_every_s:
                    self._save()
                    saved = time.monotonic()
                if on_progress is not None and self.ranks.first:
                    on_progress(TrainProgress(progress.step, fraction, self.last_loss, self.scores))
            self._save()
            return self._checkpoint(pool)

    def _step(self, pool: RoomPool, log: TrainLog, fraction: float) -> None:
        config, progress = self.config, self.progress
        seed = step_seed(config.seed, self.ranks.rank, progress.step)
        torch.manual_seed(seed)  # for kinds of fields that draw from it
        generator = torch.Generator().manual_seed(seed)
        share = self._images_share()
        if (encoder := self.field.image_encoder) is not None and encoder.depth_net is not None:
            rests = config.images.frozen_colours and progress.depth_grown and fraction < share
            encoder.freeze(*self.frozen, *([encoder.colour_net] if rests else []))
        later = config.images.later
        on_images = fraction < share or (later > 0 and float(torch.rand(1, generator=generator)) < later)
        batch = self._draw_images(pool, generator) if on_images else self._draw(pool, generator)
        rate = learning_rate(fraction, share, config)
        encoder_rate = 1.0 if isinstance(batch, ImageBatch) else config.encoder_rate
        set_rates(self.optimiser, rate, encoder_rate, config.backbone_rate)
        parts: torch.Tensor = self.loss(batch)
        self.optimiser.zero_grad()
        parts[0].backward()
        nn.utils.clip_grad_norm_(self.field.parameters(), config.gradient_clip)
        self.optimiser.step()
        progress.losses += parts.detach()
        progress.step += 1
        if progress.step % config.log_steps == 0:  # only then, because reading a loss waits for the GPU
            self._log_losses(pool, log, rate)

    def _draw_images(self, pool: RoomPool, generator: torch.Generator) -> ImageBatch:
        rooms = [pool.draw(generator) for _ in range(self.config.images.rooms)]
        self.progress.draws += len(rooms)
        return draw_images(
            rooms, self.config.images, generator, self.device, colours_only=not self.progress.depth_grown
        )

    def _draw(self, pool: RoomPool, generator: torch.Generator) -> list[StepBatch]:
        rooms = [pool.draw(generator) for _ in range(self.config.rooms_per_step)]
        self.progress.draws += len(rooms)
        return [self._draw_rays(room, generator) for room in rooms]

    def _draw_rays(self, room: RoomViews, generator: torch.Generator) -> StepBatch:
        step = self.config.step
        query, sources = pick_views_on_path(room.labelled, len(room.views), step, generator)
        classes = len(self.field.label_set)
        batch = draw_batch(room.views, query, sources, step, generator, classes, self.device, room.resident)
        assert batch is not None  # the query is one of the labelled views
        return batch

    def _log_losses(self, pool: RoomPool, log: TrainLog, rate: float) -> None:
        progress = self.progress
        means = (progress.losses / self.config.log_steps).tolist()
        progress.losses.zero_()
        if not math.isfinite(means[0]):
            raise WeightsError(
                f"training has diverged by step {progress.step} (loss {means[0]}); lower learning_rate or "
                "gradient_clip and restart, the weights that were kept before are still there"
            )
        self.last_loss = means[0]
        losses = {f"loss_{name}": round(mean, 6) for name, mean in zip(LOSS_PARTS, means, strict=True)}
        rooms = pool.rooms_rendered * self.ranks.world
        waited = round(pool.waited_s, 2)
        log.add(self._line() | losses | {"rate": rate, "rooms": rooms, "waited_s": waited})

    def _validate(self, rooms: Sequence[RoomViews], pool: RoomPool, log: TrainLog, done: int) -> None:
        config, progress = self.config, self.progress
        self.scores = scores = validate(self.field, rooms, config.validation, config.step, self.ranks)
        progress.validated = done
        figures = {name: round(getattr(scores, name), 5) for name in scores.__slots__}
        log.add(self._line() | figures)
        log.draw()
        if self.ranks.first:
            _log.info("validated", step=progress.step, **figures)
        if scores.rank > progress.best_score or config.keep == "last":
            progress.best = {n: t.detach().clone() for n, t in self.field.state_dict().items()}
            progress.best_step, progress.best_score = progress.step, scores.rank
            if self.folder is not None and self.ranks.first:
                save_checkpoint(self._checkpoint(pool), self.folder / WEIGHTS_FILE)

    def _save(self) -> None:
        if self.folder is not None and self.ranks.first:
            save_state(self.folder / STATE_FILE, self.progress, self.field, self.optimiser, self._identity())

    def _images_share(self) -> float:
        """Fraction of the budget that belongs to images.

        Once they are over, what they took of it. So after a resume with a larger budget the rays go on, and all that
        it has more is theirs.
        """
        config, progress = self.config, self.progress
        if not progress.past_images:
            return config.images.fraction
        return budget_fraction(progress.images_steps, progress.images_s, steps=config.steps, seconds=config.seconds)

    def _colours_until(self) -> float:
        """Fraction of the budget that belongs to images without depth."""
        return self.config.images.fraction * self.config.images.colours_first

    def _grow_depth(self) -> None:
        """From now on images bring their depth; the network that sees it begins where the one for colours is."""
        encoder = self.field.image_encoder
        if not self.progress.depth_grown and encoder is not None and encoder.depth_net and self._colours_until() > 0:
            grow_depth(encoder)
            _log.info("depth_network_grown", step=self.progress.step)
        self.progress.depth_grown = True

    def _keep_after_images(self, pool: RoomPool) -> None:
        """The weights as they are before the first ray: other kinds of fields may take over the encoder."""
        progress = self.progress
        progress.past_images, progress.images_steps = True, progress.step
        # The least of all ranks: so they agree on the rate, and no rank's clock is ever before it.
        progress.images_s = -self.ranks.largest(-progress.elapsed_s)[0]
        if self.folder is not None and self.ranks.first:
            save_checkpoint(self._checkpoint(pool, self.field.state_dict()), self.folder / IMAGES_FILE)

    def _checkpoint(self, pool: RoomPool, weights: dict[str, torch.Tensor] | None = None) -> Checkpoint:
        """These weights; else the ones kept so far, or the latest where nothing was validated yet."""
        config, progress = self.config, self.progress
        field = build_field(config.kind, config.field, ROOMS)
        field.load_state_dict(weights or progress.best or self.field.state_dict())
        validations = [line for line in progress.history if "miou" in line]
        best = next((line for line in validations if line["step"] == progress.best_step), {})
        recipe: dict[str, Any] = {
            "kind": "train",
            "width": config.pool.width,
            # Where weights to start from lay is nobody's business.
            "config": to_plain(config)
            | {"start": Path(config.start).name, "encoder_from": Path(config.encoder_from).name},
            "suite": f"rooms v{SUITE_VERSION}",
            "seed": config.seed,
            "steps": progress.step,
            "best_step": progress.best_step,
            "rooms": pool.rooms_rendered * self.ranks.world,
            "seconds": round(progress.elapsed_s, 1),
            "ranks": self.ranks.world,
            "validation_miou": best.get("miou"),
            "validation": best,
            "history": validations,
            "origins": progress.origins,
        }
        return Checkpoint(field.eval(), (), recipe | provenance(self.device))

    def _fraction(self, elapsed_s: float) -> float:
        return budget_fraction(self.progress.step, elapsed_s, steps=self.config.steps, seconds=self.config.seconds)

    def _line(self) -> dict[str, Any]:
        return {"step": self.progress.step, "seconds": round(self.progress.elapsed_s, 2)}

    def _identity(self) -> dict[str, Any]:
        """What has to be the same when a run goes on."""
        plain = {k: v for k, v in to_plain(self.config).items() if k not in _FREE}
        return plain | {"ranks": self.ranks.world, "suite": SUITE_VERSION}

    def _choose_precision(self) -> None:
        if bfloat16_is_fast(self.device):
            compute_in_bfloat16(self.field, self.config.bfloat16, self.device.type)
        elif self.config.bfloat16 and self.ranks.first:
            _log.info("float32_everywhere", reason="this processor has no matrix units for bfloat16 (AMX)")

    def _announce(self) -> None:
        if self.ranks.first:
            _log.info(
                "training_started",
                kind=self.config.kind,
                parameters=sum(p.numel() for p in self.field.parameters()),
                device=str(self.device),
                ranks=self.ranks.world,
                workers=self.config.workers,
                step=self.progress.step,
            )


def learning_rate(fraction: float, share: float, config: TrainConfig) -> float:
    """For steps on images, then for steps on rays: half a cosine each, after a short linear warm-up.

    Args:
        fraction: Of the budget that is used.
        share: Of the budget that belongs to images.
    """
    if fraction < share:
        fraction, first = fraction / share, config.images.learning_rate
    else:
        fraction, first = (fraction - share) / max(1 - share, 1e-9), config.learning_rate
    return cosine_rate(fraction, first, config.final_learning_rate) * min(1.0, fraction / WARM_UP + 0.1)
