"""The TOML files that ship are read; names and defaults of all settings stand in docs/settings.md."""

from pathlib import Path

import pytest

from semantic_mapper.config import load_config
from semantic_mapper.nodes.launcher.launch_file import load_launch
from semantic_mapper.replay.importers.base import RenameConfig

REPOSITORY = Path(__file__).resolve().parents[2]
GIVEN = {"camera": ["camera.kind=oak"], "replay": ["camera.log=a.mcap"]}


@pytest.mark.parametrize("path", sorted((REPOSITORY / "launch").glob("*.toml")), ids=lambda p: p.stem)
def test_a_shipped_launch_file_is_read(path: Path, tmp_path: Path) -> None:
    assert load_launch(path, GIVEN.get(path.stem, []), tmp_path).nodes


@pytest.mark.parametrize(
    "path", sorted((REPOSITORY / "replay" / "importers" / "classes").glob("*.toml")), ids=lambda p: p.stem
)
def test_a_shipped_table_of_classes_is_read(path: Path) -> None:
    assert load_config(path, RenameConfig)
