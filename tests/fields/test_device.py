import numpy as np
import pytest
import torch

from semantic_mapper.config import MapperConfig, SamplingConfig, convert_config
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.base import WorkingView
from semantic_mapper.fields.checkpoint import Checkpoint, load_checkpoint, streaming
from semantic_mapper.fields.device import DeviceField
from semantic_mapper.fields.render import View, render_sparse_view, render_view
from semantic_mapper.fields.weights import default_checkpoint_path
from semantic_mapper.mapper import make_field
from tests.small import tiny_field, tiny_frames

SAMPLING = SamplingConfig(guided=4, sample_weight_threshold=0.02)
DEVICES = [
    "cpu",
    pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU on this machine")),
]


def rendered(field, fraction: float | None = None):
    frames = tiny_frames(6)
    query = frames[5]
    views = [WorkingView(f.rgb, f.depth_m, f.intrinsics, f.T_world_camera) for f in frames[:4]]
    sources = field.stack([field.encode(view) for view in views])
    scene = (field, sources, query.intrinsics, query.T_world_camera, query.depth_m, SAMPLING, 0)
    if fraction is None:
        return render_view(View(*scene))
    return render_sparse_view(View(*scene), query.rgb, fraction)[:3]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("fraction", [None, 0.3])
def test_a_device_renders_what_the_field_itself_renders(device: str, fraction: float | None):
    model = tiny_field()
    model.sampling = SAMPLING
    expected = rendered(streaming(model), fraction)
    found = rendered(DeviceField(model, torch.device(device), SAMPLING), fraction)
    for mine, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(mine, theirs, atol=2e-5 if device == "cpu" else 2e-3)


@pytest.mark.parametrize("device", DEVICES)
def test_bfloat16_rounds_what_classes_hang_on_a_little_and_geometry_hardly(device: str):
    model = load_checkpoint(default_checkpoint_path()).model
    before = {name: value.clone() for name, value in model.state_dict().items()}
    p, known, depth = rendered(DeviceField(model, torch.device(device), SAMPLING))
    q, known_q, depth_q = rendered(DeviceField(model, torch.device(device), SAMPLING, bfloat16=True))
    assert np.array_equal(known, known_q) and not np.array_equal(p, q)
    assert np.abs(p - q).mean() < 2e-3
    assert (p.argmax(2) != q.argmax(2))[known].mean() < 0.02
    assert np.median(np.abs(depth - depth_q)[known]) < 2e-3
    for name, value in model.state_dict().items():
        torch.testing.assert_close(value, before[name], rtol=0, atol=0)


def test_settings_of_a_gpu_where_there_is_none():
    config = convert_config({"render": {"device": "cuda", "bfloat16": True}}, MapperConfig, "test")
    if torch.cuda.is_available():
        assert isinstance(make_field(Checkpoint(tiny_field()).weights, config), DeviceField)
    else:
        with pytest.raises(ConfigError, match="no GPU: torch sees 0"):
            make_field(Checkpoint(tiny_field()).weights, config)
    with pytest.raises(ConfigError, match="bfloat16 is for device"):
        convert_config({"render": {"bfloat16": True}}, MapperConfig, "test")
