import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from semantic_mapper.labels import NYU40
from semantic_mapper.replay.log.format import LogWriter
from semantic_mapper.transport.messages import StreamInfo
from tests.transport import samples

FRAMES = 12


@pytest.fixture
def endpoint() -> Iterator[str]:
    """An ``ipc://`` endpoint of its own; pytest's tmp_path may be longer than a socket's path can be."""
    with tempfile.TemporaryDirectory(prefix="sm-") as folder:
        yield f"ipc://{Path(folder) / 'socket'}"


@pytest.fixture
def small_log(tmp_path: Path) -> Path:
    """A log of ``FRAMES`` frames, 24x18."""
    path = tmp_path / "small.mcap"
    with LogWriter(path, StreamInfo("test", {samples.CAMERA: samples.INTRINSICS}, NYU40)) as writer:
        for seq in range(FRAMES):
            writer.write_frame(samples.make_frame(seq))
    return path
