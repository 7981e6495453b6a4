"""S-Ray's networks over images, run by OpenVINO: the same answer as ``SRay.encode``, without torch.

Each view is encoded by itself, so a network is built once for a size of image, from the tensors of a weights file.
"""

# OpenVINO leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
from collections.abc import Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import openvino as ov
from numpy.typing import NDArray
from openvino import opset13 as ops

from semantic_mapper.config import SRayConfig
from semantic_mapper.fields import numbers
from semantic_mapper.geometry import expect_shape
from semantic_mapper.kernels.binding import thread_count
from semantic_mapper.types import Float32, UInt8

Array = NDArray[Any]
Node = ov.Node


class EncodedImage(NamedTuple):
    """What the networks say of one image (H, W)."""

    feature: Float32  # (h, w, C) the F_j of S-Ray Eq. 5; h = H / 2 and w = W / 2, rounded up
    geometry: Float32  # (h, w, 5) mixture of logistics along each view ray
    rgb: Float32  # (h, w, 3) in [0, 1]
    picture: Float32  # (D,) mean of the coarsest features of the frozen backbone; (0,) without a backbone


class ImageNetwork:
    """The networks of one S-Ray, compiled for images of one size (H, W).

    ``with_depth``: the one for views with measured depth, else the one that sees colours alone. The result depends on
    the number of threads and the kind of processor in its last digits."""

    def __init__(
        self, tensors: Mapping[str, Array], config: SRayConfig, size: tuple[int, int], *, with_depth: bool
    ) -> None:
        self.size = (size[0] + 1) // 2, (size[1] + 1) // 2
        self._with_depth = with_depth
        model = _Builder(tensors, config).build(size, self.size, with_depth=with_depth)
        self._request = compile_request(model)

    def encode(self, rgb: UInt8, maps: Float32 | None, depth_m: Float32, spread: Float32, focal: float) -> EncodedImage:
        """Encode an image (H, W, 3).

        ``maps`` (5, H, W) as of ``surface_maps``; None for the network that sees none. ``depth_m`` (h, w) as it was
        measured, 0 = none, and its ``spread`` as a fraction of it, 0 = measured; ``focal`` in image widths."""
        inputs = [rgb[None], depth_m[None, None], spread[None, None], np.array([focal], np.float32)]
        self._request.infer([*inputs, *([] if maps is None else [maps[None]])], share_inputs=True)
        return EncodedImage(*(output.data[0].copy() for output in self._request.output_tensors))


def check_networks(tensors: Mapping[str, Array], config: SRayConfig) -> None:
    """Raises KeyError: a tensor is missing; its name. ShapeError: one is of another shape than the config asks for."""
    for with_depth in (False, True)[: 1 + config.encoder.depth]:
        _Builder(tensors, config).build((64, 64), (32, 32), with_depth=with_depth)


def compile_request(model: ov.Model) -> Any:
    """A request of a network for the CPU, in float32, with as many threads as kernels have."""
    threads = {"INFERENCE_NUM_THREADS": thread_count(), "ENABLE_CPU_PINNING": False}
    exact = {"INFERENCE_PRECISION_HINT": "f32", "PERFORMANCE_HINT": "LATENCY"}
    return core().compile_model(model, "CPU", threads | exact).create_infer_request()


@cache
def core() -> ov.Core:
    """One for the process: a core gives the thread that first compiles a stack for signals, and takes it back when it
    is deleted; deleted by another thread, it leaves the first one a stack that is gone, on which the next signal ends
    the process."""
    return ov.Core()


class _Builder:
    """Builds the graph; its names are those of the modules of ``encoder`` and ``sray``, whose tensors it takes."""

    def __init__(self, tensors: Mapping[str, Array], config: SRayConfig) -> None:
        self._tensors = tensors
        self._config = config

    def build(self, size: tuple[int, int], low: tuple[int, int], *, with_depth: bool) -> ov.Model:
        """The graph from the inputs of ``ImageNetwork.encode`` to its outputs."""
        (height, width), (h, w) = size, low
        rgb = ops.parameter([1, height, width, 3], np.uint8, "rgb")
        depth, spread = (ops.parameter([1, 1, h, w], np.float32, name) for name in ("depth", "spread"))
        focal = ops.parameter([1], np.float32, "focal")
        inputs = [rgb, depth, spread, focal]
        colours = ops.transpose(ops.convert(rgb, np.float32), [0, 3, 1, 2])
        seen = (colours - _f(255 * numbers.COLOUR_MEAN)) * _f(1 / (255 * numbers.COLOUR_DEVIATION))
        if with_depth:
            inputs.append(maps := ops.parameter([1, numbers.SURFACE_CHANNELS, height, width], np.float32, "maps"))
            seen = ops.concat([seen, maps], 1)
        photo = (colours * _f(1 / 255) - _f(numbers.BACKBONE_MEAN)) * _f(1 / numbers.BACKBONE_DEVIATION)
        net = "encoder.depth_net" if with_depth else "encoder.colour_net"
        feature, picture = self._unet(net, seen, photo, size)
        geometry = self._geometry(feature, depth, spread, focal)
        small = ops.adaptive_avg_pool(colours * _f(1 / 255), np.array([h, w]))
        feature, geometry, small = (ops.transpose(each, [0, 2, 3, 1]) for each in (feature, geometry, small))
        model: Any = ov.Model  # whose type is not that of what it makes
        return model([feature, geometry, small, picture], inputs, "sray")

    def _unet(self, name: str, seen: Node, photo: Node, size: tuple[int, int]) -> tuple[Node, Node]:
        """Features (1, C, h, w), and the mean of the backbone's coarsest (1, D)."""
        config = self._config.encoder
        blocks, pretrained = config.blocks, config.backbone != "residual"
        count = len(config.channels)
        skips: list[Node] = []
        picture: Node = ops.constant(np.zeros((1, 0), np.float32))
        if pretrained:
            maps = self._backbone(f"{name}.backbone", photo, size, count)
            skips = [self._conv(f"{name}.laterals.{i}", each, config.channels[i], 1) for i, each in enumerate(maps)]
            picture = ops.reduce_mean(maps[-1], [2, 3])
        x = ops.relu(self._conv(f"{name}.stem", seen, config.channels[0], 5, stride=2))
        for i in range(count - pretrained):
            for k in range(max(1, blocks[i])):
                x = self._residual(f"{name}.stages.{i}.{k}", x, config.channels[i], 2 if i > 0 and k == 0 else 1)
            if pretrained:
                skips[i] = skips[i] + x
            else:
                skips.append(x)
        refine = blocks if pretrained else [int(i > 0) for i in range(count)]
        x = skips.pop()
        for up, i in enumerate(reversed(range(count - 1))):
            x = self._up(f"{name}.ups.{up}", x, skips.pop(), refine[i])
        return self._conv(f"{name}.head", x, self._config.feature_dim, 3), picture

    def _backbone(self, name: str, photo: Node, size: tuple[int, int], stages: int) -> list[Node]:
        """Feature maps at strides 2, 4, ..., the finest first; see ``EfficientNetLite0``."""
        x, size = self._strided(f"{name}.stem", photo, size, numbers.BACKBONE_STAGES[0][0][0], 3)
        x = ops.clamp(x, 0.0, 6.0)
        maps: list[Node] = []
        for i, stage in enumerate(numbers.BACKBONE_STAGES[:stages]):
            for k, (c_in, c_out, kernel, stride, expansion) in enumerate(stage):
                block, y, inner = f"{name}.stages.{i}.{k}", x, c_in * expansion
                if expansion > 1:
                    y = ops.clamp(self._normed(f"{block}.expand", y, inner, 1), 0.0, 6.0)
                if stride == 2:
                    y, size = self._strided(f"{block}.depthwise", y, size, inner, kernel, groups=inner)
                else:
                    y = self._normed(f"{block}.depthwise", y, inner, kernel, groups=inner)
                y = self._normed(f"{block}.project", ops.clamp(y, 0.0, 6.0), c_out, 1)
                x = x + y if stride == 1 and c_in == c_out else y
            maps.append(x)
        return maps

    def _geometry(self, feature: Node, depth: Node, spread: Node, focal: Node) -> Node:
        """The mixture (1, 5, h, w); see ``GeometryInit``."""
        measured = ops.greater(depth, _f(0))
        near = ops.maximum(depth, _f(numbers.NEAR_M))
        inverse = ops.select(measured, _f(1) / near, _f(0))
        x = ops.concat([feature, inverse, ops.convert(measured, np.float32)], 1)
        x = ops.relu(self._conv("geometry_init.net.0", x, 16, 3))
        raw = self._conv("geometry_init.net.2", x, numbers.GEOMETRY_CHANNELS + 1, 3)
        shift, widen, behind, widen_behind, fraction, guess = (
            ops.slice(raw, [i], [i + 1], [1], [1]) for i in range(numbers.GEOMETRY_CHANNELS + 1)
        )
        predicted = _f(1) / (
            _f(1 / numbers.FAR_M) + _f(1 / numbers.NEAR_M - 1 / numbers.FAR_M) * ops.sigmoid(guess - _f(2.0))
        )
        if self._config.tokens == "surface":
            predicted = predicted * (focal * _f(1 / numbers.COMMON_FOCAL))
        mu_1 = ops.select(measured, depth * (_f(1) + _f(numbers.MEASURED_SHIFT) * ops.tanh(shift)), predicted)
        start = ops.maximum(ops.select(measured, _f(numbers.MEASURED_SCALE), _f(numbers.PREDICTED_SCALE)), spread)
        s_1 = mu_1 * start * ops.exp(ops.clamp(widen, -3.0, 3.0))
        mu_2 = mu_1 * (_f(1.02) + ops.softplus(behind))
        s_2 = mu_2 * _f(numbers.PREDICTED_SCALE) * ops.exp(ops.clamp(widen_behind, -3.0, 3.0))
        return ops.concat([mu_1, s_1, mu_2, s_2, ops.sigmoid(fraction + _f(3.0))], 1)

    def _residual(self, name: str, x: Node, out: int, stride: int) -> Node:
        y = ops.relu(self._normed(f"{name}.conv1", x, out, 3, stride=stride, norm=f"{name}.norm1"))
        y = self._normed(f"{name}.conv2", y, out, 3, norm=f"{name}.norm2")
        if stride > 1:
            x = ops.avg_pool(x, [stride] * 2, [0, 0], [0, 0], [stride] * 2, True, "ceil")
        if stride > 1 or _channels(x) != out:
            x = self._conv(f"{name}.shortcut", x, out, 1)
        return ops.relu(y + x)

    def _up(self, name: str, x: Node, skip: Node, refine: int) -> Node:
        _, out, height, width = skip.get_output_shape(0)
        x = self._conv(f"{name}.reduce", x, out, 1)
        # Each value four times: `interpolate` of OpenVINO 2026.4.1 runs on no processor without AVX.
        x = ops.depth_to_space(ops.concat([x] * 4, 1), "blocks_first", 2)
        x = ops.slice(x, [0, 0], [height, width], [1, 1], [2, 3]) + skip
        for i in range(refine):
            x = self._residual(f"{name}.refine" if refine == 1 else f"{name}.refine.{i}", x, out, 1)
        return x

    def _strided(
        self, name: str, x: Node, size: tuple[int, int], out: int, kernel: int, *, groups: int = 1
    ) -> tuple[Node, tuple[int, int]]:
        """Of stride 2, padded as TensorFlow's "SAME" pads; see ``StridedConvolution``."""
        pads = [kernel - 2 + side % 2 for side in size]
        begin, end = [p // 2 for p in pads], [p - p // 2 for p in pads]
        x = self._normed(name, x, out, kernel, stride=2, pads=(begin, end), groups=groups)
        return x, ((size[0] + 1) // 2, (size[1] + 1) // 2)

    def _normed(
        self, name: str, x: Node, out: int, kernel: int, *, norm: str = "", groups: int = 1, **options: Any
    ) -> Node:
        """A convolution with the batch norm after it folded in."""
        epsilon = numbers.TORCH_NORM_EPSILON if norm else numbers.NORM_EPSILON  # of residual blocks; of the backbone
        norm = norm or f"{name}_norm"
        gamma, beta, mean, var = (
            self._tensor(f"{norm}.{n}", out).astype(np.float64)
            for n in ("weight", "bias", "running_mean", "running_var")
        )
        scale = gamma / np.sqrt(var + epsilon)
        weight = self._tensor(f"{name}.weight", out, _channels(x) // groups, kernel, kernel)
        return self._convolve(x, weight * scale[:, None, None, None], beta - mean * scale, groups=groups, **options)

    def _conv(self, name: str, x: Node, out: int, kernel: int, *, stride: int = 1) -> Node:
        weight = self._tensor(f"{name}.weight", out, _channels(x), kernel, kernel)
        return self._convolve(x, weight, self._tensor(f"{name}.bias", out), stride=stride)

    def _tensor(self, name: str, *shape: int) -> Array:
        expect_shape(self._tensors[name], " ".join(map(str, shape)), f"'{name}'")
        return self._tensors[name]

    def _convolve(
        self,
        x: Node,
        weight: Array,
        bias: Array,
        *,
        stride: int = 1,
        pads: tuple[list[int], list[int]] | None = None,
        groups: int = 1,
    ) -> Node:
        shape = [stride] * 2, *(pads or ([weight.shape[-1] // 2] * 2,) * 2), [1, 1]
        if groups == 1:
            y = ops.convolution(x, _f(weight), *shape)
        else:
            y = ops.group_convolution(x, _f(weight.reshape(groups, -1, *weight.shape[1:])), *shape)
        return y + _f(bias.reshape(1, -1, 1, 1))


def _channels(x: Node) -> int:
    return list(x.get_output_shape(0))[1]


def _f(value: float | Array) -> Node:
    return ops.constant(np.asarray(value, np.float32))
