"""The kinds that this package adds, and the names for switches of kinds."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from research.peers.kinds import PRESETS, build_field, field_names
from research.tests.peers.tiny_peers import PEERS, tiny_peer
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from semantic_mapper.labels import ROOMS
from semantic_mapper.training.config import StepConfig
from semantic_mapper.training.finetune import step_on_rays
from semantic_mapper.training.views import view_from_frame
from tests.fields.tiny_fields import LABELS, TINY, tiny
from tests.small import tiny_frames


def test_every_preset_sets_its_switches_and_unknown_names_are_refused() -> None:
    for name, (kind, switches) in PRESETS.items():
        field = build_field(name, TINY[kind], LABELS)
        assert field.kind == kind and all(getattr(field.config, key) == value for key, value in switches.items())
    assert set(PEERS) | set(PRESETS) <= set(field_names())
    with pytest.raises(ConfigError, match=r"no field of kind 'nerf'; there are .*grid.*sray-none"):
        build_field("nerf", {}, LABELS)


@pytest.mark.parametrize("name", PEERS)
def test_peers_go_through_a_checkpoint(name: str, tmp_path: Path) -> None:
    field = tiny_peer(name)
    save_checkpoint(Checkpoint(field), tmp_path / "w.safetensors")
    loaded = load_checkpoint(tmp_path / "w.safetensors").model
    assert type(loaded) is type(field) and loaded.config == field.config


def test_a_peer_takes_a_training_step() -> None:
    views = [view_from_frame(f, ROOMS, 48) for f in tiny_frames()]
    field = tiny("semantic_nerf", label_set=ROOMS, config=PEERS["semantic_nerf"]).train()
    step = StepConfig(rays=32, samples_without_depth=4)
    loss = step_on_rays(field, views, 2, [1, 3], step, torch.Generator().manual_seed(0))
    assert loss is not None and torch.isfinite(loss)
    loss.backward()
    assert field.get_parameter("classifier.weight").grad is not None
