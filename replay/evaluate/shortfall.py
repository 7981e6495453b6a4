"""Why a field scores below what a single image gives: its own encoder's answer, or a per-image U-Net."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

OWN_IMAGE, UNET = "own image alone", "per-image U-Net"
FIGURES = {"miou": "mIoU", "total_accuracy": "total accuracy"}
NAMED_CLASSES = 3


def explain_shortfall(
    field: str, methods: Mapping[str, Mapping[str, Any]], recipe: Mapping[str, Any]
) -> tuple[str, ...]:
    """A sentence or two for each of the two that beats the field in mIoU or total accuracy; empty where none does.

    Args:
        field: Name of the field among ``methods``.
        methods: Metrics by name, as in ``Evaluation``.
        recipe: Of the field's weights: what a finetuning found out about the own image.
    """
    return tuple(
        f"{field} is below {name} ({_figures(methods[field], methods[name])}); "
        f"most at {_classes(field, name, methods)}. {_reason(field, name, methods, recipe)}"
        for name in (OWN_IMAGE, UNET)
        if name in methods and any(_lead(methods[name], methods[field], key) > 0 for key in FIGURES)
    )


def _reason(field: str, name: str, methods: Mapping[str, Mapping[str, Any]], recipe: Mapping[str, Any]) -> str:
    """Either the other views cost what the own image knew, or the encoder itself knows less."""
    if name == UNET and OWN_IMAGE in methods:
        behind = [text for key, text in FIGURES.items() if _lead(methods[UNET], methods[OWN_IMAGE], key) > 0]
        if behind:
            steps = f" in {recipe['steps']} steps" if "steps" in recipe else ""
            return (
                f"Its encoder is behind in {' and '.join(behind)} on the image alone{steps}: finetune for more "
                "seconds, or label more keyframes."
            )
    missing = 1 - float(methods[field].get("coverage") or 0)
    if missing > max(_lead(methods[name], methods[field], "total_accuracy"), 0.01):
        return f"It leaves {missing * 100:.1f} % of the pixels unknown, which count as wrong: no source view sees them."
    own = recipe.get("own_view") or {}
    if not own:
        return "The other views outvote the query's image, which counts as one among them."
    return f"The other views outvote the query's image, which counts {own['factor']:g} times{_without_depth(own)}."


def _without_depth(own: Mapping[str, Any]) -> str:
    """Weights finetuned by earlier versions have one factor for all rays."""
    factor = own.get("factor_without_depth", own["factor"])
    return "" if factor == own["factor"] else f" ({factor:g} times where there is no depth)"


def _figures(of_field: Mapping[str, Any], other: Mapping[str, Any]) -> str:
    return ", ".join(
        f"{text} {of_field[key] * 100:.1f} against {other[key] * 100:.1f} %"
        for key, text in FIGURES.items()
        if _lead(other, of_field, key) > 0
    )


def _classes(field: str, name: str, methods: Mapping[str, Mapping[str, Any]]) -> str:
    """The classes that lose the most IoU."""
    ours, theirs = methods[field]["per_class"], methods[name]["per_class"]
    loss = {c: iou - (ours[c] or 0.0) for c, iou in theirs.items() if iou is not None and c in ours}
    worst = sorted((c for c in loss if loss[c] > 0), key=lambda c: -loss[c])[:NAMED_CLASSES]
    return ", ".join(f"{c} (-{loss[c] * 100:.1f})" for c in worst) or "no class in particular"


def _lead(first: Mapping[str, Any], second: Mapping[str, Any], key: str) -> float:
    """By how much the first is better; 0 where either has no figure."""
    a, b = first.get(key), second.get(key)
    return 0.0 if a is None or b is None else float(a) - float(b)
