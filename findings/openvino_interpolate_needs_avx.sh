#!/bin/sh
# Guess: a patch release of OpenVINO runs, on every processor, what the one before ran; its CPU plugin asks for SSE4.2.
# Found: on a processor without AVX 2026.4.1 refuses to compile an Interpolate of float32 ("bad combination"), be it
#        "nearest" or "linear_onnx"; 2026.4.0 runs both, "nearest" with the right values. The same numbers by DepthToSpace
#        of four copies compile with both.
# Seen:  openvino 2026.4.1 and 2026.4.0, Python 3.11, Linux x86-64, with ONEDNN_MAX_CPU_ISA=SSE41 as the stand-in for
#        Celeron, Pentium and Atom boards without AVX.
# Who:   users who run a segmentation network, which as a rule upsamples, on such a robot's board.
# What to do: upsample by whole factors with DepthToSpace.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cat > "$work/try.py" <<'PY'
import sys

import numpy as np
import openvino as ov
from openvino import opset13 as ops

SIZE = [1, 16, 24, 32]


def interpolate(mode):
    return lambda x: ops.interpolate(
        x, np.array([2.0, 2.0], np.float32), mode, "scales", axes=np.array([2, 3]),
        coordinate_transformation_mode="asymmetric", nearest_mode="floor",
    )


def depth_to_space(x):
    return ops.depth_to_space(ops.concat([x] * 4, 1), "blocks_first", 2)


def run(upsample):
    x = ops.parameter(SIZE, np.float32)
    given = np.random.default_rng(0).random(SIZE, np.float32)
    try:
        exact = {"INFERENCE_PRECISION_HINT": "f32"}
        request = ov.Core().compile_model(ov.Model([upsample(x)], [x], "m"), "CPU", exact).create_infer_request()
    except RuntimeError as error:
        return str(error).strip().splitlines()[-1]
    request.infer([given])
    right = np.repeat(np.repeat(given, 2, 2), 2, 3)
    return "right" if np.array_equal(request.output_tensors[0].data, right) else "other values"


found = {name: run(up) for name, up in {
    "nearest": interpolate("nearest"), "linear_onnx": interpolate("linear_onnx"), "depth to space": depth_to_space,
}.items()}
print(*sys.argv[1:], found)
refused = sys.argv[1:] == ["2026.4.1", "SSE41"]
expected = ("bad combination", "bad combination") if refused else ("right", "other values")
sys.exit(tuple(found.values()) != (*expected, "right"))
PY
for version in 2026.4.0 2026.4.1; do
    python3 -m venv "$work/$version"
    "$work/$version/bin/pip" install -q "openvino==$version" numpy==2.4.6
    ONEDNN_MAX_CPU_ISA=SSE41 "$work/$version/bin/python" "$work/try.py" "$version" SSE41
    "$work/$version/bin/python" "$work/try.py" "$version" all
done
