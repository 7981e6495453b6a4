"""A calibration that DepthAI itself has written."""

from pathlib import Path

import pytest

from semantic_mapper.drivers import live, registry
from semantic_mapper.drivers.oak import camera
from tests.drivers.oak import host


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is lost on a busy machine, and a device is back at once."""
    monkeypatch.setattr(live, "FIRST_PAUSE_S", 0.02)
    monkeypatch.setattr(live, "QUEUE", 64)
    monkeypatch.setattr(camera, "QUEUE", 64)
    monkeypatch.setattr(camera, "ODOMETRY_WAIT_S", 20.0)
    monkeypatch.setattr(registry, "SEARCH_S", 0.1)


@pytest.fixture(scope="session")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return host.write_calibration(tmp_path_factory.mktemp("oak") / "calibration.json")
