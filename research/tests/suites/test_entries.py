import shutil
from pathlib import Path

import pytest

from research.suites.entries import load_entries
from semantic_mapper.errors import ConfigError, WeightsError
from semantic_mapper.fields.checkpoint import Checkpoint, save_checkpoint
from tests.small import tiny_field


def weights(path: Path, seed: int) -> Path:
    save_checkpoint(Checkpoint(tiny_field(seed=seed)), path)
    return path


def test_weights_are_named_by_file_else_by_folder_else_by_path(tmp_path: Path):
    a, b = weights(tmp_path / "x" / "a.safetensors", 0), weights(tmp_path / "x" / "b.safetensors", 1)
    assert [c.name for c in load_entries([a, b])] == ["a", "b"]
    other = weights(tmp_path / "y" / "a.safetensors", 2)
    assert [c.name for c in load_entries([a, other])] == ["x", "y"]
    assert [c.name for c in load_entries([a, b, other])] == [str(a), str(b), str(other)]


def test_a_kind_takes_part_with_random_weights_of_its_defaults(tmp_path: Path):
    a = weights(tmp_path / "a.safetensors", 0)
    first, second = load_entries([a], ["semantic_nerf"])
    assert (first.file, second.file, second.name) == ("a.safetensors", "", "semantic_nerf")
    assert second.field.kind == "semantic_nerf"
    again, other = load_entries([], ["semantic_nerf", "unet"])
    assert again.digest == second.digest != other.digest
    with pytest.raises(ConfigError, match="another column"):
        load_entries([], ["unet", "unet"])
    with pytest.raises(ConfigError, match="no field of kind"):
        load_entries([], ["nerf"])


def test_the_same_weights_twice_are_refused(tmp_path: Path):
    a = weights(tmp_path / "a.safetensors", 0)
    shutil.copy(a, tmp_path / "b.safetensors")
    with pytest.raises(WeightsError, match="given twice"):
        load_entries([a, tmp_path / "b.safetensors"])
