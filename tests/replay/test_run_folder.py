"""Which map a path means, and what is said where no map is."""

from pathlib import Path

import pytest

from semantic_mapper.errors import ConfigError
from semantic_mapper.replay.run_folder import map_path


@pytest.mark.parametrize(
    ("file", "says"),
    [
        ("", "give a saved map or a folder"),
        ("kitchen.mcap", "is a log; `semantic-mapper map"),
        ("kitchen.npz", "name the map itself, such as"),
        ("run1/map.npz", "name the map itself, such as"),
        ("fleet.json", "a fleet's store: `merge` makes one map of its maps"),
    ],
)
def test_a_folder_without_a_map_says_what_is_in_it(tmp_path: Path, file: str, says: str) -> None:
    if file:
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).touch()
    with pytest.raises(ConfigError, match=says):
        map_path(tmp_path)
