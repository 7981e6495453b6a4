import pytest
import torch

from research.peers.semantic_nerf import SemanticNeRF, config_for_scene
from research.tests.peers.tiny_peers import tiny_peer
from semantic_mapper.fields.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from semantic_mapper.fields.scene.grid import encode_frequencies, encoded_size
from semantic_mapper.fields.volume import sample_guided
from semantic_mapper.training.losses import ray_loss
from semantic_mapper.training.views import RayTargets
from semantic_mapper.types import RayBatch
from tests.fields.scene import WALL_M, pose_at, wall_rays, wall_sources
from tests.fields.tiny_fields import POSES, assert_gradients_are_right, assert_unknown


def semantic_nerf() -> SemanticNeRF:
    field = tiny_peer("semantic_nerf")
    assert isinstance(field, SemanticNeRF)
    return field


def fit(field: SemanticNeRF, steps: int, with_depth: bool = True) -> None:
    """Fit to the wall's colour and depth, and to class 2 where x > 0, class 1 elsewhere."""
    sources = wall_sources(POSES, with_depth=with_depth)
    encoded = field.encode(sources)
    views = [wall_rays(pose, step=17, prior=WALL_M * with_depth) for pose in POSES]
    names = ("origin", "direction", "near_m", "far_m", "prior_depth_m")
    rays = RayBatch(*(torch.cat([getattr(v, n) for v in views]) for n in names))
    x = (rays.origin + (WALL_M / rays.direction[:, 2:]) * rays.direction)[:, 0]
    rgb = sources.rgb.flatten(2)[:, :, ::17].permute(0, 2, 1).reshape(-1, 3)
    targets = RayTargets(torch.where(x > 0, 2, 1), rgb, WALL_M / rays.direction[:, 2])
    z = sample_guided(rays, field.sampling)
    optimiser = torch.optim.Adam(field.parameters(), 5e-3)
    field.train()
    for _ in range(steps):
        render, _ = field.render_samples(rays, z, encoded)
        optimiser.zero_grad()
        ray_loss(render, targets, (0.25, 0.75, 1.0)).total.backward()
        optimiser.step()
    field.eval()


def test_nothing_is_known_before_it_is_fitted():
    field = semantic_nerf()
    encoded = field.encode(wall_sources(POSES))
    assert_unknown(field.render(wall_rays(pose_at(0.0), step=31), encoded))


def test_a_fitted_field_knows_every_ray_of_its_scene_from_poses_it_never_saw():
    field = semantic_nerf()
    fit(field, 60)
    encoded = field.encode(wall_sources(POSES[:1]))
    rays = wall_rays(pose_at(0.2))
    render = field.render(rays, encoded)
    x = (rays.origin + (WALL_M / rays.direction[:, 2:]) * rays.direction)[:, 0]
    clear = x.abs() > 0.15
    assert render.known.all()
    assert (render.logits.argmax(1) == torch.where(x > 0, 2, 1))[clear].float().mean() > 0.95


def test_rays_that_stay_outside_the_box_are_unknown_even_when_fitted():
    field = semantic_nerf()
    fit(field, 1)
    far = pose_at(50.0)
    assert_unknown(field.render(wall_rays(far, step=31), field.encode(wall_sources(POSES))))


def test_being_fitted_travels_with_the_weights(tmp_path):
    field = semantic_nerf()
    fit(field, 2, with_depth=False)
    save_checkpoint(Checkpoint(field), tmp_path / "w.safetensors", half=True)
    loaded = load_checkpoint(tmp_path / "w.safetensors").model
    assert isinstance(loaded, SemanticNeRF) and int(loaded.fitted_steps) == 2
    assert loaded.render(wall_rays(pose_at(0.0), step=31), loaded.encode(wall_sources(POSES))).known.all()


@pytest.mark.parametrize("views", [1, 2, 7, 16])
@pytest.mark.parametrize("mode", ["streaming", "reference"])
def test_any_number_of_views_from_1_to_16_renders(views: int, mode: str):
    field = semantic_nerf().train()
    field.sampling = type(field.sampling)(mode=mode, coarse=8, fine=8)  # type: ignore[arg-type]
    encoded = field.encode(wall_sources([pose_at(0.02 * i) for i in range(views)]))
    render = field.render(wall_rays(pose_at(0.0), step=101), encoded)
    assert all(torch.isfinite(t).all() for t in (render.logits, render.depth_m, render.rgb, render.entropy))


def test_the_box_of_a_scene_holds_what_its_views_see():
    config = config_for_scene(wall_sources(POSES), far_m=5.0, margin_m=0.1)
    x, y, z = config.centre_m
    reach = config.half_extent_m
    assert abs(y) < 0.1 and z - reach < 0 and z + reach > WALL_M  # cameras at z = 0 and the wall
    rays = wall_rays(POSES[3])
    hit = rays.origin + (WALL_M / rays.direction[:, 2:]) * rays.direction
    assert ((hit - torch.tensor([x, y, z])).abs() <= reach).all()
    without = config_for_scene(wall_sources(POSES, with_depth=False), far_m=5.0)
    assert without.half_extent_m > reach


def test_frequency_encoding_holds_the_position_and_both_phases_of_every_octave():
    x = torch.tensor([[0.25, -0.5]])
    code = encode_frequencies(x, 2)
    assert code.shape == (1, encoded_size(2, 2))
    pi = torch.pi
    expected = [0.25, -0.5, *torch.sin(torch.tensor([0.25 * pi, -0.5 * pi, 0.5 * pi, -pi])).tolist()]
    expected += torch.cos(torch.tensor([0.25 * pi, -0.5 * pi, 0.5 * pi, -pi])).tolist()
    torch.testing.assert_close(code[0], torch.tensor(expected))


def test_the_whole_field_passes_gradcheck():
    assert_gradients_are_right(semantic_nerf())
