"""A pytest plugin for replay-based tests of robot projects: a log goes in, a map to assert on comes out.

    def test_the_kitchen(replay_log):
        kitchen = replay_log("logs/kitchen.mcap", max_frames=60)
        assert kitchen.class_at((1.2, 0.4, 0.8)) == "table" and not kitchen.refused
        assert kitchen.nearest("chair", (0, 0, 1)).distance_m < 0.8
        kitchen.assert_like("runs/kitchen", labels=0.02)  # stored by `pytest --update-runs`

pytest finds it by itself where semantic-mapper is installed (``-p no:semantic_mapper.testing`` leaves it out), and it
costs nothing until a test requests the fixture: PyTorch and Open3D are loaded then.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from semantic_mapper.replay.testing import LogReplays, ReplayedMap

__all__ = ["LogReplays", "ReplayedMap", "replay_log"]

_UPDATE = "--update-runs"


def __getattr__(name: str) -> Any:
    """``LogReplays`` and ``ReplayedMap``, loaded when they are first used."""
    if name in ("LogReplays", "ReplayedMap"):
        return getattr(importlib.import_module("semantic_mapper.replay.testing"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--update-runs``."""
    group = parser.getgroup("semantic-mapper")
    group.addoption(_UPDATE, action="store_true", help="Store runs where `assert_like` would compare with them.")


@pytest.fixture(scope="session")
def replay_log(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> LogReplays:
    """Replays logs: ``replay_log("kitchen.mcap", max_frames=60)`` gives a ``ReplayedMap``, the same one to all tests.

    Relative paths begin at pytest's root folder.
    """
    make = importlib.import_module("semantic_mapper.replay.testing").LogReplays
    config = request.config
    return make(
        config.rootpath, lambda name: tmp_path_factory.mktemp(f"replay-{name}-"), update=bool(config.getoption(_UPDATE))
    )
