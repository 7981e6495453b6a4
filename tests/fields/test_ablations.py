import pytest
import torch

from semantic_mapper.config import SRayConfig
from semantic_mapper.fields.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from semantic_mapper.fields.registry import build_field
from semantic_mapper.fields.sray import SRay
from tests.fields.scene import pose_at, wall_rays, wall_sources
from tests.fields.tiny_fields import LABELS, POSES, TINY, assert_gradients_are_right, tiny

SWITCHES = {
    "sray-none": (False, False),
    "sray-intra": (True, False),
    "sray-cross": (False, True),
    "sray-paper": (True, True),
}


@pytest.mark.parametrize("name", list(SWITCHES))
def test_a_name_sets_the_attention_switches_and_nothing_else(name: str):
    config = build_field(name, {"tau": 0.1}, LABELS).config
    assert (config.intra_view_attention, config.cross_view_attention) == SWITCHES[name]
    switches = ("tokens", "intra_view_attention", "cross_view_attention", "tau")
    rest = {f for f in SRayConfig.__struct_fields__ if f not in switches}
    assert all(getattr(config, f) == getattr(SRayConfig(), f) for f in rest)
    assert config.tau == 0.1 and config.tokens == "samples"


def test_the_switches_of_a_name_win_over_those_of_a_config():
    contrary = SRayConfig(intra_view_attention=True, cross_view_attention=True)
    assert not build_field("sray-none", contrary, LABELS).config.cross_view_attention


@pytest.mark.parametrize("name", list(SWITCHES))
def test_each_ablation_uses_the_attention_that_it_is_named_after(name: str):
    field = tiny(name).train()
    assert isinstance(field, SRay)
    encoded = field.encode(wall_sources(POSES))
    field.render(wall_rays(pose_at(0.0), step=31), encoded).logits.sum().backward()
    used = tuple(
        layer.qkv.weight.grad is not None and bool(layer.qkv.weight.grad.abs().max() > 0)
        for layer in (field.radial, field.cross)
    )
    assert used == SWITCHES[name]


@pytest.mark.parametrize("name", list(SWITCHES))
def test_an_ablation_is_saved_as_s_ray_with_its_switches_and_loads_to_the_same_answers(name: str, tmp_path):
    field = tiny(name)
    save_checkpoint(Checkpoint(field), tmp_path / "w.safetensors")
    loaded = load_checkpoint(tmp_path / "w.safetensors").model
    assert loaded.kind == "sray" and loaded.config == field.config
    rays = wall_rays(pose_at(0.0), step=31)
    with torch.no_grad():
        a = field.render(rays, field.encode(wall_sources(POSES))).logits
        b = loaded.render(rays, loaded.encode(wall_sources(POSES))).logits
    assert torch.equal(a, b)


def test_the_ablations_differ_from_each_other_at_the_same_weights():
    whole = tiny("sray-paper")
    rays = wall_rays(pose_at(0.0), step=31)
    seen: list[torch.Tensor] = []
    for name in SWITCHES:
        field = build_field(name, TINY[name], LABELS).eval()
        field.load_state_dict(whole.state_dict())
        with torch.no_grad():
            seen.append(field.render(rays, field.encode(wall_sources(POSES))).logits)
    assert all((seen[i] - seen[j]).abs().max() > 1e-4 for i in range(4) for j in range(i))


@pytest.mark.slow
@pytest.mark.parametrize("name", list(SWITCHES))
def test_the_whole_field_passes_gradcheck(name: str):
    assert_gradients_are_right(tiny(name))
