import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture
def endpoint() -> Iterator[str]:
    """An ``ipc://`` endpoint of its own; pytest's tmp_path may be longer than a socket's path can be."""
    with tempfile.TemporaryDirectory(prefix="sm-") as folder:
        yield f"ipc://{Path(folder) / 'socket'}"
