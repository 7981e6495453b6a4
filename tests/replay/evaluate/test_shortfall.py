from typing import Any

from semantic_mapper.replay.evaluate.shortfall import OWN_IMAGE, UNET, explain_shortfall

OWN_VIEW = {"factor": 4.0}


def figures(miou: float, accuracy: float, sky: float, *, coverage: float = 1.0) -> dict[str, Any]:
    per_class = {"road": 0.5, "sky": sky, "car": None}
    return {"miou": miou, "total_accuracy": accuracy, "coverage": coverage, "per_class": per_class}


def test_a_field_that_leads_needs_no_explanation():
    methods = {"sray": figures(0.6, 0.9, 0.8), OWN_IMAGE: figures(0.5, 0.9, 0.8), UNET: figures(0.4, 0.8, 0.9)}
    assert explain_shortfall("sray", methods, {}) == ()
    assert explain_shortfall("sray", {"sray": methods["sray"]}, {}) == ()


def test_views_that_outvote_the_own_image_are_named_with_figures_and_the_worst_class():
    methods = {"sray": figures(0.4, 0.8, 0.55), OWN_IMAGE: figures(0.45, 0.7, 0.92), UNET: figures(0.3, 0.6, 0.9)}
    (line,) = explain_shortfall("sray", methods, {"own_view": OWN_VIEW, "steps": 60})
    assert "below own image alone (mIoU 40.0 against 45.0 %); most at sky (-37.0)" in line
    assert "total accuracy" not in line and "outvote" in line and "counts 4 times" in line
    (line,) = explain_shortfall("sray", methods, {"own_view": OWN_VIEW | {"factor_without_depth": 16.0}})
    assert "counts 4 times (16 times where there is no depth)" in line
    (line,) = explain_shortfall("sray", methods, {"own_view": {}})
    assert "counts as one among them" in line


def test_an_encoder_that_is_behind_the_u_net_is_the_reason_where_it_is():
    methods = {"sray": figures(0.4, 0.8, 0.55), OWN_IMAGE: figures(0.35, 0.7, 0.5), UNET: figures(0.45, 0.7, 0.6)}
    (line,) = explain_shortfall("sray", methods, {"steps": 60})
    assert "below per-image U-Net" in line and "behind in mIoU on the image alone in 60 steps" in line


def test_pixels_without_an_answer_are_the_reason_where_they_make_up_the_difference():
    methods = {"sray": figures(0.4, 0.8, 0.55, coverage=0.8), OWN_IMAGE: figures(0.45, 0.9, 0.6)}
    (line,) = explain_shortfall("sray", methods, {"own_view": OWN_VIEW})
    assert "20.0 % of the pixels unknown" in line
