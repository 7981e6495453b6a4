import math

import numpy as np
import pytest
import torch

from research.scenes import VALIDATION_SEEDS
from research.tests.train.small_run import POOL
from research.train.ranks import Ranks
from research.train.rooms import RoomPoolConfig
from research.train.train_config import TrainStepConfig
from research.train.validation import ValidationConfig, _figures, validate, validation_rooms
from semantic_mapper.config import convert_config
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.labels import ROOMS
from tests.small import tiny_field

POOL_CONFIG = convert_config(POOL, RoomPoolConfig, "test config")
CONFIG = ValidationConfig(rooms=3, queries=2, rays=64, views=3)
CPU = torch.device("cpu")


def test_figures_are_those_of_the_one_implementation(rng: np.random.Generator):
    truth = rng.integers(0, 12, 4000)  # some classes of the set do not occur
    predicted = np.where(rng.random(4000) < 0.6, truth, rng.integers(0, len(ROOMS) + 1, 4000))
    counts = np.zeros((len(ROOMS), len(ROOMS) + 1), np.int64)
    np.add.at(counts, (truth, predicted), 1)
    reference = ConfusionMatrix(ROOMS)
    unknown = predicted == len(ROOMS)
    reference.update(ROOMS.to_ids(truth), ROOMS.to_ids(np.where(unknown, -1, predicted)))
    expected = reference.metrics()
    assert _figures(torch.from_numpy(counts)) == pytest.approx((expected.miou, expected.total_accuracy))


def test_nothing_counted_is_no_figure():
    assert all(math.isnan(f) for f in _figures(torch.zeros(5, 6)))


def test_ranks_share_the_rooms_of_validation():
    shares = [
        [room.seed for room in validation_rooms(CONFIG, POOL_CONFIG, Ranks(rank, 2, rank), CPU)] for rank in range(2)
    ]
    assert shares == [[VALIDATION_SEEDS[0], VALIDATION_SEEDS[2]], [VALIDATION_SEEDS[1]]]


def test_validation_repeats_itself_leaves_the_field_in_training_and_differs_without_depth():
    rooms = validation_rooms(CONFIG, POOL_CONFIG, Ranks(), CPU)
    model = tiny_field().train()
    before = {n: t.clone() for n, t in model.state_dict().items()}
    first, again = (validate(model, rooms, CONFIG, TrainStepConfig(), Ranks()) for _ in range(2))
    assert first == again and model.training
    assert (first.miou, first.accuracy) != (first.blind_miou, first.blind_accuracy)
    assert first.rank == (first.miou + first.blind_miou) / 2
    assert all(torch.equal(before[n], t) for n, t in model.state_dict().items())
