"""Pictures unlike the rooms that weights learned are noticed; of weights that learned otherwise nothing is said."""

from dataclasses import replace

import numpy as np

from research.scenes import TRAIN_SEEDS, room_frames
from semantic_mapper.fields.checkpoint import Checkpoint, streaming
from semantic_mapper.fields.domain_check import find_domain_check
from semantic_mapper.geometry import scale_intrinsics
from semantic_mapper.mapper import Mapper
from semantic_mapper.replay.artifacts import finish_session
from semantic_mapper.replay.session import MapSession
from semantic_mapper.replay.summary import notes
from tests.small import INTRINSICS, tiny_config, tiny_field, tiny_frames


def test_meadows_are_unlike_rooms_and_it_is_said_live_and_in_the_summary(tmp_path):
    rooms = list(room_frames(TRAIN_SEEDS[7], 5, scale_intrinsics(INTRINSICS, 160, 120)))
    grass = np.random.default_rng(0).integers(0, 110, (70, 160, 1), np.uint8) * (0.6, 1.4, 0.3)
    meadow = np.concatenate((np.full((50, 160, 3), (110, 170, 250)), grass)).astype(np.uint8)
    for frames, unlike in ((rooms, 0), ([replace(f, rgb=meadow) for f in rooms], 5), (tiny_frames(5), None)):
        session = MapSession(Mapper.load(None, tiny_config(render={"encode_width": 160})), stream_labels=None)
        for frame in frames:
            session.process(frame)
        summary = finish_session(session, tmp_path)
        assert summary["pictures"]["unlike_training"] == (None if unlike is None else unlike / 5), "too small to judge"
        said = [note for note in notes(summary) if "unlike the rooms" in note]
        assert len(said) == bool(unlike) and all("5 of 5 pictures" in s and "finetune" in s for s in said)
        assert any("5 of 5" in warning for warning in session.warnings) == bool(unlike)
        check = session.pipeline.domain_check
        session.pipeline.exchange_field(streaming(session.mapper.model), ())
        assert check is not None and session.pipeline.domain_check is None, "weights fitted to this place know it"


def test_weights_that_learned_something_else_have_no_check():
    mapper = Mapper.load()
    shipped, field = mapper.weights, mapper.pipeline.field
    assert find_domain_check(shipped, field) is not None
    assert find_domain_check(replace(shipped, recipe={"kind": "finetune"}), field) is None
    tiny = tiny_field()
    other = Checkpoint(tiny, recipe=shipped.recipe).weights
    assert find_domain_check(other, streaming(tiny)) is None, "it has another backbone"
