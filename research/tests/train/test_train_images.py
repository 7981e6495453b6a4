"""Steps on single images, mirrored worlds, and encoders that are taken over."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from torch.nn import functional

from research.peers.kinds import build_field
from research.tests.train.small_run import POOL, small_run
from research.train.images import ImageStepConfig, images_loss
from research.train.recipe import rooms_before
from research.train.rooms import RoomPool, RoomPoolConfig, draw_images, render_room
from research.train.start import take_over_encoder
from research.train.train import IMAGES_FILE, STATE_FILE, WEIGHTS_FILE, train
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.checkpoint import load_checkpoint
from semantic_mapper.labels import ROOMS
from semantic_mapper.rays import invert_pose_torch
from semantic_mapper.training.fit import cosine_rate
from semantic_mapper.training.losses import image_loss
from semantic_mapper.training.views import mirrored_view, query_rays


def load_state_of(folder: Path) -> dict[str, str]:
    with safe_open(folder / STATE_FILE, framework="pt") as stored:
        return dict(stored.metadata() or {})


CPU = torch.device("cpu")
ROOM = render_room(3, RoomPoolConfig(**POOL))


def test_image_loss_is_cross_entropy_and_balance_lifts_the_rare_class():
    torch.manual_seed(0)
    logits = torch.randn(2, 3, 4, 4)
    channel = torch.zeros(2, 4, 4, dtype=torch.int64)
    channel[0, 0, 0] = 1
    channel[1, 3, :] = -1
    plain = functional.cross_entropy(logits, channel, ignore_index=-1)
    torch.testing.assert_close(image_loss(logits, channel, 0.0), plain)
    each = functional.cross_entropy(logits, channel, ignore_index=-1, reduction="none")
    share = torch.tensor([27 / 28, 1 / 28])
    weight = (share + 1e-3) ** -0.5
    by_hand = (weight[0] * each[channel == 0].sum() + weight[1] * each[0, 0, 0]) / 28 / (weight * share).sum()
    torch.testing.assert_close(image_loss(logits, channel, 0.5), by_hand)
    assert image_loss(logits, torch.full_like(channel, -1), 0.5) == 0


def test_a_mirrored_view_shows_the_mirror_image_of_the_same_world():
    view = ROOM.views[0]
    mirror = mirrored_view(view)
    width = view.intrinsics.width
    rays, targets = query_rays(view, torch.tensor([5, 60, 700]), near_m=0.1, far_m=9.0, prior=None)
    flat = torch.tensor([5, 60, 700])
    flipped = flat // width * width + (width - 1 - flat % width)
    theirs, same = query_rays(mirror, flipped, near_m=0.1, far_m=9.0, prior=None)
    turn = torch.tensor([-1.0, 1.0, 1.0])
    torch.testing.assert_close(theirs.origin, rays.origin * turn)
    torch.testing.assert_close(theirs.direction, rays.direction * turn)
    assert torch.equal(same.channel, targets.channel) and torch.equal(same.rgb, targets.rgb)
    assert float(torch.linalg.det(mirror.T_world_camera[:3, :3])) == pytest.approx(1, abs=1e-5)
    identity = invert_pose_torch(mirror.T_world_camera[None])[0] @ mirror.T_world_camera
    torch.testing.assert_close(identity, torch.eye(4), atol=1e-5, rtol=0)


def test_image_batches_repeat_and_withhold_depth_of_whole_images():
    config = ImageStepConfig(rooms=2, images=3, frozen_colours=False, depth_dropout=0.5, mirrored=0.5)
    a, b = (draw_images([ROOM, ROOM], config, torch.Generator().manual_seed(1), CPU) for _ in range(2))
    assert torch.equal(a.views.rgb, b.views.rgb) and torch.equal(a.channel, b.channel)
    assert a.views.rgb.shape[0] == 6 and a.views.channel is None
    without = (a.views.depth_m == 0).flatten(1).all(1)
    assert 0 < int(without.sum()) < 6
    frozen = draw_images([ROOM, ROOM], ImageStepConfig(rooms=2, images=3, depth_dropout=0.5), torch.Generator(), CPU)
    assert frozen.views.depth_m.flatten(1).any(1).all(), "the network for colours rests, so all have depth"


def test_every_kind_with_a_classifier_learns_from_images_and_the_others_say_so():
    config = ImageStepConfig(rooms=1, images=3)
    batch = draw_images([ROOM], config, torch.Generator().manual_seed(1), CPU)
    for kind in ("sray", "unet"):
        torch.manual_seed(0)
        field = build_field(kind, {"encoder": {"channels": [8, 8], "blocks": [1, 1]}}, ROOMS).train()
        optimiser = torch.optim.Adam(field.parameters(), 1e-2)
        losses = []
        for _ in range(12):
            loss = images_loss(field, batch, config).total
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            losses.append(float(loss.detach()))
        assert losses[-1] < 0.7 * losses[0], (kind, losses)
    for kind in ("semantic_nerf",):
        with pytest.raises(ConfigError, match=f"kind '{kind}' does not classify single images"):
            images_loss(build_field(kind, {}, ROOMS), batch, config)


def test_a_run_never_meets_the_rooms_of_the_runs_it_started_from(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    firsts: list[int] = []

    class Pool(RoomPool):
        def __init__(self, config: RoomPoolConfig, first: int, **rest: Any) -> None:
            firsts.append(first)
            super().__init__(config, first, **rest)

    monkeypatch.setattr("research.train.train.RoomPool", Pool)
    seen = [0]
    weights: dict[str, str] = {}
    for name in ("a", "b", "c"):
        run = train(small_run(images={"fraction": 1.0, "rooms": 1}, steps=3, **weights), tmp_path / name)
        seen.append(seen[-1] + run.recipe["rooms"])
        weights = {"encoder_from": str(tmp_path / name / WEIGHTS_FILE)}
    assert [first - firsts[0] for first in firsts] == seen[:-1]


def test_weights_after_the_images_are_kept_and_another_kind_takes_their_encoder_over(tmp_path: Path):
    images = {"fraction": 0.5, "rooms": 1}
    train(small_run(images=images, steps=4), tmp_path / "first")
    kept = load_checkpoint(tmp_path / "first" / IMAGES_FILE).model
    assert kept.kind == "sray" and kept.image_encoder is not None
    still = {
        "images": {"fraction": 0.0},
        "learning_rate": 0.0,
        "final_learning_rate": 0.0,
        "weight_decay": 0.0,
        "steps": 1,
    }
    source = {"encoder_from": str(tmp_path / "first" / IMAGES_FILE)}
    peer = {"kind": "unet", "field": {"feature_dim": 16}}
    shape = {"channels": [8, 16], "blocks": [1, 1], "depth": True}
    trained = train(small_run(**still, **source, **{**peer, "field": {**peer["field"], "encoder": shape}}))
    (origin,) = trained.recipe["origins"]
    assert (origin["file"], origin["recipe"]["kind"], origin["recipe"]["steps"]) == (IMAGES_FILE, "train", 2)
    assert origin["recipe"]["config"]["images"]["fraction"] == 0.5 and len(origin["sha256"]) == 64
    assert rooms_before(trained.recipe["origins"]) == origin["recipe"]["rooms"] > 0
    other = trained.model
    assert other.image_encoder is not None
    mine, theirs = other.image_encoder.state_dict(), kept.image_encoder.state_dict()
    assert all(torch.equal(mine[name], tensor) for name, tensor in theirs.items())
    with pytest.raises(ConfigError, match="another shape"):
        train(small_run(**still, **source, **peer))
    with pytest.raises(ConfigError, match="both sides"):
        take_over_encoder(build_field("semantic_nerf", {}, ROOMS), tmp_path / "first" / IMAGES_FILE)


def refuse(*_: Any, **__: Any) -> None:
    """In the place of what must not be called."""
    pytest.fail("a step of the wrong sort")


@pytest.mark.parametrize("stopped", [False, True])
def test_a_larger_budget_goes_on_with_rays_once_the_images_are_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stopped: bool
):
    how = {"images": {"fraction": 0.5, "rooms": 1}, "log_steps": 1}
    done: list[int] = []
    train(
        small_run(steps=6 if stopped else 4, **how),
        tmp_path,
        on_progress=lambda progress: done.append(progress.step),
        stopped=lambda: len(done) == 4,
    )
    images = 3 if stopped else 2
    state = load_state_of(tmp_path)
    assert (state["past_images"], state["images_steps"]) == ("True", str(images))
    assert state["finished"] == str(not stopped)
    after_images = (tmp_path / IMAGES_FILE).read_bytes()
    monkeypatch.setattr("research.train.train.draw_images", refuse)
    longer = small_run(steps=10, **how)
    train(longer, tmp_path, resume=True)
    lines = [json.loads(line) for line in (tmp_path / "history.jsonl").read_text().splitlines()]
    rates = [line["rate"] for line in lines if "rate" in line]
    assert len(rates) == 10
    for step in range(4, 10):  # along the cosine of a run whose images took as many steps from the first
        used = (step - images) / (10 - images)
        expected = cosine_rate(used, longer.learning_rate, longer.final_learning_rate)
        assert rates[step] == pytest.approx(expected), step
    assert (tmp_path / IMAGES_FILE).read_bytes() == after_images


def test_images_may_go_on_among_the_rays():
    """Steps on images leave alone what only rays teach; with a share of 1 all later steps are on images."""
    start = train(small_run(images={"fraction": 0.0, "later": 1.0}, steps=1)).model.state_dict()
    field = train(small_run(images={"fraction": 0.0, "later": 1.0}, steps=4)).model
    # Weight decay alone moves what has a gradient; what has none rests.
    moved = {name.split(".")[0] for name, t in field.state_dict().items() if not torch.equal(t, start[name])}
    assert "encoder" in moved and "classifier" in moved and not moved & {"density", "weights", "cross", "label_logit"}
    mixed = train(small_run(images={"fraction": 0.0, "later": 0.5}, steps=12)).model.state_dict()
    assert any(not torch.equal(mixed[name], start[name]) for name in mixed if name.startswith("density"))
