import pytest
import torch

from tests.fields.scene import pose_at, wall_rays, wall_sources
from tests.fields.tiny_fields import AWAY, POSES, assert_gradients_are_right, assert_unknown, tiny


def test_rays_of_a_source_camera_render_to_what_its_image_is_classified_as():
    field = tiny("unet")
    views = wall_sources(POSES)
    rays = wall_rays(POSES[1])
    with torch.no_grad():
        render = field.render(rays, field.encode(views))
        expected = field.predict_image(views)[1].flatten(1).T
    assert render.known.all()
    torch.testing.assert_close(render.logits, expected, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("query", [pose_at(0.05), pose_at(0.1, 0.2), AWAY])
def test_a_query_whose_own_image_is_not_there_is_unknown(query):
    """Also where a camera stood at the same place but looked elsewhere: (0.1, 0) turned by 0.2 is no source."""
    field = tiny("unet")
    with torch.no_grad():
        render = field.render(wall_rays(query, step=10), field.encode(wall_sources(POSES)))
    assert render.known.float().mean() <= 0.05  # a turned camera shares the pixels of its turning axis
    if query is AWAY:
        assert_unknown(render)


def test_the_whole_field_passes_gradcheck():
    assert_gradients_are_right(tiny("unet"))
