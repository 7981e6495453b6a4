"""mIoU against seconds of fitting, as a picture."""

from typing import Any

import numpy as np
import pytest

from research.plots import Panel
from research.suites import figures as module
from research.suites.figures import draw_fit_curves


def figures(curve: list[tuple[float, float | None]], carried: float | None) -> dict[str, Any]:
    return {"curve": [{"seconds": s, "miou": m} for s, m in curve], "carried_miou": carried}


def curves(monkeypatch: pytest.MonkeyPatch, found: dict[str, Any]) -> dict[str, list[tuple[float, float]]]:
    """What is drawn, by name."""
    panels: list[Panel] = []
    monkeypatch.setattr(module, "draw_panels", lambda title, drawn, **_: panels.extend(drawn) or np.zeros((1, 1, 3)))
    assert draw_fit_curves(found, "fit") is not None
    return {curve.name: list(curve.points) for curve in panels[0].curves}


def test_fields_are_drawn_in_percent_where_they_were_scored(monkeypatch: pytest.MonkeyPatch) -> None:
    good, bad = [(0.0, 0.5), (30.0, 0.8)], [(0.0, None), (10.0, 0.1), (30.0, 0.3)]
    drawn = curves(monkeypatch, {"good": figures(good, None), "bad": figures(bad, None)})
    assert drawn == {"good": [(0, 50), (30, 80)], "bad": [(10, 10), (30, 30)]}


def test_carried_labels_are_a_level_line(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = curves(monkeypatch, {"field": figures([(0.0, 0.2), (30.0, 0.3)], 0.9)})
    assert drawn["labels carried by depth"] == [(0, 90), (30, 90)]


def test_nothing_is_drawn_where_nothing_was_fitted() -> None:
    assert draw_fit_curves({"field": figures([], None)}, "generalize") is None
    picture = draw_fit_curves({"field": figures([(0.0, 0.2), (30.0, 0.3)], 0.9)}, "fit")
    assert picture is not None and picture.shape[1] == 1000
