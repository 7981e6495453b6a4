"""What runs in processes that are to be killed, or whose memory is measured.

They are forked from a server that has loaded the heavy packages, but nothing of ours that starts threads: those do not
survive a fork, so each child starts its own.
"""

from __future__ import annotations

import itertools
import multiprocessing
import resource
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import cv2  # noqa: F401  (loaded once, before the fork)
import msgspec  # noqa: F401
import torch  # noqa: F401

from semantic_mapper.mapping.open3d_loader import load_open3d

load_open3d()


def start_child(function: Callable[..., None], *arguments: Any) -> tuple[BaseProcess, Connection]:
    """A process that runs ``function(*arguments, link)``, and this end of a pipe to it."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    ours, theirs = context.Pipe()
    process = context.Process(target=function, args=(*arguments, theirs), daemon=True)
    process.start()
    theirs.close()
    return process, ours


def map_and_save(out: Path, link: Connection) -> None:
    """Walk along a wall with blocks on disk, while another thread saves again and again."""
    from tests.mapping.test_paging import MEMORY_MB, small_map, walk

    voxel_map = small_map(voxel_size_m=0.01, memory_mb=MEMORY_MB)
    walk(voxel_map, 2)

    def save() -> None:
        while True:
            voxel_map.save(out)
            link.send(voxel_map.stored_blocks)

    threading.Thread(target=save, daemon=True).start()
    for station in itertools.count(2):
        walk(voxel_map, 1, first=station)


def measure_memory(source: Path, out: Path, memory_mb: int, link: Connection) -> None:
    """Load a map and save it elsewhere; send by how many bytes the process grew at most, and its blocks on disk."""
    from semantic_mapper.mapping.voxel_map import VoxelMap

    VoxelMap.load(source.with_name("small.npz")).save(out)  # what is made once, such as compiled code
    status = Path("/proc/self/status").read_text(encoding="ascii")
    before = 1024 * int(status.split("VmRSS:")[1].split()[0])
    loaded = VoxelMap.load(source, memory_mb)
    loaded.save(out)
    link.send((1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before, loaded.stored_blocks))


def save_where_files_stay_small(source: Path, out: Path, limit: int, link: Connection) -> None:
    """Save where a file cannot grow past ``limit`` bytes; send what the error says."""
    from semantic_mapper.errors import MapError
    from semantic_mapper.mapping.voxel_map import VoxelMap

    voxel_map = VoxelMap.load(source)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    try:
        voxel_map.save(out)
    except MapError as error:
        link.send(str(error))
