"""One replay of the golden log for all tests that look at what it leaves."""

from pathlib import Path

import pytest

from tests.contract.runs import replay_room


@pytest.fixture(scope="session")
def room_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of ``map``."""
    return replay_room(tmp_path_factory.mktemp("contract"))
