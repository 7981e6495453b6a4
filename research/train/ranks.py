"""Training on several processes, one a GPU, as ``torchrun`` starts them; a single process is the case of one rank."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import distributed

from semantic_mapper.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Ranks:
    """Which of how many processes this one is; ``local`` counts those of this machine."""

    rank: int = 0
    world: int = 1
    local: int = 0

    @property
    def first(self) -> bool:
        """The one that writes files and shows progress."""
        return self.rank == 0

    def largest(self, *values: float) -> tuple[float, ...]:
        """Of each value the largest that any rank has, so that all ranks decide alike."""
        if self.world == 1:
            return values
        shared = torch.tensor(values, dtype=torch.float64)
        distributed.all_reduce(shared, distributed.ReduceOp.MAX)
        return tuple(shared.tolist())

    def total(self, tensor: torch.Tensor) -> torch.Tensor:
        """Sum over all ranks of a tensor in host memory."""
        if self.world > 1:
            tensor = tensor.clone()
            distributed.all_reduce(tensor)
        return tensor


def ranks_from_environment() -> Ranks:
    """As ``torchrun`` says in its environment variables; one rank without it.

    Raises ConfigError: variables that are no numbers.
    """
    try:
        rank, world, local = (int(os.environ.get(name, default)) for name, default in _VARIABLES.items())
    except ValueError as error:
        raise ConfigError(f"{', '.join(_VARIABLES)} must be whole numbers ({error}); start with torchrun") from error
    return Ranks(rank, world, local)


_VARIABLES = {"RANK": "0", "WORLD_SIZE": "1", "LOCAL_RANK": "0"}


def backend_for(device_type: str) -> str:
    """Of a process group: gloo for tensors in host memory, NCCL for those on a GPU."""
    return "cpu:gloo,cuda:nccl" if device_type == "cuda" else "gloo"


@contextmanager
def joined(ranks: Ranks, device: torch.device) -> Iterator[None]:
    """Connected with the other ranks while inside; a group that a launcher (Ray Train) has made is used, and kept."""
    if ranks.world == 1 or distributed.is_initialized():
        yield
        return
    distributed.init_process_group(backend_for(device.type))
    try:
        yield
    finally:
        distributed.destroy_process_group()
