"""Settings of every fit: finetuning, fields of one scene, and rounds of learning next to a mapper."""

from typing import Annotated

import msgspec

from semantic_mapper.config import (
    AtLeastOne,
    AtLeastTwo,
    AtLeastZero,
    Config,
    DeviceName,
    Fraction,
    IRTVariant,
    Metres,
    NotNegative,
    Positive,
    SamplingConfig,
)


class StepConfig(Config, frozen=True):
    """How a step on rays draws them."""

    rays: AtLeastOne = 1024
    known_labels: bool = True  # source views other than the query bring their labels, as keyframes of a map do
    samples_without_depth: AtLeastTwo = 32  # of a ray, in steps without a depth prior
    sampling: SamplingConfig = SamplingConfig()


class GridFitConfig(Config, frozen=True):
    """How a scene grid is fitted, of kinds that stand on one."""

    steps: AtLeastOne = 1200  # where the fit has no ``steps`` of its own
    rays: AtLeastOne = 2048  # a step
    # Vertices along the box's longest side; None = 96, and where no frame has depth as many as make 2.5 M in all
    long_side: Annotated[int, msgspec.Meta(ge=8, le=2048)] | None = None
    voxel_m: Positive | None = None  # sets their distance instead
    # Lower corner, then upper corner of the box in metres of the world; None = what depth reaches; without depth, what
    # matched features show; where these are too few, what the cameras can see up to ``far_m``
    box_m: tuple[float, float, float, float, float, float] | None = None
    near_m: AtLeastZero = 0.1
    far_m: Metres = 8.0
    # Weight of what stops light: clears haze of the sky's colour. None = 0.01 where frames have depth, else 0: without
    # depth the sky's colours explain surface
    opacity: AtLeastZero | None = None
    exposure: bool = True  # a gain a frame and channel, for cameras whose exposure drifts
    held_out: NotNegative = 8  # every n-th frame is held out, for the PSNR; 0 = none


class IRTFitConfig(Config, frozen=True):
    """What an Implicit Ray-Transformer is made of."""

    variant: IRTVariant | None = None  # None = that of the weights to start from, else BC
    # To where the labelled frames' surface is seen again; False: labels only teach, as in the paper
    carry_labels: bool = True


class PanopticFitConfig(Config, frozen=True):
    """Weights of what a Panoptic NeRF learns classes from; 0 leaves a loss out."""

    fixed: AtLeastZero = 1.0  # pseudo labels against what boxes say (Eq. 5): moves density
    learned: AtLeastZero = 1.0  # pseudo labels against what is learned (Eq. 6)
    points: AtLeastZero = 1.0  # what is learned at points against what boxes say there (Eq. 6)


class FinetuneConfig(Config, frozen=True):
    """Budget of a fit, and what it learns."""

    # wall-clock budget; 0 = only steps count, and a run repeats bit for bit
    seconds: AtLeastZero = 300.0
    steps: NotNegative = 0  # step budget; 0 = only seconds count
    width: AtLeastOne = 320  # working width of the images
    learning_rate: AtLeastZero = 1e-3
    encoder_rate: Fraction = 1.0  # of the image encoder, as a fraction of it; 0 = only what reads its features learns
    # Of each keyframe's pixels, in blocks, never trained on: their loss says which weights are kept
    held_out_fraction: Annotated[float, msgspec.Meta(ge=0, lt=1)] = 0.1
    held_out_rays: AtLeastOne = 512  # a keyframe, but no more than 6,144 in all
    evaluations: AtLeastOne = 10  # of held-out rays over the whole budget
    # Evaluations without a better loss before it stops early; 0 = the whole budget, come what may. Those during steps
    # on images do not count: what these teach does not show in rays until the rate has fallen.
    patience: NotNegative = 4
    # Of the budget, at its start, in which the image encoder is frozen, so that steps cost less
    frozen_encoder_fraction: Fraction = 0.0
    # Of the budget behind that: steps on single images, where a kind classifies these; the rest is on rays
    image_fraction: Fraction = 0.75
    seed: NotNegative = 0  # of everything that is drawn at random
    device: DeviceName = "auto"
    step: StepConfig = StepConfig()
    grid: GridFitConfig = GridFitConfig()
    irt: IRTFitConfig = IRTFitConfig()
    panoptic: PanopticFitConfig = PanopticFitConfig()


class RoundConfig(FinetuneConfig, frozen=True):
    """As ``FinetuneConfig``, with other defaults: short rounds on a fraction of a core."""

    seconds: AtLeastZero = 0.0  # steps count: how long they take is for the owner of the budget to say
    steps: NotNegative = 60
    frozen_encoder_fraction: Fraction = 1.0  # cannot be less
    held_out_rays: AtLeastOne = 128
    evaluations: AtLeastOne = 3
    patience: NotNegative = 0
    device: DeviceName = "cpu"  # "cuda" where a GPU has time to spare next to the mapper
    step: StepConfig = StepConfig(rays=512)

    def __post_init__(self) -> None:
        if self.frozen_encoder_fraction < 1:
            raise ValueError("frozen_encoder_fraction must be 1: the mapper's keyframes are not encoded again")


class OnlineConfig(Config, frozen=True):
    """How a learner learns, and when it finds new weights better."""

    least_gain: Fraction = 0.01  # mIoU that new weights must gain on the held-out keyframes
    least_score: Fraction = 0.2  # mIoU that they must reach there: labels without any sense are learned worse
    # Accuracy that they may lose on those held-out keyframes with which the weights in use were found better.
    tolerance: Fraction = 0.02
    finetune: RoundConfig = RoundConfig()
