"""The command as such: help, usage errors, versions."""

from __future__ import annotations

import pytest

from semantic_mapper import __version__
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
        assert f"  {name} " in listed and " ".join((verb.help or "").split()).startswith(text.rstrip(".")), name
        if not hasattr(verb, "commands"):
            shown = run_ok(name, "--help")
            assert f"Example: semantic-mapper {name}" in shown.stdout and not shown.stderr


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
