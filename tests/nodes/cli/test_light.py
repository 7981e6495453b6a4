"""What needs neither torch nor Open3D does not load them: it starts in half a second instead of three."""

import json
import subprocess
import sys
from pathlib import Path

from semantic_mapper.nodes.cli.main import VERBS
from tests.contract import entry_points as api
from tests.nodes.mapper.test_query_service import a_folder, answering
from tests.queries.scene import whole_map

HEAVY = ("torch", "open3d", "ray", "rerun", "depthai", "gtsam", "matplotlib", "pandas")
# Runs uses of the command one after the other; a package that one loads counts for it and for those behind it.
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
LIGHT = (
    "info room.mcap",
    "info map.npz",
    "query map.npz info",
    "query map.npz at 0 0 0.3",
    "query map.npz nearest floor 0 0 1",
    "query map.npz instances",
    "query map.npz graph",
    "export room.mcap --out folder",
    "export room.mcap --out foxglove.mcap",
    "export room.mcap --out trajectory.txt",
    "import folder again.mcap",
    "import room.mcap clean.mcap",
    "export map.npz --out map.ply",
    "keys make --keys keys",
)
ERRORS = (  # of what is heavy where it goes well
    "query map.npz nearest unicorn 0 0 1",
    "export none.npz --out x.ply",
    "map none.mcap --out x",
    "eval none.mcap",
    "finetune none.mcap --keyframes 3 --seconds 9 --out x.safetensors",
    "autolabel none.mcap --weights rooms --out x.mcap",
    "label none.mcap --suggest 3",
    "merge none.npz map.npz --out x.npz",
    "scale none --height 1.5",
    "fleet run map none.mcap --out x",
    "refine none.npz --out x.npz",
)


def assert_light(folder: Path, uses: dict[str, int]) -> None:
    """Uses of the command in one process end with these exit codes and load nothing heavy."""
    arguments = json.dumps(([use.split() for use in uses], HEAVY))
    command = [sys.executable, "-c", PROGRAM, arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 0, done.stderr
    found = dict(zip(uses, json.loads((folder / "found.json").read_text()), strict=True))
    assert found == {use: [code, []] for use, code in uses.items()}


def test_help_light_verbs_and_errors_load_no_heavy_package(log: Path, tmp_path: Path) -> None:
    (tmp_path / "room.mcap").symlink_to(log)
    whole_map().save(tmp_path / "map.npz")
    groups = {name: getattr(api.verb_of(name), "commands", ()) for name in VERBS}
    verbs = ["", *groups, *(f"{name} {verb}" for name, verbs in groups.items() for verb in verbs)]
    helps = {f"{verb} --help": 0 for verb in verbs}
    assert_light(tmp_path, helps | dict.fromkeys(LIGHT, 0) | dict.fromkeys(ERRORS, 1) | {"up none.toml": 2})


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
        assert_light(tmp_path, {f"query {endpoint} {question}": 0 for question in ("info", "nearest floor 0 0 1")})
    assert done.stdout.strip() == "True True []", done.stderr
