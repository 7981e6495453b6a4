"""What the weights in the package can do, at the least: a change of the code that they do not fit must not pass."""

from __future__ import annotations

import re

import pytest
import torch

from research.train.cameras import CameraDraw
from research.train.ranks import Ranks
from research.train.rooms import RoomPoolConfig
from research.train.ship_weights import BEGIN, CARD, END, chain, check_chain, metadata_block
from research.train.train_config import TrainStepConfig
from research.train.validation import Scores, ValidationConfig, validate, validation_rooms
from semantic_mapper.fields.checkpoint import Checkpoint, load_checkpoint
from semantic_mapper.fields.learned import LearnedField, build_field
from semantic_mapper.fields.weights import default_checkpoint_path
from semantic_mapper.labels import ROOMS

ALONE = Ranks()


@pytest.fixture(scope="module")
def shipped() -> Checkpoint:
    return load_checkpoint(default_checkpoint_path())


def scores(field: LearnedField, width: int) -> Scores:
    config = ValidationConfig(rooms=3, queries=2, rays=800, views=6)
    pool = RoomPoolConfig(width=width, views=10, people=0.0, camera=CameraDraw(usual=1.0))
    rooms = validation_rooms(config, pool, ALONE, torch.device("cpu"))
    return validate(field.eval(), rooms, config, TrainStepConfig(), ALONE)


def test_they_are_no_fresh_network_to_a_finetuning(shipped: Checkpoint):
    assert shipped.model.image_encoder is not None and not shipped.model.image_encoder.uncalibrated


@pytest.mark.slow
def test_they_know_rooms_that_they_have_never_seen_with_depth_and_without(shipped: Checkpoint):
    able = scores(shipped.model, shipped.width)
    assert able.miou > 0.5 and able.accuracy > 0.75
    assert able.blind_miou > 0.3 and able.blind_accuracy > 0.6
    torch.manual_seed(0)
    random = scores(build_field("sray", {}, ROOMS), shipped.width)
    assert random.miou < 0.1 and random.accuracy < 0.3


def test_they_say_how_they_were_made_and_what_was_measured(shipped: Checkpoint):
    recipe = shipped.recipe
    assert re.fullmatch(r"[0-9a-f]{40}", recipe["git_revision"]), "a commit that holds all of the code"
    trained = [run for run in chain(recipe) if "steps" in run]
    assert len(trained) > 5 and all(isinstance(run["config"]["seed"], int) for run in trained)
    figures = {figure["depth"]: figure for figure in recipe["figures"]}
    assert all(figure["split"] == "test" and figure["rooms"] == 20 for figure in figures.values())
    assert figures["on"]["data_set"]["miou"] > 0.6
    check_chain(default_checkpoint_path(), recipe)


def test_the_model_card_says_what_the_file_says():
    found = CARD.read_text(encoding="utf-8").partition(f"{BEGIN}\n")[2].partition(END)[0]
    assert found == metadata_block(default_checkpoint_path()), "run `python -m research.train.ship_weights --card`"
