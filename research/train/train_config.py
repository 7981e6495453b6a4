"""Settings of a training run. ``research/docs/training.md`` says what they do."""

from __future__ import annotations

from typing import Any, Literal

import msgspec

from research.train.images import ImageStepConfig
from research.train.rooms import RoomPoolConfig
from research.train.step import LossConfig, StepConfig
from research.train.validation import ValidationConfig
from semantic_mapper.config import AtLeastOne, Config, DeviceName, Fraction


class TrainStepConfig(StepConfig, frozen=True):
    """A step of training to generalize: many densities of views, no known labels, often no depth at all."""

    views_max: AtLeastOne = 12
    own_view_fraction: Fraction = 0.5  # as when a robot maps: its current frame is a source view
    own_view_degraded: Fraction = 0.5
    wide_fraction: Fraction = 0.3
    natural_prior: bool = True
    known_labels: bool = False
    no_depth: Fraction = 0.25
    no_depth_thinning: AtLeastOne = 4  # 32 samples a ray instead of 8
    mirrored: Fraction = 0.5
    loss: LossConfig = LossConfig(balance=0.25, source_depth=0.02)


class TrainConfig(Config, frozen=True):
    """A training run."""

    kind: str = "sray"  # of field, as in ``fields.learned``
    field: dict[str, Any] = msgspec.field(
        default_factory=dict
    )  # settings of that kind; what is left out keeps its default
    start: str = ""  # weights file to start from, of this shape, maybe of fewer classes; empty = random weights
    encoder_from: str = ""  # weights file of any kind whose image encoder is taken over; empty = random weights
    imagenet: bool = False  # an encoder with backbone = "efficientnet-lite0" starts from ImageNet weights there
    seconds: float = 1500.0  # wall-clock budget; 0 = only steps count (then a run repeats bit for bit on a CPU)
    steps: int = 0  # step budget; 0 = only seconds count
    rooms_per_step: int = 1  # a rank
    encode_together: bool = False  # one call of the encoder a step; for kinds that encode each view by itself
    bfloat16: tuple[str, ...] = ()  # parts of the field ("encoder", ...) that compute in it where it is fast
    learning_rate: float = 1e-3  # of steps on rays; ``images`` has its own
    encoder_rate: float = 0.1  # of the image encoder, as a share of it
    # Of a backbone that ImageNet weights started, as a fraction of the encoder's; 0 = frozen: what learns from rooms
    # forgets photographs.
    backbone_rate: float = 0.0
    final_learning_rate: float = 5e-5
    weight_decay: float = 0.02
    gradient_clip: float = 10.0
    keep: Literal["best", "last"] = "best"  # of the validated weights; few rooms choose the best by chance
    seed: int = 0
    device: DeviceName = "auto"
    workers: int = 0  # processes that render rooms ahead, a rank; 0 = inline, right where the CPU trains
    save_every_s: float = 120.0
    log_steps: int = 20  # steps a line of the history
    pool: RoomPoolConfig = RoomPoolConfig()
    images: ImageStepConfig = ImageStepConfig()
    step: TrainStepConfig = TrainStepConfig()
    validation: ValidationConfig = ValidationConfig()
