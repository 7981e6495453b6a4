"""Answers to all questions about the golden map, over a real socket."""

from pathlib import Path
from typing import Any

import numpy as np

from tests.contract import entry_points as api
from tests.contract.golden import MAP, differences, plain, read

PLACES = np.stack(np.meshgrid(np.linspace(0.9, 3.2, 5), np.linspace(0.0, 1.8, 5), (0.3, 1.2, 2.4)), -1).reshape(-1, 3)
LOWER, UPPER = (1.0, 0.0, 0.2), (3.0, 1.8, 1.4)
DIGITS = 5  # of numbers; rounding on other processors moves later ones
NAMED_ANEW = ("map_id", "version")  # of each process


def observe(folder: Path) -> dict[str, Any]:
    """By question."""
    with api.serving(MAP, f"ipc://{folder}/query") as client:
        answers = {
            "info": client.info(),
            "at": client.at(PLACES),
            "nearest": [client.nearest(name, (1.5, 0.5, 1.0)) for name in ("wall", "chair", "sofa", "table")],
            "cast_rays": client.cast_rays(np.tile((2.0, 1.0, 1.2), (len(PLACES), 1)), PLACES - (2.0, 1.0, 1.2)),
            "points_in_box": client.points_in_box(LOWER, UPPER),
            "instances": client.instances(),
            "graph": client.graph((0.0, 0.0, 1.0)),
            "occupancy": client.occupancy(PLACES),
            "distance_field": client.distance_field(LOWER, UPPER),
        }
    return {kind: plain(_rounded(answer)) for kind, answer in answers.items()}


def _rounded(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return np.round(value, DIGITS) + 0 if value.dtype.kind == "f" else value
    if isinstance(value, float):
        return round(value, DIGITS)
    if isinstance(value, list | tuple):
        return [_rounded(item) for item in value]
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items() if key not in NAMED_ANEW}
    names = getattr(value, "__struct_fields__", None) or getattr(value, "__dataclass_fields__", None)
    if names:
        return {name: _rounded(getattr(value, name)) for name in names if name not in NAMED_ANEW}
    return value


def test_every_question_is_answered_as_then() -> None:
    with api.short_folder() as folder:
        assert differences(read("answers"), observe(folder)) == []
