"""One tiny log, weights file, config and in-process replay for all tests of the nodes."""

from pathlib import Path

import pytest

from tests.nodes.support import run_ok, write_config, write_log, write_weights
from tests.small import tiny_frames


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("nodes")


@pytest.fixture(scope="session")
def log(folder: Path) -> Path:
    """Six labelled 96x72 frames."""
    return write_log(folder / "room.mcap", tiny_frames(6))


@pytest.fixture(scope="session")
def weights(folder: Path) -> Path:
    """Random weights of a tiny S-Ray."""
    return write_weights(folder / "tiny.safetensors")


@pytest.fixture(scope="session")
def config(folder: Path) -> Path:
    """Mapper settings for tiny frames."""
    return write_config(folder / "mapper.toml")


@pytest.fixture(scope="session")
def replayed(folder: Path, log: Path, weights: Path, config: Path) -> Path:
    """Results of an in-process replay; its stdout is beside them."""
    out = folder / "replayed"
    done = run_ok("map", log, "--out", out, "--weights", weights, "--config", config, "--json")
    (out / "stdout.txt").write_text(done.stdout, encoding="utf-8")
    return out
