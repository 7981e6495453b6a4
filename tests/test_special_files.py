"""Pipes and devices in place of logs, maps and weights are refused at once: they may never begin, or never end."""

import os
from pathlib import Path

import pytest

from semantic_mapper import VoxelMap, load_weights, open_log
from semantic_mapper.errors import LogError, MapError, WeightsError


@pytest.mark.timeout(20)
@pytest.mark.parametrize("name", ["pipe", "/dev/zero"])
def test_special_file_is_refused_by_its_kind(tmp_path: Path, name: str) -> None:
    path = tmp_path / name  # an absolute name replaces the folder
    if name == "pipe":
        os.mkfifo(path)
    with pytest.raises(LogError, match="no regular file"):
        open_log(path)
    with pytest.raises(MapError, match="no regular file"):
        VoxelMap.load(path)
    with pytest.raises(WeightsError, match="no regular file"):
        load_weights(path)
