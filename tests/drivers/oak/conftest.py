"""A calibration and a recording that DepthAI itself has written."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

import pytest

from tests.drivers.oak import host


@pytest.fixture(scope="session")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return host.write_calibration(tmp_path_factory.mktemp("oak") / "calibration.json")


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, timedelta]:
    folder = tmp_path_factory.mktemp("oak-recording")
    return folder, host.record(folder, 20)
