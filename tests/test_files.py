"""Files that people name are read with a limit, and never waited for."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from semantic_mapper.errors import ConfigError
from semantic_mapper.files import read_regular


def test_a_regular_file_is_read_up_to_the_limit(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"12345")
    assert read_regular(path, 5) == b"12345"
    with pytest.raises(ConfigError, match=r"file: is larger than the limit of 4 bytes"):
        read_regular(path, 4)


def test_what_may_never_end_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    for path in (Path("/dev/zero"), tmp_path / "fifo", tmp_path):
        with pytest.raises(ConfigError, match=f"{path}: is no regular file"):
            read_regular(path, 10)
    with pytest.raises(FileNotFoundError):
        read_regular(tmp_path / "gone", 10)
