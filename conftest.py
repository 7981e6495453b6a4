"""Fixtures that every test may use: real recordings where there are any, and the same random numbers every time."""

from __future__ import annotations

import os
import random
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
import torch
from hypothesis import settings

pytest_plugins = ["tests.cpu_time"]
REPOSITORY = Path(__file__).resolve().parent

# The same examples in every run, and no wall-clock limit on one: a failure must come from the code.
settings.register_profile("project", deadline=None, derandomize=True, max_examples=60)
settings.load_profile("project")


@pytest.fixture(autouse=True)
def _keep_environment() -> Iterator[None]:
    """What a command that runs inside a test sets for its process must not reach the next test."""
    with patch.dict(os.environ):
        yield


@pytest.fixture(autouse=True)
def _seed_random_numbers() -> None:
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002  (libraries that draw from the global generator)
    torch.manual_seed(0)


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator with a fixed seed."""
    return np.random.default_rng(0)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real recordings beside the checkout, or the one that SEMANTIC_MAPPER_SHARED_DATA names."""
    folder = Path(os.environ.get("SEMANTIC_MAPPER_SHARED_DATA", REPOSITORY.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real recordings: {folder} is missing; set SEMANTIC_MAPPER_SHARED_DATA to where they are")
    return folder


@pytest.fixture(scope="session")
def redkitchen(shared_data: Path) -> Path:
    """Sequence folder of the hand-held kitchen recording: 200 frames, 640x480, labels and a labelled mesh."""
    folder = shared_data / "redkitchen"
    if not folder.is_dir():
        pytest.skip(f"no recording '{folder.name}' in {shared_data}")
    return folder
