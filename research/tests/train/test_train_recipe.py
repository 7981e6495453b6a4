import re
import subprocess
from pathlib import Path

import pytest

from research.peers.kinds import build_field
from research.train.recipe import git_revision
from research.train.train_config import TrainConfig
from semantic_mapper.config import load_config
from semantic_mapper.labels import ROOMS

ROOT = Path(__file__).resolve().parents[3]
NESF = ROOT / "research" / "recipes" / "nesf-rooms.toml"  # settings of its own, read in tests/contract/test_settings.py


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A git checkout with the package folder in it, committed."""
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / "file.py").write_text("a = 1\n", encoding="utf-8")
    identity = ("-c", "user.name=test", "-c", "user.email=test@example.com")
    for arguments in (("init", "-q"), ("add", "."), (*identity, "commit", "-qm", "first")):
        subprocess.run(["git", "-C", str(tmp_path), *arguments], check=True, capture_output=True)
    return tmp_path


def test_the_revision_is_that_of_the_checkout_and_tells_of_changes(checkout: Path):
    clean = git_revision(checkout / "package")
    assert clean is not None and re.fullmatch(r"[0-9a-f]{40}", clean)
    (checkout / "package" / "file.py").write_text("a = 2\n", encoding="utf-8")
    assert git_revision(checkout / "package") == f"{clean}-dirty"


def test_a_package_outside_any_checkout_has_no_revision(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    assert git_revision(tmp_path) is None
    monkeypatch.setenv("PATH", str(tmp_path))
    assert git_revision(tmp_path) is None, "nor where there is no git"


@pytest.mark.parametrize(
    "path", sorted(set((ROOT / "research" / "recipes").glob("*.toml")) - {NESF}), ids=lambda p: p.name
)
def test_every_recipe_is_a_config_of_a_field_that_can_be_built(path: Path):
    config = load_config(path, TrainConfig)
    assert config.seconds > 0 or config.steps > 0
    field = build_field(config.kind, config.field, ROOMS)
    assert all(part in dict(field.named_modules()) for part in config.bfloat16)
