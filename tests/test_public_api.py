"""The names that ``semantic_mapper`` offers, and that nothing of ours fights a user's own modules."""

import inspect
import os
import subprocess
import sys
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest

import semantic_mapper
from semantic_mapper.client import MapClient
from semantic_mapper.queries.snapshot import MapSnapshot


@pytest.mark.parametrize("name", semantic_mapper.__all__)
def test_public_name_resolves_to_a_documented_object(name: str) -> None:
    assert getattr(semantic_mapper, name).__doc__
    assert name in dir(semantic_mapper)


def test_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Maper'"):
        _ = semantic_mapper.Maper  # pyright: ignore[reportAttributeAccessIssue]


def test_script_beside_modules_of_the_same_names_gets_both(tmp_path: Path) -> None:
    for name in ("replay", "nodes", "drivers", "launch"):
        (tmp_path / f"{name}.py").write_text(f"MINE = {name!r}\n")
    script = tmp_path / "robot.py"
    script.write_text(
        "import drivers, launch, multiprocessing, nodes, replay\n"
        "multiprocessing.set_start_method('forkserver', force=True)\n"  # Python 3.14's default
        "from semantic_mapper import Mapper, open_log\n"
        "from semantic_mapper.drivers.registry import KINDS\n"
        "from semantic_mapper.nodes.cli.main import app\n"
        "print(drivers.MINE, launch.MINE, nodes.MINE, replay.MINE, Mapper.__module__, open_log.__module__)\n"
    )
    # Under CI OpenVINO reports nothing, from a process that would run the script again.
    environment = {name: value for name, value in os.environ.items() if name != "CI"}
    command = [sys.executable, str(script)]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [
        "drivers",
        "launch",
        "nodes",
        "replay",
        "semantic_mapper.mapper",
        "semantic_mapper.replay.log.sequence",
    ]


def test_importing_the_package_loads_nothing_heavy() -> None:
    program = "import semantic_mapper, sys; print(sorted({'torch', 'numpy', 'zmq', 'open3d'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-I", "-c", program], capture_output=True, text=True, check=False)
    assert (done.stdout.strip(), done.returncode) == ("[]", 0), done.stderr


def test_all_that_a_client_receives_is_public() -> None:
    wanted: list[Any] = [
        get_type_hints(value)["return"] for name, value in vars(MapClient).items() if name[0] != "_" and callable(value)
    ]
    found: set[str] = set()
    while wanted:
        kind = wanted.pop()
        wanted += get_args(kind)
        if getattr(kind, "__module__", "").startswith("semantic_mapper.") and kind.__name__ not in found:
            found.add(kind.__name__)
            wanted += get_type_hints(kind).values() if is_dataclass(kind) and kind is not MapSnapshot else ()
            of_kind = [value for name, value in vars(kind).items() if name[0] != "_" and inspect.isfunction(value)]
            wanted += [get_type_hints(method)["return"] for method in of_kind]
    assert found <= {*semantic_mapper.__all__}, found - {*semantic_mapper.__all__}
    assert {"BlockChanges", "Instance", "OrientedBox", "Room", "MapMirror", "WeightsEntry"} <= found
