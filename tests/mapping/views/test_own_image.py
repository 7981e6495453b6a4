"""What the own image adds to a rendered view."""

from __future__ import annotations

import numpy as np
import torch

from semantic_mapper.fields.streaming import StreamingSRay
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.mapping.rendering import RenderedView, add_own_image
from tests.small import tiny_config, tiny_field, tiny_frames


class Says:
    """A field with a given opinion (1, L, h, w) of images."""

    def __init__(self, logits: torch.Tensor | None) -> None:
        self.logits = logits

    def source_logits(self, sources):
        return self.logits


def rendered(probabilities: np.ndarray, known: np.ndarray) -> RenderedView:
    return RenderedView(probabilities.astype(np.float32), known, np.ones(known.shape, np.float32), 1, 1)


def test_both_opinions_are_joined_as_their_geometric_mean_where_the_view_is_known(rng: np.random.Generator) -> None:
    view_p, own_p = rng.dirichlet(np.ones(4), (3, 5)), rng.dirichlet(np.ones(4), (3, 5))
    known = rng.random((3, 5)) < 0.7
    field = Says(torch.from_numpy(np.log(own_p)).permute(2, 0, 1)[None])
    found = add_own_image(rendered(view_p, known), field, None, 0.3)  # type: ignore[arg-type]
    expected = np.maximum(own_p, 1e-4) ** 0.3 * np.maximum(view_p, 1e-4) ** 0.7
    expected /= expected.sum(axis=2, keepdims=True)
    np.testing.assert_allclose(found.probabilities[known], expected[known], atol=1e-5)
    np.testing.assert_array_equal(found.probabilities[~known], view_p.astype(np.float32)[~known])
    assert found.probabilities.dtype == np.float32


def test_the_map_takes_it_in_unless_the_frame_is_no_source_or_its_weight_is_nothing() -> None:
    frames = tiny_frames(2)

    def map_of(**keyframes: object):
        pipeline = MappingPipeline(tiny_config(keyframes=keyframes), StreamingSRay(tiny_field()), ROOMS)
        confidence = np.stack([pipeline.step(frame).confidence for frame in frames])
        return pipeline.voxel_map.block_state()["evidence"], confidence

    (with_own, said), (without, said_without) = map_of(), map_of(own_image_weight=0.0)
    assert np.abs(with_own - without).max() > 0.01
    assert np.median(np.abs(said - said_without)) < 1e-6  # frames are labelled by the rendered view alone
    novel = [map_of(use_current_view=False, own_image_weight=weight)[0] for weight in (0.0, 0.5)]
    np.testing.assert_array_equal(*novel)
