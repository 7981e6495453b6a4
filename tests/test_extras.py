"""Without the extras, maps are made all the same, and what needs an extra names it."""

import subprocess
import sys

import pytest

HIDDEN = """
import sys
FLEET = ("ray", "duckdb", "pyarrow", "fsspec", "s3fs", "gcsfs")
for name in ("pyrealsense2", "pycolmap", "foxglove", "mcp", *FLEET):
    sys.modules[name] = None
"""


TRY = """
from pathlib import Path
from semantic_mapper.errors import SemanticMapperError
try:
    {}
except SemanticMapperError as error:
    print(error)
"""
FILM = "from semantic_mapper.replay.sfm.reconstruct import FilmOptions, import_film as f"
REALSENSE = "from semantic_mapper.drivers.realsense.devices import load_realsense as f; f()"
VERB = "from semantic_mapper.nodes.cli.main import app; app({!r})"


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("import semantic_mapper.replay.exporters.map_files, semantic_mapper.nodes.cli.main; print('fine')", "fine"),
        (TRY.format(f"{FILM}; f(Path('a.mp4'), Path('a.mcap'), FilmOptions(), print)"), "no packages for Linux on ARM"),
        (TRY.format(REALSENSE), "pip install 'semantic-mapper[realsense]'"),
        (TRY.format("import semantic_mapper.nodes.foxglove.server"), "pip install 'semantic-mapper[foxglove]'"),
        (VERB.format(["fleet", "run", "map", __file__, "--out", "none"]), "pip install 'semantic-mapper[fleet]'"),
        (
            TRY.format("from semantic_mapper.nodes.agents import serve as s; s(print)"),
            "pip install 'semantic-mapper[mcp]'",
        ),
        (
            TRY.format("from semantic_mapper.replay.exporters.lerobot import LeRobotExporter as e; e(None, None)"),
            "pip install 'semantic-mapper[lerobot]'",
        ),
        (VERB.format(["fleet", "table", "none"]), "pip install 'semantic-mapper[fleet]'"),
    ],
)
def test_what_an_extra_is_needed_for_names_it(code: str, expected: str) -> None:
    command = [sys.executable, "-c", HIDDEN + code]
    run = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert expected in run.stdout + run.stderr, run.stderr
