"""The claims of IRT as checks on AERIAL, and the figures of an arm that they are about."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from research.evaluation.bootstrap import miou_of_counts
from research.suites.aerial import AGREEMENT, DARK, DAY, FIT, LOW
from research.suites.aerial_arms import BRIDGE, ROOF
from research.suites.claims import Claim, Measure, miou_measure
from semantic_mapper.types import Float64


def _accuracy(counts: Sequence[Float64]) -> Float64:
    """Mean over the classes in the truth of the fraction that is right, in points."""
    hits, occurring = np.diagonal(counts[0], axis1=1, axis2=2), counts[0].sum(axis=2)
    right = np.divide(hits, occurring, out=np.zeros_like(hits), where=occurring > 0)
    return 100 * right.sum(axis=1) / (occurring > 0).sum(axis=1)


def _fraction(counts: Sequence[Float64]) -> Float64:
    return 100 * counts[0][:, 0, 0] / np.maximum(counts[0][:, 0, 1], 1)


def _drop(counts: Sequence[Float64]) -> Float64:
    return 100 * (1 - miou_of_counts(counts[1]) / miou_of_counts(counts[0]))


MIOU = miou_measure("mIoU", DAY)
IN_THE_DARK = miou_measure("mIoU in the dark", DARK)
FROM_LOW = miou_measure("mIoU from low", LOW)
CONSISTENCY = Measure("consistency", (AGREEMENT,), _fraction)
DARK_DROP = Measure("relative drop in the dark", (DAY, DARK), _drop)
LOW_DROP = Measure("relative drop from low", (DAY, LOW), _drop)
BRIDGE_PAIR = Measure("accuracy, bridge or road", (BRIDGE,), _accuracy)
ROOF_PAIR = Measure("accuracy, roof or road", (ROOF,), _accuracy)
FIT_SECONDS = Measure("CPU seconds of a fit", (FIT,), lambda counts: counts[0][:, 0, 0] / counts[0][:, 0, 1] / 1000)
MEASURES = (MIOU, IN_THE_DARK, FROM_LOW, CONSISTENCY, DARK_DROP, LOW_DROP, BRIDGE_PAIR, ROOF_PAIR, FIT_SECONDS)

CLAIMS = (
    Claim("gate: the colour of a pixel says little", "", MIOU, "color", most=15.0),
    Claim("gate: patches do not tell bridges from roads", "", BRIDGE_PAIR, "patch", most=55.0),
    Claim("gate: patches do not tell roofs from roads", "", ROOF_PAIR, "patch", most=55.0),
    Claim("above U-Net", "58.7 / 43.1", MIOU, "irt-rttc", "unet", least=10.0),
    Claim("above labels carried by the grid's depth", "", MIOU, "irt-rttc", "warp", least=0.0),
    Claim("above Semantic-NeRF", "51.1 / 46.8", MIOU, "irt-rttc", "semantic-nerf", least=2.0),
    Claim("RTTC above B", "58.7 / 53.4", MIOU, "irt-rttc", "irt-b", least=3.0),
    Claim("RTT above RT", "57.5 / 53.9", MIOU, "irt-rtt", "irt-rt", least=0.0),
    Claim("RTC above RT", "56.8 / 53.9", MIOU, "irt-rtc", "irt-rt", least=0.0),
    Claim("above Color-NeRF", "58.7 / 56.8", MIOU, "irt-rttc", "irt-colour", least=0.0),
    Claim("20 points are no better than 10", "51.2 / 51.1", MIOU, "irt-20-points", "irt-rttc", least=-1.0, most=1.0),
    Claim("the default of finetune above carried labels", "", MIOU, "irt-bc", "warp", least=0.0),
    Claim("RTTC above BC", "", MIOU, "irt-rttc", "irt-plain-bc", least=0.0),
    Claim("RTTC above BC, labels carried", "", MIOU, "irt-carry", "irt-bc", least=0.0),
    Claim("stage 1 brings", "a figure only", MIOU, "irt-rttc", "irt-no-stage-1", least=10.0),
    Claim("dark: half of the U-Net's drop", "18 / 81", DARK_DROP, "irt-rttc", "unet", most=0.0, factor=0.5),
    Claim(
        "dark: half of the drop of a U-Net trained in the dark",
        "",
        DARK_DROP,
        "irt-rttc",
        "unet-dimmed",
        most=0.0,
        factor=0.5,
    ),
    Claim("from low: half of the U-Net's drop", "a figure only", LOW_DROP, "irt-rttc", "unet", most=0.0, factor=0.5),
    Claim("more consistent than the U-Net", "", CONSISTENCY, "irt-rttc", "unet", least=3.0),
)
