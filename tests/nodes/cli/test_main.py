"""The command as such: help, usage errors, versions."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from semantic_mapper import __version__
from semantic_mapper.nodes.cli import main as cli
from semantic_mapper.nodes.cli.main import VERBS
from tests.contract import entry_points as api
from tests.nodes.support import refused, run_ok


def test_help_lists_all_verbs_and_each_explains_itself_with_an_example() -> None:
    assert run_ok("--version").stdout == f"semantic-mapper {__version__}\n"
    listed = run_ok("--help").stdout
    codes = " ".join(listed.split()).partition("Exit codes: ")[2].partition(".")[0]
    assert [word for word in codes.replace(",", " ").split() if word.isdigit()] == ["0", "1", "2", "3", "130"]
    for name, (_, text) in VERBS.items():
        verb = api.verb_of(name)
        assert f"  {name} " in listed and f"{text}\n" in listed, name
        assert " ".join((verb.help or "").split()).startswith(text.rstrip(".")), name


def test_help_has_an_example_and_at_most_40_lines() -> None:
    groups = {name: getattr(api.verb_of(name), "commands", ()) for name in VERBS}
    for words in ("", *groups, *(f"{name} {verb}" for name, verbs in groups.items() for verb in verbs)):
        for columns in (80, 110):
            shown = CliRunner().invoke(cli.app, [*words.split(), "--help"], terminal_width=columns - 2).output
            assert len(shown.splitlines()) <= 40, f"{words} at {columns} columns"
            assert f"Example: semantic-mapper {words}" in shown or not words or groups.get(words), words


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        ("mpa room.mcap", "map"),
        ("map room.mcap --voxelsize 1", "--voxel-size"),
        ("map room.mcap --quality fsat", "fast"),
        (f"map {__file__} --set voxelmap.voxel_size_m=1", "voxel_map.voxel_size_m"),
        (f"map {__file__} --set voxel_size_m=1", "voxel_map.voxel_size_m"),
        ("query map.npz nearst wall 0 0 1", "nearest"),
        (f"finetune {__file__} --keyframes 4 --out w --set sedd=1", "seed"),
        ("up camra", "camera"),
        ("up camera --set camera.knd=oak", "kind"),
        ("import src dst --format polycan", "polycam"),
        ("export map.npz --out map.gbl", ".glb"),
        ("fleet rnu x", "run"),
        ("doctor --cameras --kind v4l", "v4l2"),
    ],
)
def test_a_typo_names_the_nearest(words: str, meant: str) -> None:
    assert refused(*words.split(), code=2).replace("'", "`").endswith(f"id you mean `{meant}`?")


def test_a_shell_completes_settings_their_values_and_launches() -> None:
    for words, found in (
        ("ma", ["map"]),
        ("map x --quality fa", ["fast"]),
        ("map x --set quality=f", ["quality=fast"]),
        ("fleet run map x --set voxel_map.vox", ["voxel_map.voxel_size_m=0.02"]),
        ("up cam", ["camera"]),
        ("up camera --set camera.ki", ["camera.kind="]),
    ):
        told = {"COMP_WORDS": f"semantic-mapper {words}", "COMP_CWORD": str(len(words.split()))}
        env = {**told, "_SEMANTIC_MAPPER_COMPLETE": "complete_bash"}
        assert CliRunner().invoke(cli.app, prog_name="semantic-mapper", env=env).output.split() == found, words


@pytest.mark.parametrize(
    "words",
    [
        "map room.mcap --out x --voxel-size -1",
        "import src dst --format film",
        "import src dst --topic image",
        f"finetune {__file__} --keyframes 4 --out w --seconds 0",
        "eval",
        "query map.npz at 1 2 east",
        "query map.npz nearest 1 2 3",
        "query map.npz info --jason x",
        *(f"record x.mcap --duration {number}" for number in ("inf", "nan", "1e308")),
    ],
)
def test_wrong_usage_exits_with_2_and_says_so(words: str) -> None:
    assert "Usage: semantic-mapper" in refused(*words.split(), code=2)
