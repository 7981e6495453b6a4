import numpy as np
import pytest
import torch

from research.tests.train.small_run import POOL
from research.train import rooms
from research.train.rooms import PackedRoom, RoomPool, RoomPoolConfig, RoomViews, pack_room, render_room
from semantic_mapper.config import convert_config
from semantic_mapper.errors import ConfigError, SemanticMapperError

CONFIG = convert_config(POOL, RoomPoolConfig, "test config")


def seeds_drawn(pool: RoomPool, draws: int, start: int = 0) -> list[tuple[int, tuple[int, ...]]]:
    """Seed of each drawn room and those of the pool at that time; each draw has a generator of its own."""
    drawn = []
    for number in range(start, start + draws):
        room = pool.draw(torch.Generator().manual_seed(number))
        drawn.append((room.seed, pool.seeds))
    return drawn


def test_the_pool_after_n_draws_follows_from_its_seed_and_n():
    with RoomPool(CONFIG, 5) as whole:
        drawn = seeds_drawn(whole, 9)
    with RoomPool(CONFIG, 5, draws=6) as later:
        assert seeds_drawn(later, 3, start=6) == drawn[6:]
    assert drawn[0][1] == (5, 6) and drawn[-1][1] == (8, 9, 10)


@pytest.mark.slow
def test_workers_give_the_very_rooms_that_inline_rendering_gives():
    def collect(workers: int) -> list[RoomViews]:
        with RoomPool(CONFIG, 0, workers=workers) as pool:
            return [pool.draw(torch.Generator().manual_seed(k)) for k in range(4)]

    for inline, rendered in zip(collect(0), collect(2), strict=True):
        assert inline.seed == rendered.seed
        for a, b in zip(inline.views, rendered.views, strict=True):
            assert torch.equal(a.rgb, b.rgb) and torch.equal(a.depth_m, b.depth_m) and torch.equal(a.channel, b.channel)


def test_ranks_that_share_the_seeds_see_different_rooms():
    seen = []
    for rank in range(2):
        with RoomPool(CONFIG, rank, stride=2) as pool:
            seen.append({seed for _, seeds in seeds_drawn(pool, 4) for seed in seeds})
    assert seen[0] == {0, 2, 4} and seen[1] == {1, 3, 5}


def test_a_room_that_cannot_be_made_leaves_its_place_empty(monkeypatch: pytest.MonkeyPatch):
    plain = rooms.room_frames

    def room_frames(seed: int, *arguments: object, **more: object):
        if seed % 2:
            raise SemanticMapperError("too full")
        return plain(seed, *arguments, **more)

    monkeypatch.setattr(rooms, "room_frames", room_frames)
    with RoomPool(CONFIG, 0) as pool:
        assert [seeds for _, seeds in seeds_drawn(pool, 6)][1::2] == [(0,), (0, 2), (2,)]
    with pytest.raises(ConfigError, match="room 1: too full"):
        render_room(1, CONFIG)
    monkeypatch.setattr(rooms, "TRAIN_SEEDS", range(1, 2))
    with RoomPool(CONFIG, 0) as pool, pytest.raises(ConfigError, match="none of 2 rooms could be made"):
        seeds_drawn(pool, 1)


def test_a_packed_room_holds_the_views_without_loss():
    packed = pack_room(3, CONFIG)
    assert isinstance(packed, PackedRoom)
    room = render_room(3, CONFIG)
    assert packed.rgb.dtype == np.uint8 and packed.channel.dtype == np.int8 and room.labelled == tuple(range(5))
    assert room.resident is room.views
    view = room.views[2]
    assert torch.equal((view.rgb * 255).round().to(torch.uint8), torch.from_numpy(packed.rgb[2]))
    assert view.rgb.shape == (3, 36, 48) and view.rgb.max() <= 1 and view.channel.dtype == torch.int64
