import msgspec
import torch

from research.train.appearance import strew, vary_appearance
from research.train.images import ImageStepConfig
from research.train.rooms import RoomPoolConfig, draw_images, render_room
from research.train.view_draws import cropped_view
from semantic_mapper.training.views import query_rays
from semantic_mapper.types import SourceViews
from tests.fields.scene import pose_at, wall_sources

VIEWS = wall_sources([pose_at(0.1 * i) for i in range(4)])


def labels(views: SourceViews) -> torch.Tensor:
    channel = torch.zeros(views.depth_m.shape, dtype=torch.int64)
    channel[:, :, : channel.shape[2] // 2] = 3
    return channel


def varied(fraction: float, seed: int = 0) -> SourceViews:
    return vary_appearance(VIEWS, labels(VIEWS), fraction, torch.Generator().manual_seed(seed))


def test_colours_change_and_stay_colours():
    views = varied(1.0)
    assert views.K is VIEWS.K and views.T_world_camera is VIEWS.T_world_camera
    change = (views.rgb - VIEWS.rgb).abs().flatten(1).mean(1)
    assert (change > 0.01).all() and views.rgb.min() >= 0 and views.rgb.max() <= 1
    assert torch.isfinite(views.rgb).all()


def test_the_same_seed_gives_the_same_images_and_another_one_others():
    assert torch.equal(varied(1.0).rgb, varied(1.0).rgb)
    assert not torch.equal(varied(1.0).rgb, varied(1.0, seed=1).rgb)


def test_image_steps_vary_appearance_where_they_are_asked_to():
    room = render_room(10, RoomPoolConfig(width=48, views=3))
    plain = ImageStepConfig(images=2, colour_jitter=0.0, mirrored=0.0)
    drawn = [
        draw_images([room], replace_appearance(plain, a), torch.Generator().manual_seed(3), torch.device("cpu"))
        for a in (0.0, 1.0)
    ]
    assert torch.equal(drawn[0].channel, drawn[1].channel)
    assert not torch.equal(drawn[0].views.rgb, drawn[1].views.rgb)
    left = drawn[1].views.depth_m > 0
    assert torch.equal(drawn[0].views.depth_m[left], drawn[1].views.depth_m[left])


def replace_appearance(config: ImageStepConfig, appearance: float) -> ImageStepConfig:
    return msgspec.structs.replace(config, appearance=appearance)


def test_some_images_lose_a_part_of_their_depth_and_what_is_left_is_as_measured():
    lost = []
    for seed in range(20):
        depth_m = varied(1.0, seed).depth_m
        left = depth_m > 0
        assert torch.equal(depth_m[left], VIEWS.depth_m[left])
        lost += (1 - left.flatten(1).sum(1) / (VIEWS.depth_m > 0).flatten(1).sum(1)).tolist()
    whole = sum(fraction == 0 for fraction in lost)
    assert 3 < whole < 40 and max(lost) > 0.05 and sum(lost) / len(lost) < 0.4


def test_pieces_of_other_pictures_hide_classes_and_come_nearer():
    before = labels(VIEWS)
    views, channel = strew(VIEWS, before, 1.0, torch.Generator().manual_seed(2))
    hidden = channel < 0
    assert hidden.flatten(1).any(1).all() and hidden.float().mean() < 0.5
    assert torch.equal(channel[~hidden], before[~hidden])
    assert torch.equal(views.rgb.permute(0, 2, 3, 1)[~hidden], VIEWS.rgb.permute(0, 2, 3, 1)[~hidden])
    assert torch.equal(views.depth_m[~hidden], VIEWS.depth_m[~hidden])
    assert (views.depth_m <= VIEWS.depth_m).all() and (views.depth_m < VIEWS.depth_m)[hidden].float().mean() > 0.8


def test_what_a_piece_hides_is_not_learned():
    room = render_room(10, RoomPoolConfig(width=48, views=3))
    config = msgspec.structs.replace(ImageStepConfig(), clutter=1.0)
    drawn = draw_images([room], config, torch.Generator().manual_seed(3), torch.device("cpu"))
    assert (drawn.channel < 0).any() and not drawn.depth_m[drawn.channel < 0].any()


def test_a_cropped_view_sees_its_part_as_a_longer_lens_does():
    view = render_room(10, RoomPoolConfig(width=48, views=3)).views[0]
    part = cropped_view(view, 0.5, 1.0, 0.25)
    assert part.rgb.shape == view.rgb.shape and part.channel.dtype == view.channel.dtype
    rays, targets = query_rays(part, torch.arange(part.channel.numel()), near_m=0.1, far_m=9.0, prior=None)
    points = rays.origin + rays.direction * targets.depth_m[:, None]
    back = (points - view.T_world_camera[:3, 3]) @ view.T_world_camera[:3, :3]
    k = view.intrinsics
    u = (back[:, 0] / back[:, 2].clamp_min(1e-6) * k.fx + k.cx).round().long().clamp(0, k.width - 1)
    v = (back[:, 1] / back[:, 2].clamp_min(1e-6) * k.fy + k.cy).round().long().clamp(0, k.height - 1)
    measured = targets.depth_m > 0
    assert measured.float().mean() > 0.3
    assert (view.channel[v, u] == targets.channel)[measured].float().mean() > 0.9
