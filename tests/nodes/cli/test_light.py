"""What needs neither torch nor Open3D does not load them: it starts in half a second instead of three."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import pytest

from semantic_mapper.nodes.cli.main import VERBS
from tests.contract import entry_points as api
from tests.nodes.mapper.test_query_service import a_folder, answering
from tests.queries.scene import whole_map

HEAVY = ("torch", "open3d", "ray", "rerun", "depthai", "gtsam", "matplotlib", "pandas")
# Runs uses of the command one after the other; the package that one loads is told of it and of those behind it.
PROGRAM = """
import json, sys
from semantic_mapper.nodes.cli.main import main

uses, heavy, found = *json.loads(sys.argv[1]), []
for use in uses:
    sys.argv[1:] = use
    try:
        main()
    except SystemExit as ended:
        found.append((ended.code or 0, [name for name in heavy if name in sys.modules]))
with open("found.json", "w") as file:
    json.dump(found, file)
"""


def loaded(folder: Path, uses: Iterable[str]) -> list[tuple[int, list[str]]]:
    """Exit code of each use of the command in one process, and which heavy packages are loaded after it."""
    arguments = json.dumps(([use.split() for use in uses], HEAVY))
    command = [sys.executable, "-c", PROGRAM, arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 0, done.stderr
    return [(code, names) for code, names in json.loads((folder / "found.json").read_text())]


@pytest.fixture
def files(log: Path, tmp_path: Path) -> Path:
    """Holds room.mcap, map.npz and boxes.json."""
    (tmp_path / "room.mcap").symlink_to(log)
    whole_map().save(tmp_path / "map.npz")
    box = {"id": 1, "class": "chair", "T_world_box": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}
    (tmp_path / "boxes.json").write_text(json.dumps({"boxes": [{**box, "size": [1, 1, 1]}]}))
    return tmp_path


def test_no_help_loads_a_heavy_package(tmp_path: Path) -> None:
    commands = {name: api.verb_of(name) for name in VERBS}
    groups = {name: command.commands for name, command in commands.items() if hasattr(command, "commands")}
    verbs = ["", *commands, *(f"{name} {verb}" for name, verbs in groups.items() for verb in verbs)]
    uses = [f"{verb} --help" for verb in verbs]
    assert loaded(tmp_path, uses) == [(0, [])] * len(uses)


def test_light_verbs_load_no_heavy_package(files: Path) -> None:
    uses = {
        "info room.mcap": 0,
        "info map.npz": 0,
        "query map.npz info": 0,
        "query map.npz at 0 0 0.3": 0,
        "query map.npz nearest floor 0 0 1": 0,
        "query map.npz instances": 0,
        "query map.npz graph": 0,
        "export room.mcap --out folder": 0,
        "export room.mcap --out foxglove.mcap": 0,
        "export room.mcap --out trajectory.txt": 0,
        "export room.mcap --out tum --format tum": 0,
        "import folder again.mcap": 0,
        "import room.mcap clean.mcap": 0,
        "export map.npz --out map.ply": 0,
        "info boxes.json": 0,
        "keys make --keys keys": 0,
        "keys show --keys keys": 0,
    }
    found = loaded(files, uses)
    assert dict(zip(uses, found, strict=True)) == {use: (code, []) for use, code in uses.items()}


def test_errors_that_need_no_heavy_package_load_none(files: Path) -> None:
    uses = {
        "info none.mcap": 1,
        "info none.npz": 1,
        "query none.npz info": 1,
        "query none info": 1,
        "query map.npz nearest unicorn 0 0 1": 1,
        "query map.npz whither": 2,
        "export none.mcap --out x": 1,
        "export none.npz --out x.ply": 1,
        "import none x.mcap": 1,
        "replay none.mcap --out x": 1,
        "replay none.mp4 --out x": 1,
        "eval none.mcap": 1,
        "finetune none.mcap --keyframes 3 --seconds 9 --out x.safetensors": 1,
        "autolabel none.mcap --weights rooms --out x.mcap": 1,
        "label none.mcap --suggest 3": 1,
        "import none.mcap x.mcap": 1,
        "merge none.npz map.npz --out x.npz": 1,
        "compare none.npz map.npz": 2,
        "query none.npz relocalize room.mcap": 1,
        "query map.npz relocalize none.mcap": 1,
        "calibrate none": 1,
        "fleet run replay none.mcap --out x": 1,
        "refine none.npz --out x.npz": 1,
        "info none.json": 1,
        "view none.mcap": 1,
        "up none.toml": 1,
        "keys show --keys none": 1,
        "fly": 2,
    }
    found = loaded(files, uses)
    assert dict(zip(uses, found, strict=True)) == {use: (code, []) for use, code in uses.items()}


def test_who_asks_a_running_mapper_loads_no_heavy_package(tmp_path: Path) -> None:
    robot = (
        "import sys\n"
        "from semantic_mapper import MapClient\n"
        "with MapClient(sys.argv[1]) as client:\n"
        "    print(client.info().blocks > 0, client.nearest('floor', (0, 0, 1)) is not None, end=' ')\n"
        "    client.graph(), client.mirror(), client.at([(0, 0, 1)])\n"
        f"print([name for name in {HEAVY} if name in sys.modules])\n"
    )
    with a_folder() as sockets, answering(endpoint := f"ipc://{sockets}/query", whole_map()):
        done = subprocess.run(
            [sys.executable, "-c", robot, endpoint], capture_output=True, text=True, timeout=100, check=False
        )
        found = loaded(tmp_path, [f"query {endpoint} {question}" for question in ("info", "nearest floor 0 0 1")])
    assert done.stdout.strip() == "True True []", done.stderr
    assert found == [(0, []), (0, [])]
