"""Results are written map first, each file whole or not at all, wherever SIGKILL strikes."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import cv2
import pytest

from semantic_mapper.mapping.voxel_map import VoxelMap
from tests.nodes.support import TIMEOUT_S

pytestmark = pytest.mark.slow
ORDER = ["map.npz", "map.ply", "summary.json", "overview.png", "report.html"]
# Replays a log once for each file of the results, and is killed when that file is complete but for its name.
KILLED = """
import os, signal, sys
from pathlib import Path
from semantic_mapper.mapping.open3d_loader import load_open3d
from semantic_mapper.config import load_mapper_config
from semantic_mapper.replay.map_log import replay_log
from semantic_mapper.nodes.process import StopRequest, prepare_process
prepare_process()
load_open3d()
log, weights, config, out, *names = map(Path, sys.argv[1:])
rename = os.replace

def killed_at(name):
    def replace(source, target):
        if Path(target).name == name:
            os.kill(os.getpid(), signal.SIGKILL)
        rename(source, target)
    os.replace = replace
    replay_log(log, out / name, weights, load_mapper_config(config), max_frames=2)

for name in [n.name for n in names]:
    (out / name).mkdir(parents=True)
    for old in names[1:]:
        (out / name / old).write_text("of an earlier run")
    child = os.fork()
    if not child:
        killed_at(name)
        os._exit(0)
    assert os.waitpid(child, 0)[1] == signal.SIGKILL, name
"""


@pytest.fixture(scope="module")
def killed(log: Path, weights: Path, config: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("killed")
    command = [sys.executable, "-c", KILLED, *map(str, (log, weights, config, out)), *ORDER]
    done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    assert done.returncode == 0, done.stderr
    return out


@pytest.mark.parametrize("stage", range(len(ORDER)))
def test_a_kill_leaves_whole_files_the_map_first_and_none_of_an_earlier_run(killed: Path, stage: int) -> None:
    folder = killed / ORDER[stage]
    assert sorted(p.name for p in folder.iterdir() if not p.name.startswith(".")) == sorted(ORDER[:stage])
    if stage > 0:
        assert VoxelMap.load(folder / "map.npz").frames > 0
    if stage > 1:
        header, body = (folder / "map.ply").read_bytes().split(b"end_header\n", 1)
        size = {"float": 4, "uchar": 1, "ushort": 2, "int": 4}
        row = sum(size[kind] for kind in re.findall(r"property (\w+) \w+\n", header.decode()))
        count = int(re.findall(r"element vertex (\d+)", header.decode())[0])
        assert len(body) == count * row > 0
    if stage > 2:
        summary = json.loads((folder / "summary.json").read_text())
        assert summary["stopped_by"] is None and summary["frames"]["published"] == 2
    if stage > 3:
        assert cv2.imread(str(folder / "overview.png")) is not None
