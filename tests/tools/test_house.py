"""The measure of the project's size."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools import house


def test_modules_that_reach_each_other_are_a_circle() -> None:
    imports = {"a": {"b"}, "b": {"c"}, "c": {"b", "json"}, "d": {"a"}, "e": {"f"}, "f": {"g"}, "g": {"e"}}
    assert sorted(map(sorted, house.circles(imports))) == [["b", "c"], ["e", "f", "g"]]


def test_imports_and_settings_of_a_module_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(house, "ROOT", tmp_path)
    (tmp_path / "nodes").mkdir()
    file = tmp_path / "nodes" / "a.py"
    file.write_text(
        "import json\nfrom semantic_mapper import types\n"
        "if TYPE_CHECKING:\n    from semantic_mapper import geometry\n"
        "def f():\n    from semantic_mapper.labels import ROOMS\n    import json\n"
        "class C(Config):\n    old: ClassVar = 1\n    a: int = 1\n    b: str\nclass D:\n    c: int\n"
    )
    found = house._module(file)  # pyright: ignore[reportPrivateUsage]
    assert found.name == "semantic_mapper.nodes.a" and (found.inside_functions, found.settings) == (1, 2)
    assert "semantic_mapper.types" in found.imports and "semantic_mapper.geometry" not in found.imports


def test_the_project_itself_is_measured() -> None:
    found = house.measure()
    assert found.keys() <= house.LIMITS.keys() and found["shipped lines"] > 10_000 and found["commands"] > 10
