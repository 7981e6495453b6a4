"""What is refused before the first room is rendered."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from research.tests.train.small_run import small_run
from research.train.train import train
from research.train.train_checks import check_field
from semantic_mapper.errors import ConfigError, WeightsError
from semantic_mapper.fields.checkpoint import Checkpoint, save_checkpoint
from semantic_mapper.fields.learned import build_field
from semantic_mapper.fields.sray import SRay
from semantic_mapper.fields.views import EncodedViews
from semantic_mapper.labels import ROOMS
from semantic_mapper.types import SourceViews
from tests.small import SMALL_MODEL, tiny_field

RAYS_ALONE = {"fraction": 0.0}


@pytest.fixture(autouse=True)
def no_rooms(monkeypatch: pytest.MonkeyPatch) -> None:
    """A test in which a room is rendered fails."""

    def rendered(*_: Any) -> None:
        pytest.fail("a room was about to be rendered")

    monkeypatch.setattr("research.train.train.validation_rooms", rendered)


@pytest.fixture
def encoder(tmp_path: Path) -> str:
    """Weights of a per-image field."""
    path = tmp_path / "unet.safetensors"
    shape = {"encoder": {"channels": [8, 16], "blocks": [1, 1], "depth": True}}
    save_checkpoint(Checkpoint(build_field("unet", shape, ROOMS)), path)
    return str(path)


def test_a_state_to_go_on_with_has_to_be_there(tmp_path: Path):
    with pytest.raises(WeightsError, match="no such training state; train without --resume first"):
        train(small_run(), tmp_path, resume=True)
    with pytest.raises(ConfigError, match="its folder is needed"):
        train(small_run(), resume=True)


def test_weights_to_start_from_have_to_be_of_the_same_field(encoder: str):
    with pytest.raises(ConfigError, match="weights of another field"):
        train(small_run(start=encoder))


def test_an_encoder_to_take_over_has_to_be_there_and_of_the_same_shape(encoder: str, tmp_path: Path):
    with pytest.raises(WeightsError, match="no such weights file"):
        train(small_run(encoder_from=str(tmp_path / "none.safetensors")))
    other = {"encoder": {"channels": [8, 24], "blocks": [1, 1]}}
    with pytest.raises(ConfigError, match="another shape"):
        train(small_run(encoder_from=encoder, field=other, images=RAYS_ALONE))


class AveragingField(SRay):
    """Encodes every view in the light of the others, as no kind of the package does."""

    def encode(self, views: SourceViews) -> EncodedViews:
        encoded = super().encode(views)
        return dataclasses.replace(encoded, feature=encoded.feature + encoded.feature.mean(0))


def test_rooms_of_a_step_share_one_call_only_where_a_kind_encodes_each_view_by_itself(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("research.train.train.build_field", lambda *_: AveragingField(SMALL_MODEL, ROOMS))
    with pytest.raises(ConfigError, match="in the light of each other"):
        train(small_run(images=RAYS_ALONE, encode_together=True))
    check_field(tiny_field(), small_run(encode_together=True))
