"""Another field in the place of a pipeline's: compared with the map, then exchanged; what was mapped stays."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from semantic_mapper.errors import WeightsError
from semantic_mapper.fields.streaming import StreamingSRay
from semantic_mapper.labels import NYU40, ROOMS
from semantic_mapper.mapping import pipeline as pipeline_module
from semantic_mapper.mapping.pipeline import FieldTrial, MappingPipeline
from tests.small import tiny_config, tiny_field, tiny_frames

FRAMES = tiny_frames(6)


def mapped(count: int = 4) -> MappingPipeline:
    pipeline = MappingPipeline(tiny_config(keyframes={"translation_m": 0.01}), StreamingSRay(tiny_field()), ROOMS)
    for frame in FRAMES[:count]:
        pipeline.step(dataclasses.replace(frame, label=None))
    return pipeline


def test_an_exchanged_field_goes_on_with_map_and_keyframes_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline_module, "SURE", 0.0)  # a field that knows nothing is sure of nothing
    pipeline = mapped()
    before, keyframes = pipeline.voxel_map.block_state(), pipeline.keyframes.keyframes
    assert len(keyframes) == 4
    anchors = [FRAMES[4], FRAMES[5]]
    same = FieldTrial(pipeline, StreamingSRay(tiny_field()), (), [FRAMES[0], FRAMES[1]])
    assert [same.advance() for _ in range(2)] == [False, True]
    trial = FieldTrial(pipeline, StreamingSRay(tiny_field()), anchors, [FRAMES[0], FRAMES[1]])
    assert [trial.advance() for _ in range(4)] == [False, False, False, True]
    # What the map says comes from the same random weights; those that know labels of two views say otherwise.
    assert same.agreement is not None and trial.agreement is not None and same.agreement > 2 * trial.agreement
    assert pipeline.keyframes.keyframes == keyframes  # a trial changes nothing
    trial.exchange()
    kept = pipeline.keyframes.keyframes
    assert [k.labelled for k in kept] == [True, True, False, False, False, False]
    assert kept[2:] == keyframes and (kept[0].encoded.channel >= 0).any()
    after = pipeline.voxel_map.block_state()
    assert all(np.array_equal(after[name], before[name]) for name in before)
    update = pipeline.step(dataclasses.replace(FRAMES[4], label=None))
    assert update.fused and {4, 5} & set(update.source_seqs)
    trial = FieldTrial(pipeline, StreamingSRay(tiny_field()), anchors[:1], [])
    assert trial.advance() and trial.agreement is None
    trial.exchange()  # labelled keyframes of the weights before go with them
    assert [k.seq for k in pipeline.keyframes.keyframes if k.labelled] == [FRAMES[4].seq]


def test_what_does_not_fit_the_pipeline_is_refused() -> None:
    pipeline = mapped(1)
    with pytest.raises(WeightsError, match="label set 'nyu40'"):
        FieldTrial(pipeline, StreamingSRay(tiny_field(NYU40)), (), ())
    with pytest.raises(WeightsError, match="65 keyframes come with these weights, but only 64 are kept"):
        FieldTrial(pipeline, StreamingSRay(tiny_field()), [FRAMES[0]] * 65, ())
