"""Training under Ray, on a cluster of this machine."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
import ray
import torch
from msgspec.structs import replace
from structlog.testing import capture_logs

from research.tests.train.small_run import POOL, contents, small_run
from research.tests.train.two_ranks import two_ranks_run
from research.train.ray_ranks import train_on_ray
from research.train.room_actors import ActorFeed, open_actor_feed
from research.train.room_feed import InlineFeed
from research.train.rooms import PackedRoom, RoomPoolConfig
from research.train.train import STATE_FILE, TrainProgress, train
from semantic_mapper.config import convert_config
from semantic_mapper.errors import ConfigError
from tests.nodes.support import eventually

ROOT = Path(__file__).resolve().parents[3]
STEPS = 40  # enough for a kill to come before the end


@pytest.fixture(scope="module")
def cluster() -> Iterator[None]:
    """More CPUs than this machine may have: what counts here is that all ranks and actors are placed."""
    folder = tempfile.mkdtemp(prefix="ray-", dir="/tmp")  # a socket's path may have 107 characters
    ray.init(num_cpus=4, include_dashboard=False, log_to_driver=False, object_store_memory=200 << 20, _temp_dir=folder)
    yield
    ray.shutdown()
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The state that two ranks under torchrun end with."""
    out = tmp_path_factory.mktemp("torchrun")
    starter = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    done = subprocess.run(
        [*starter, str(ROOT / "research" / "tests" / "train" / "two_ranks.py"), str(out), str(STEPS)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return out / STATE_FILE


def processes(name: str) -> list[psutil.Process]:
    """Of this test's cluster, by a part of the title that Ray gives them."""
    found = []
    for process in psutil.Process().children(recursive=True):
        try:
            if name in " ".join(process.cmdline()):
                found.append(process)
        except psutil.NoSuchProcess:
            continue
    return found


def assert_same_state(a: Path, b: Path) -> None:
    (tensors, about), (others, about_others) = contents(a), contents(b)
    assert tensors.keys() == others.keys()
    assert [n for n in tensors if not torch.equal(tensors[n], others[n])] == []
    assert about == about_others


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_two_ranks_under_ray_with_room_actors_equal_two_under_torchrun_bit_for_bit(
    cluster: None, undisturbed: Path, tmp_path: Path
) -> None:
    config = replace(two_ranks_run(STEPS), workers=1)
    checkpoint = train_on_ray(config, tmp_path, ranks=2)
    assert_same_state(tmp_path / STATE_FILE, undisturbed)
    assert checkpoint.recipe["ranks"] == 2 and checkpoint.recipe["steps"] == STEPS
    assert not list(tmp_path.glob(".ray-*"))


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_killed_rank_goes_on_to_the_losses_of_an_undisturbed_run(
    cluster: None, undisturbed: Path, tmp_path: Path
) -> None:
    killed: list[int] = []

    def kill_one(progress: TrainProgress) -> None:
        if progress.step >= 2 and not killed:
            victim = processes("RayTrainWorker")[0]
            victim.send_signal(signal.SIGKILL)
            killed.append(victim.pid)

    config = replace(two_ranks_run(STEPS), save_every_s=0.0)
    with capture_logs() as events:
        train_on_ray(config, tmp_path, ranks=2, on_progress=kill_one)
    restarts = [event for event in events if event["event"] == "ranks_restarted"]
    assert killed and [event["restarts"] for event in restarts] == [1]
    assert_same_state(tmp_path / STATE_FILE, undisturbed)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_rank_that_does_not_see_the_folder_says_so_and_is_not_started_for_ever(cluster: None, tmp_path: Path) -> None:
    def hide() -> None:
        assert eventually(lambda: any(tmp_path.glob(".ray-*/shared")))
        next(tmp_path.glob(".ray-*/shared")).unlink()  # as on a machine that has another folder of this name

    thread = threading.Thread(target=hide)
    thread.start()
    with capture_logs() as events, pytest.raises(ConfigError, match=r"rank 0 on .* does not see this folder"):
        train_on_ray(small_run(steps=1), tmp_path)
    thread.join()
    assert [event["restarts"] for event in events if event["event"] == "ranks_restarted"] in ([], [1])
    assert not list(tmp_path.glob(".ray-*"))


@pytest.mark.slow
def test_room_actors_give_the_rooms_of_inline_rendering_in_order_though_one_is_killed(cluster: None) -> None:
    config = convert_config(POOL, RoomPoolConfig, "test config")
    seeds = range(8)
    inline = InlineFeed(iter(seeds), config)
    feed = ActorFeed(iter(range(100)), config, 2)
    rooms = [feed.next() for _ in range(2)]
    processes("_RoomActor")[0].send_signal(signal.SIGKILL)
    rooms += [feed.next() for _ in seeds[2:]]
    feed.close()
    for room in rooms:
        expected = inline.next()
        assert isinstance(room, PackedRoom) and isinstance(expected, PackedRoom)
        assert room.seed == expected.seed and room.rgb.flags.writeable
        for name in ("rgb", "depth_m", "channel", "T_world_camera"):
            assert np.array_equal(getattr(room, name), getattr(expected, name)), name


@pytest.mark.slow
def test_a_cluster_that_cannot_hold_all_ranks_and_actors_is_refused(cluster: None, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"3 ranks with 1 room actors each need 6 CPU cores and 0 GPUs, the .* has 4"):
        train_on_ray(small_run(workers=1), tmp_path, ranks=3)
    with pytest.raises(ConfigError, match="need 1 CPU cores and 1 GPUs"):
        train_on_ray(replace(small_run(), device="cuda"), tmp_path)


def test_a_run_in_the_folder_is_not_overwritten(tmp_path: Path) -> None:
    train(small_run(steps=1, images={"fraction": 0.0}), tmp_path)
    with pytest.raises(ConfigError, match="finished here"):
        train_on_ray(small_run(), tmp_path)


def test_a_negative_number_of_room_actors_is_refused() -> None:
    with pytest.raises(ConfigError, match="must not be negative"):
        open_actor_feed(iter(range(3)), RoomPoolConfig(), -1)
