"""The command as such: help, usage errors, versions."""

from __future__ import annotations

from pathlib import Path

import pytest

from semantic_mapper import __version__
from semantic_mapper.nodes.cli.main import VERBS as VERBS_AND_TEXTS
from tests.contract import entry_points as api
from tests.nodes.support import run, run_here, run_process

VERBS = sorted(name for name in VERBS_AND_TEXTS if not hasattr(api.verb_of(name), "commands"))


@pytest.mark.slow
@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_explains_itself_with_an_example(verb: str) -> None:
    done = run_process(verb, "--help")
    assert done.returncode == 0, done.stderr
    assert f"Example: semantic-mapper {verb}" in done.stdout
    assert done.stderr == ""


def test_help_lists_all_verbs() -> None:
    done = run("--help")
    assert done.returncode == 0
    assert all(f"  {verb} " in done.stdout for verb in VERBS)
    codes = " ".join(done.stdout.split()).partition("Exit codes: ")[2].partition(".")[0]
    assert [word for word in codes.replace(",", " ").split() if word.isdigit()] == ["0", "1", "2", "3", "130"]


def test_the_list_of_verbs_says_what_each_says_of_itself() -> None:
    for name, (_, text) in VERBS_AND_TEXTS.items():
        said = " ".join((api.verb_of(name).help or "").split())
        assert said.startswith(text.rstrip(".")), name


def test_version_is_that_of_the_package() -> None:
    assert run("--version").stdout == f"semantic-mapper {__version__}\n"


@pytest.mark.parametrize(
    "arguments",
    [
        ("replai",),
        ("replay", "room.mcap"),
        ("replay", "room.mcap", "--out", "x", "--voxel-size", "-1"),
        ("import", "src", "dst", "--format", "film"),
        ("import", "src", "dst", "--topic", "image"),
        ("finetune", "room.mcap", "--keyframes", "1", "--out", "w"),
        ("finetune", __file__, "--keyframes", "4", "--out", "w", "--seconds", "0"),
        ("eval",),
        ("query", "map.npz", "where"),
        ("query", "map.npz", "at", "1", "2"),
        ("query", "map.npz", "at", "1", "2", "east"),
        ("query", "map.npz", "nearest", "1", "2", "3"),
        ("query", "map.npz", "info", "--jason", "x"),
    ],
)
def test_wrong_usage_exits_with_2_and_says_so_on_stderr(arguments: tuple[str, ...]) -> None:
    done = run(*arguments)
    assert done.returncode == 2
    assert done.stdout == ""
    assert "Usage: semantic-mapper" in done.stderr


@pytest.mark.parametrize("number", ["inf", "nan", "1e308"])
def test_numbers_that_nothing_can_be_computed_with_are_wrong_usage(number: str, tmp_path: Path) -> None:
    code, said = run_here("record", tmp_path / "x.mcap", "--duration", number)
    assert code == 2 and "--duration" in said
