import pytest
import torch

from semantic_mapper.config import SRayConfig
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.checkpoint import Checkpoint, adapt_model, load_checkpoint, save_checkpoint
from semantic_mapper.fields.kinds import KINDS
from semantic_mapper.fields.learned import build_field
from semantic_mapper.labels import ROOMS, make_label_set
from semantic_mapper.training.config import StepConfig
from semantic_mapper.training.finetune import step_on_rays
from semantic_mapper.training.views import view_from_frame
from tests.fields.scene import wall_rays, wall_sources
from tests.fields.tiny_fields import LABELS, POSES, TINY, tiny
from tests.small import tiny_frames

STEP = StepConfig(rays=32, samples_without_depth=4)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_built_from_its_defaults_and_from_plain_data(kind: str):
    assert kind in TINY
    field = build_field(kind, {}, LABELS)
    assert field.kind == kind and field.config == KINDS[kind].config() and field.label_set == LABELS
    rows = dict(field.named_parameters())
    assert bool(field.class_rows) == (kind != "grid") and all(rows[r].shape[0] == len(LABELS) for r in field.class_rows)


def test_unknown_kinds_and_configs_of_others_are_refused():
    with pytest.raises(ConfigError, match=r"no field of kind 'nerf'; there are .*grid.*sray"):
        build_field("nerf", {}, LABELS)
    with pytest.raises(ConfigError, match="'unet' takes a UNetFieldConfig, got a SRayConfig"):
        build_field("unet", SRayConfig(), LABELS)
    with pytest.raises(ConfigError, match="feature_dim"):
        build_field("unet", {"feature_dims": 3}, LABELS)


@pytest.mark.parametrize("name", TINY)
def test_every_kind_goes_through_a_checkpoint_and_to_another_label_set_by_class_name(name: str, tmp_path):
    field = tiny(name)
    save_checkpoint(Checkpoint(field), tmp_path / "w.safetensors")
    loaded = load_checkpoint(tmp_path / "w.safetensors").model
    assert type(loaded) is type(field) and loaded.config == field.config
    for key, tensor in field.state_dict().items():
        half = field.stored_in_half and tensor.dtype == torch.float32
        assert torch.equal(loaded.state_dict()[key], tensor.half().float() if half else tensor)
    adapted = adapt_model(field, make_label_set("other", ["c", "new", "a"]))
    for key in field.class_rows:
        old, new = field.state_dict()[key], adapted.state_dict()[key]
        assert torch.equal(new[0], old[2]) and torch.equal(new[2], old[0]) and new.shape[0] == 3
    rays = wall_rays(POSES[0], step=101)
    assert adapted.render(rays, adapted.encode(wall_sources(POSES))).logits.shape == (len(rays.origin), 3)


@pytest.mark.parametrize("name", ["sray", "sray-paper", "unet"])
@pytest.mark.parametrize("own_view", [True, False])
def test_every_kind_takes_a_training_step(name: str, own_view: bool):
    """Also the U-Net where the query's own image is not among its sources: its dense loss goes on."""
    views = [view_from_frame(f, ROOMS, 48) for f in tiny_frames()]
    field = tiny(name, label_set=ROOMS).train()
    optimiser = torch.optim.Adam(field.parameters(), 1e-3)
    before = {n: p.detach().clone() for n, p in field.named_parameters()}
    loss = step_on_rays(field, views, 2, [1, 2] if own_view else [1, 3], STEP, torch.Generator().manual_seed(0))
    assert loss is not None and torch.isfinite(loss)
    loss.backward()
    optimiser.step()
    moved = [n for n, p in field.named_parameters() if not torch.equal(p, before[n])]
    assert {"classifier.weight", "classifier.bias"} <= set(moved)
    assert all(torch.isfinite(p).all() for p in field.parameters())


@pytest.mark.parametrize("name", TINY)
def test_no_kind_depends_on_how_rays_are_split_into_chunks(name: str):
    field = tiny(name)
    rays = wall_rays(POSES[1], step=3)
    with torch.no_grad():
        encoded = field.encode(wall_sources(POSES))
        whole = field.render(rays, encoded)
        names = ("origin", "direction", "near_m", "far_m", "prior_depth_m")
        parts = [
            field.render(type(rays)(*(getattr(rays, n)[i : i + 128] for n in names)), encoded).logits
            for i in range(0, len(rays.origin), 128)
        ]
    torch.testing.assert_close(torch.cat(parts), whole.logits, atol=1e-5, rtol=1e-4)
