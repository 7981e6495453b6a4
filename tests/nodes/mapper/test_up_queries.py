"""``up``: the mapper answers questions about its map while it maps."""

from __future__ import annotations

import signal
from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.client import MapClient
from semantic_mapper.errors import ConfigError
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.launcher.launch_file import load_launch
from semantic_mapper.queries.mirror import MapMirror
from tests.nodes.mapper.test_query_service import a_folder
from tests.nodes.support import REPLAY_LAUNCH, Running, repeated_frames, write_log


@pytest.mark.slow
def test_a_mapper_is_asked_while_it_replays(weights: Path, config: Path, tmp_path: Path) -> None:
    log = write_log(tmp_path / "long.mcap", repeated_frames(600))
    with a_folder() as folder:
        endpoint = f"ipc://{folder / 'query'}"
        settings = [
            f"camera.log={log}",
            f"mapper.weights={weights}",
            f"mapper.config={config}",
            f"mapper.query={endpoint}",
        ]
        sets = [word for setting in settings for word in ("--set", setting)]
        with Running("up", REPLAY_LAUNCH, *sets, "--out", tmp_path / "up") as running:
            running.wait_for_line("stream_begins")
            with MapClient(endpoint, timeout_s=60) as client:
                versions, around = set(), np.random.default_rng(0).normal(0, 0.01, (50, 3))
                while len(versions) < 4:  # the map grows while it is asked
                    for name in ROOMS.names:
                        hit, version = client.nearest(name, (0.0, 0.0, 1.0)), client.version
                        if hit is not None and (answer := client.at(hit.xyz + around)) and client.version == version:
                            assert ROOMS.id_of(name) in answer.label and answer.distance_m.min() < 0.05
                            versions.add(version)
                assert client.info().label_set == ROOMS and client.info().voxel_size_m == 0.05
                mirror = client.mirror()
                running.process.send_signal(signal.SIGINT)
                assert running.wait() == 0, running.text
        saved = VoxelMap.load(tmp_path / "up" / "map.npz")
        assert 0 < mirror.version <= saved.frames
        assert set(mirror.snapshot().packed) <= set(MapMirror.of(saved).snapshot().packed)


def test_without_a_query_endpoint_there_is_none_and_names_must_differ(tmp_path: Path) -> None:
    launch = load_launch(REPLAY_LAUNCH, ["camera.log=x"], tmp_path)
    assert launch.sockets() == ("launch", "mapper", "camera", "query")
    assert load_launch(REPLAY_LAUNCH, ["camera.log=x", "mapper.query="], tmp_path).sockets() == (
        "launch",
        "mapper",
        "camera",
    )
    assert load_launch(REPLAY_LAUNCH, ["camera.log=x", "mapper.query=ipc:///a/b"], tmp_path).sockets() == (
        "launch",
        "mapper",
        "camera",
    )
    with pytest.raises(ConfigError, match="camera: names two endpoints"):
        load_launch(REPLAY_LAUNCH, ["camera.log=x", "mapper.query=camera"], tmp_path)
    with pytest.raises(ConfigError, match="query"):
        load_launch(REPLAY_LAUNCH, ["camera.log=x", "mapper.query=../up"], tmp_path)
