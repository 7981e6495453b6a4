"""Whether more or less of a metric is better, for every metric that an operation of a fleet writes."""

from __future__ import annotations

from enum import StrEnum

from semantic_mapper.errors import FleetError

CLASS_PREFIX = "iou:"
METHOD_PREFIX = "miou "  # of the mIoU of one method of ``eval``, such as "miou own image alone"


class Direction(StrEnum):
    """What is better."""

    HIGHER = "higher is better"
    LOWER = "lower is better"
    NEITHER = "neither"  # such as the size of a map


DIRECTIONS = {
    name: direction
    for direction, names in {
        Direction.HIGHER: (
            # replay and eval
            *("miou", "map_miou", "total_accuracy", "average_accuracy", "coverage", "frames_fused", "frames_scored"),
            *("labelled", "depth_written", "mean_confidence", "labelled_pixels"),  # autolabel
            *("held_out_accuracy", "psnr"),  # finetune
        ),
        Direction.LOWER: (
            *("unknown", "depth_disagreement", "frames_dropped", "frames_refused", "frames_labels_refused"),  # replay
            *("frames_without_depth", "frames_left_out", "frames_excluded_from_scores"),
            *("ece", "frames_excluded", "frames_damaged"),  # eval; it also writes frames_refused
            *("unlabelled",),  # autolabel
            *("held_out_loss",),  # finetune
        ),
        Direction.NEITHER: (
            *("frames_published", "frames_pseudo_labels", "surface_points", "blocks", "cleared_voxels"),  # replay
            *("frames_pseudo_labelled",),  # eval
            *("frames", "kept", "replaced"),  # autolabel
            *("steps", "best_step"),  # finetune
            *("surface", "relabelled", "filled", "things"),  # refine
        ),
    }.items()
    for name in names
}


def direction_of(metric: str) -> Direction:
    """Whether more or less of a metric is better.

    Args:
        metric: Of a result, "miou METHOD", or "iou:CLASS".

    Raises:
        FleetError: it is not known; names the metrics for which it is.
    """
    if metric.startswith((CLASS_PREFIX, METHOD_PREFIX)):
        return Direction.HIGHER
    if metric not in DIRECTIONS:
        raise FleetError(
            f"{metric}: it is not known whether more or less of this metric is better; say --higher-is-better or "
            f"--lower-is-better. It is known of {', '.join(_judged())}, {METHOD_PREFIX}METHOD and {CLASS_PREFIX}CLASS"
        )
    return DIRECTIONS[metric]


def is_lower_better(metric: str) -> bool:
    """Whether less of a metric is better, for a comparison that has to tell worse from better.

    Raises:
        FleetError: it is not known, or neither is better.
    """
    direction = direction_of(metric)
    if direction is Direction.NEITHER:
        raise FleetError(
            f"{metric}: neither more nor less of it is better in general; say --higher-is-better or --lower-is-better, "
            f"or compare one of {', '.join(_judged())}"
        )
    return direction is Direction.LOWER


def _judged() -> list[str]:
    return sorted(name for name, direction in DIRECTIONS.items() if direction is not Direction.NEITHER)
