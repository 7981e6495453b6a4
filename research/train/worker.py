"""What a process that renders rooms does. Imports nothing heavy: thread counts must be set before torch is loaded."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from multiprocessing.connection import wait
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from research.train.rooms import PackedRoom, RoomPoolConfig


def prepare_worker() -> None:
    """One thread of computation, deaf to signals that stop a whole group (the parent ends it), gone with the parent."""
    for stop in (signal.SIGINT, signal.SIGTERM):
        signal.signal(stop, signal.SIG_IGN)
    os.environ["OMP_NUM_THREADS"] = "1"
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()
    import torch

    torch.set_num_threads(1)


def render(seed: int, config: RoomPoolConfig) -> PackedRoom | str:
    """One room, or why it cannot be made."""
    from research.train.rooms import pack_room

    return pack_room(seed, config)


def _end_with(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)
