"""MVSNeRF in a world where colours say nothing: near and far differ by how they move between the views alone."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch.nn import functional

from research.peers import mvsnerf
from research.peers.config import MVSNeRFConfig
from research.peers.mvsnerf import MVSNeRF
from semantic_mapper.config import EncoderConfig
from semantic_mapper.fields.encoder import calibrate
from semantic_mapper.fields.sampling import sample_inverse_depth
from semantic_mapper.geometry import camera_matrix
from semantic_mapper.labels import make_label_set
from semantic_mapper.rays import pixel_grid, pixel_rays
from semantic_mapper.types import CameraIntrinsics, RayBatch, SourceViews
from tests.fields.scene import pose_at

CAMERA = CameraIntrinsics(32.0, 32.0, 19.5, 11.5, 40, 24)
PIXELS = pixel_grid(CAMERA.width, CAMERA.height)
NEAR_M, FAR_M, SAMPLES = 0.8, 6.0, 16
WALLS_M = (1.3, 3.0)  # a near wall with holes (class 0), a far wall behind it (class 1)
SOURCES = [pose_at(-0.3, 0.1), pose_at(0.0), pose_at(0.3, -0.1)]
SEED = 0
QUERY = pose_at(0.1, 0.02)  # in none of the tests a source


class TwoWalls:
    """Both walls wear waves of the same family; waves, holes and hence classes are drawn again in every world."""

    def __init__(self, generator: torch.Generator) -> None:
        def draw(*shape: int) -> torch.Tensor:
            return torch.rand(*shape, generator=generator)

        self.waves = (2 + 4 * draw(2, 3, 2)) * torch.sign(draw(2, 3, 2) - 0.5)
        self.phases = 2 * math.pi * draw(2, 3)
        self.holes = 2 * math.pi * draw(2)

    def look(self, rays: RayBatch) -> tuple[torch.Tensor, torch.Tensor]:
        """Colours (R, 3) and classes (R,) of what rays hit."""
        hits = [
            (rays.origin + ((wall_m - rays.origin[:, 2]) / rays.direction[:, 2])[:, None] * rays.direction)[:, :2]
            for wall_m in WALLS_M
        ]
        colours = [0.5 + 0.45 * torch.sin(hits[i] @ self.waves[i].T + self.phases[i]) for i in (0, 1)]
        far = torch.sin(2.5 * hits[0] + self.holes).sum(-1) < 0
        return torch.where(far[:, None], colours[1], colours[0]), far.long()

    def sources(self) -> SourceViews:
        size = (CAMERA.height, CAMERA.width)
        images = [self.look(rays_from(pose))[0].T.reshape(3, *size) for pose in SOURCES]
        return SourceViews(
            torch.stack(images),
            torch.zeros(len(SOURCES), *size),
            torch.from_numpy(camera_matrix(CAMERA)).float().expand(len(SOURCES), 3, 3).clone(),
            torch.stack([torch.from_numpy(pose).float() for pose in SOURCES]),
        )


UNSEEN = [TwoWalls(torch.Generator().manual_seed(seed)) for seed in range(1000, 1006)]


def rays_from(pose: np.ndarray, pixels: torch.Tensor = PIXELS) -> RayBatch:
    """Rays without a depth prior."""
    return pixel_rays(pixels, CAMERA, torch.from_numpy(pose).float(), near_m=NEAR_M, far_m=FAR_M)


def small_field() -> MVSNeRF:
    torch.manual_seed(SEED)
    shape = MVSNeRFConfig(
        feature_dim=8,
        encoder=EncoderConfig(channels=(8, 16), blocks=(1, 1)),
        planes=16,
        plane_near_m=NEAR_M,
        plane_far_m=FAR_M,
        width=32,
        depth=3,
        position_frequencies=2,
    )
    return MVSNeRF(shape, make_label_set("walls", ["near", "far"]))


def calibrated_field() -> tuple[MVSNeRF, torch.Generator]:
    """A field that has learned nothing, and what worlds to learn from are drawn with."""
    generator = torch.Generator().manual_seed(SEED)
    field = small_field()
    calibrate(field.encoder, TwoWalls(generator).sources())
    return field, generator


def figures(field: MVSNeRF, worlds: list[TwoWalls]) -> tuple[float, float]:
    """Accuracy of the classes, and error of the colours as a fraction of their variance, seen from ``QUERY``."""
    right: list[float] = []
    unexplained: list[float] = []
    for world in worlds:
        rays = rays_from(QUERY)
        with torch.no_grad():
            encoded = field.eval().encode(world.sources())
            z = sample_inverse_depth(rays.near_m, rays.far_m, SAMPLES)
            render, _ = field.render_samples(rays, z, encoded)
        colours, classes = world.look(rays)
        right.append(float((render.logits.argmax(1) == classes).float().mean()))
        unexplained.append(float(((render.rgb - colours) ** 2).mean() / colours.var(0).mean()))
    return float(np.mean(right)), float(np.mean(unexplained))


def train(field: MVSNeRF, steps: int, generator: torch.Generator) -> None:
    """One view of one new world a step."""
    optimiser = torch.optim.AdamW(field.train().parameters(), 3e-3)
    for _ in range(steps):
        world = TwoWalls(generator)
        x = float(torch.rand(1, generator=generator)) * 0.6 - 0.3
        rays = rays_from(pose_at(x, -x / 3), PIXELS[torch.randint(len(PIXELS), (192,), generator=generator)])
        z = sample_inverse_depth(rays.near_m, rays.far_m, SAMPLES, generator)
        render, _ = field.render_samples(rays, z, field.encode(world.sources()))
        colours, classes = world.look(rays)
        loss = functional.cross_entropy(render.logits, classes) + 3 * ((render.rgb - colours) ** 2).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()


@pytest.mark.slow
def test_it_learns_to_tell_near_from_far_in_worlds_that_it_has_never_seen():
    """No depth anywhere, and no colour or place has a class: what tells is where the views agree."""
    field, generator = calibrated_field()
    accuracy, unexplained = figures(field, UNSEEN)
    assert accuracy < 0.65 and unexplained > 0.9
    train(field, 350, generator)
    accuracy, unexplained = figures(field, UNSEEN)
    assert accuracy > 0.75 and unexplained < 0.6


@pytest.mark.slow
def test_the_volume_tells_at_the_depth_of_the_sample(monkeypatch: pytest.MonkeyPatch):
    """Colours of the views at a sample tell near from far, too, so here it does without them."""
    fill = mvsnerf.colours_and_masks
    monkeypatch.setattr(
        mvsnerf, "colours_and_masks", lambda rgb, valid, views: fill(torch.zeros_like(rgb), valid, views)
    )
    field, generator = calibrated_field()
    for _ in range(8):
        train(field, 200, generator)
        if figures(field, UNSEEN)[0] > 0.75:
            break
    assert figures(field, UNSEEN)[0] > 0.75
    volume = field.encoding_volume
    monkeypatch.setattr(field, "encoding_volume", lambda *given: volume(*given).roll(field.config.planes // 2, 2))
    assert figures(field, UNSEEN)[0] < 0.65
