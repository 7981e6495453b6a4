"""The command as such: help, usage errors, versions."""

import pytest
from typer.testing import CliRunner

from semantic_mapper import __version__
from semantic_mapper.nodes.cli import main as cli
from semantic_mapper.nodes.cli.main import VERBS
from tests.contract import entry_points as api
from tests.nodes.support import refused, run_ok


def test_help_lists_all_verbs_and_each_explains_itself_with_an_example_in_40_lines() -> None:
    assert run_ok("--version").stdout == f"semantic-mapper {__version__}\n"
    listed = run_ok("--help").stdout
    codes = " ".join(listed.split()).partition("Exit codes: ")[2].partition(".")[0]
    assert [word for word in codes.replace(",", " ").split() if word.isdigit()] == ["0", "1", "2", "3", "4", "130"]
    for name, (_, text) in VERBS.items():
        assert f"  {name:9}  {text}\n" in listed and (api.verb_of(name).help or "").startswith(text.rstrip(".")), name
    groups = {name: getattr(api.verb_of(name), "commands", ()) for name in VERBS}
    for words in ("", *groups, *(f"{name} {verb}" for name, verbs in groups.items() for verb in verbs)):
        for columns in (80, 110):
            shown = CliRunner().invoke(cli.app, [*words.split(), "--help"], terminal_width=columns - 2).output
            assert len(shown.splitlines()) <= 40, f"{words} at {columns} columns"
            assert all(len(line) <= columns for line in shown.splitlines()), f"{words}: wider than {columns} columns"
            assert f"Example: semantic-mapper {words}" in shown or not words or groups.get(words), words


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("mpa room.mcap", "did you mean `map`?"),
        ("map room.mcap --voxelsize 1", "did you mean `--voxel-size`?"),
        ("map room.mcap --quality fsat", "did you mean `fast`?"),
        (f"map {__file__} --set voxel_size_m=1", "did you mean `voxel_map.voxel_size_m`?"),
        (f"finetune {__file__} --keyframes 4 --out w --set sedd=1", "did you mean `seed`?"),
        ("query map.npz nearst wall 0 0 1", "did you mean `nearest`?"),
        ("up camra", "did you mean `camera`?"),
        ("up camera --set camera.knd=oak", "did you mean `kind`?"),
        ("import src dst --format polycan", "did you mean `polycam`?"),
        ("export map.npz --out map.gbl", "did you mean `.glb`?"),
        ("import src dst --topic image", "Usage: semantic-mapper"),
        ("query map.npz at 1 2 east", "Usage: semantic-mapper"),
        *((f"record x.mcap --duration {number}", "Usage: semantic-mapper") for number in ("inf", "nan", "1e308")),
    ],
)
def test_wrong_usage_exits_with_2_and_names_the_nearest(words: str, said: str) -> None:
    assert said in refused(*words.split(), code=2)


def test_a_shell_completes_settings_values_and_launches(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("_SEMANTIC_MAPPER_COMPLETE", "complete_bash")
    for words, found in (
        ("map x --set quality = f", ["fast"]),  # as bash splits words
        ("fleet run map x --set voxel_map.vox", ["voxel_map.voxel_size_m=0.02"]),
        ("up cam", ["camera"]),
        ("up camera --set camera.ki", ["camera.kind="]),
        ("query li", ["live"]),
        ("record x --launch li", ["live"]),
        ("import x y --format r", ["replica", "rosbag", "record3d"]),
        ("fleet compare a b --operation e", ["eval"]),
    ):
        monkeypatch.setenv("COMP_WORDS", f"semantic-mapper {words}".replace(" ", "\n"))
        monkeypatch.setenv("COMP_CWORD", str(len(words.split())))
        with pytest.raises(SystemExit):
            cli.main()
        assert capsys.readouterr().out.split() == found, words
