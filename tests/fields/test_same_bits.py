from __future__ import annotations

import subprocess
import sys

import pytest

RENDER = """
import hashlib
from semantic_mapper.config import SamplingConfig
from semantic_mapper.fields.checkpoint import default_checkpoint_path, load_checkpoint
from semantic_mapper.fields.render import render_image
from semantic_mapper.fields.sray_streaming import StreamingSRay
from semantic_mapper.training.views import stack_sources, view_from_frame
from tests.small import tiny_frames

frames = tiny_frames(4)
sampling = SamplingConfig(guided=4, sample_weight_threshold=0.02)
field = StreamingSRay(load_checkpoint(default_checkpoint_path()).model, sampling)
sources = field.encode(stack_sources([view_from_frame(frame, field.label_set, 96) for frame in frames[:3]]))
asked = frames[3]
seen = render_image(field, sources, asked.intrinsics, asked.T_world_camera, asked.depth_m, field.sampling, 0)
for name in ("logits", "depth_m", "rgb", "opacity"):
    value = getattr(seen, name).numpy()
    print(name, value.std() > 0, hashlib.sha256(value.tobytes()).hexdigest())
"""


@pytest.mark.slow
def test_two_processes_render_the_same_bits() -> None:
    """Maps and tests are compared to the bit."""
    said: list[list[str]] = []
    for _ in range(2):
        done = subprocess.run([sys.executable, "-c", RENDER], capture_output=True, text=True, timeout=900)
        assert done.returncode == 0, done.stderr
        said.append(done.stdout.splitlines()[-4:])  # after the log
    assert [line.split()[1] for line in said[0]] == ["True"] * 4, said[0]
    assert said[0] == said[1]
