"""What each process of ``test_train_ranks`` runs: a few steps of training, then what it holds into a file."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from safetensors.torch import save_file

from research.tests.train.small_run import small_run
from research.train.rooms import RoomPool
from research.train.train import train
from research.train.train_config import TrainConfig


def two_ranks_run(steps: int = 4) -> TrainConfig:
    """The config of these processes."""
    validation = {"times": 1, "rooms": 2, "queries": 1, "rays": 64, "views": 3}
    one_attention = small_run().field | {"cross_view_attention": False}  # weights that get no gradient
    return small_run(steps=steps, validation=validation, field=one_attention)


def main(folder: Path, config: TrainConfig) -> None:
    seen: list[int] = []
    plain_draw = RoomPool.draw

    def draw(pool: RoomPool, generator):
        room = plain_draw(pool, generator)
        seen.append(room.seed)
        return room

    RoomPool.draw = draw
    checkpoint = train(config, folder)
    rank = os.environ["RANK"]
    score = checkpoint.recipe["validation_miou"]
    about = {"rooms": " ".join(map(str, seen)), "score": str(score), "ranks": str(checkpoint.recipe["ranks"])}
    save_file(
        {n: t.contiguous() for n, t in checkpoint.model.state_dict().items()}, folder / f"rank{rank}.safetensors", about
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), two_ranks_run(*map(int, sys.argv[2:])))
