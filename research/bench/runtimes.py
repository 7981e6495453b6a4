"""The encoder by OpenVINO and by ONNX Runtime, in float32 and in 8 bits: how fast, how far off, and what classes say.

uv pip install onnx onnxruntime
python -m research.bench.runtimes kitchen.mcap room.mcap

All run one network, exported as ONNX. 8 bits are of static quantization (a scale a channel of weights), calibrated on
even frames of the logs, of which odd ones are scored. Runtimes take turns at each frame; times are medians.
"""

# Both packages are installed for this alone.
# pyright: reportMissingImports=false, reportArgumentType=false, reportOptionalCall=false
import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import chdir
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
import openvino as ov
import torch
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
from onnxruntime.quantization.shape_inference import quant_pre_process
from torch import nn

from semantic_mapper import Mapper, open_log
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.fields import numbers
from semantic_mapper.fields.inference import EncodedImage
from semantic_mapper.fields.sray import SRay
from semantic_mapper.fields.streaming import StreamingSRay
from semantic_mapper.kernels.binding import thread_count
from semantic_mapper.types import Float32, UInt8

NAMES = "seen", "depth", "spread", "focal"
Inputs = dict[str, Float32]
Run = Callable[[Inputs], tuple[Float32, Float32]]


class _Exported(nn.Module):
    """Of an S-Ray what ``ImageNetwork`` runs for a view with measured depth."""

    def __init__(self, model: SRay) -> None:
        super().__init__()
        self._net, self._geometry = model.encoder.depth_net, model.geometry_init

    def forward(self, seen: torch.Tensor, depth: torch.Tensor, spread: torch.Tensor, focal: torch.Tensor) -> Any:
        feature = self._net(seen)
        return feature.permute(0, 2, 3, 1), self._geometry(feature, depth[:, 0], focal, spread[:, 0]).permute(
            0, 2, 3, 1
        )


class _Network:
    """In place of an ``ImageNetwork``; what it was given goes to ``seen``."""

    def __init__(self, size: tuple[int, int], run: Run, seen: list[Inputs] | None = None) -> None:
        self.size, self._run, self._seen = size, run, seen

    def encode(self, rgb: UInt8, maps: Float32, depth_m: Float32, spread: Float32, focal: float) -> EncodedImage:
        colours = rgb.transpose(2, 0, 1).astype(np.float32) / 255
        mean, deviation = (np.reshape(v, (-1, 1, 1)) for v in (numbers.COLOUR_MEAN, numbers.COLOUR_DEVIATION))
        seen = np.concatenate(((colours - mean) / deviation, maps)).astype(np.float32)[None]
        inputs = dict(
            zip(NAMES, (seen, depth_m[None, None], spread[None, None], np.array([focal], np.float32)), strict=True)
        )
        if self._seen is not None:
            self._seen.append(inputs)
        feature, geometry = self._run(inputs)
        small = torch.nn.functional.adaptive_avg_pool2d(torch.from_numpy(colours), self.size)
        given = feature[0], geometry[0], small.permute(1, 2, 0).numpy(), np.empty(0, np.float32)
        return EncodedImage(*map(np.ascontiguousarray, given))


class _Frames(CalibrationDataReader):
    def __init__(self, inputs: list[Inputs]) -> None:
        self._rest: Iterator[Inputs] = iter(inputs)

    def get_next(self) -> Any:
        return next(self._rest, None)


def torch_run(model: SRay) -> Run:
    """Run the model itself."""
    exported = _Exported(model).eval()

    def run(inputs: Inputs) -> tuple[Float32, Float32]:
        with torch.inference_mode():
            feature, geometry = exported(*(torch.from_numpy(inputs[name]) for name in NAMES))
        return feature.numpy(), geometry.numpy()

    return run


def openvino_run(path: Path) -> Run:
    """Run a file by OpenVINO."""
    threads = {"INFERENCE_NUM_THREADS": thread_count(), "PERFORMANCE_HINT": "LATENCY"}
    request = ov.Core().compile_model(path, "CPU", threads | {"INFERENCE_PRECISION_HINT": "f32"}).create_infer_request()

    def run(inputs: Inputs) -> tuple[Float32, Float32]:
        request.infer(inputs, share_inputs=True)
        return request.output_tensors[0].data.copy(), request.output_tensors[1].data.copy()

    return run


def onnxruntime_run(path: Path) -> Run:
    """Run a file by ONNX Runtime."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = thread_count()
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # beside others, as in a mapper
    session = ort.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    return lambda inputs: session.run(None, inputs)  # pyright: ignore[reportReturnType]


def step_through(log: str, network: _Network, numbers_of_frames: range) -> float:
    """mIoU of the rendered labels of these frames of a log, encoded by a network."""
    mapper = Mapper.load()
    mapper.pipeline.domain_check = None  # it looks at what only the own network gives
    field = mapper.pipeline.field
    assert isinstance(field, StreamingSRay)
    field._networks = {(2 * network.size[0], 2 * network.size[1], True): network}  # pyright: ignore
    confusion = ConfusionMatrix(mapper.label_set)
    with open_log(log) as reader:
        channels = mapper.label_set.channel_map_from(reader.info.label_set or mapper.label_set)
        for number, frame in enumerate(reader):
            if number in numbers_of_frames:
                update = mapper.step(frame)
                if frame.label is not None:
                    truth = mapper.label_set.to_ids(channels[frame.label])
                    confusion.update(truth, update.label, f"frame {number}")
    return confusion.metrics().miou or 0.0


def main() -> None:
    """Read the command line, convert, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="+", help="labelled logs with depth, 640x480")
    parser.add_argument("--frames", type=int, default=40, help="of each log, that are scored")
    parser.add_argument("--calibration", type=int, default=16, help="frames of each log for the scales of 8 bits")
    options = parser.parse_args()
    model = Mapper.load().model.eval()
    assert isinstance(model, SRay)
    size = (60, 80)  # of features: half of the encoded image, 160 x 120
    with tempfile.TemporaryDirectory() as folder:
        exact, prepared, eight = (Path(folder) / f"{name}.onnx" for name in ("exact", "prepared", "eight"))
        own = torch_run(model)
        inputs: list[Inputs] = []
        tested: dict[str, range] = {}
        with torch.inference_mode():
            for log in options.logs:
                with open_log(log) as reader:
                    count = len(reader)
                apart = [max(1, count // frames // 2) * 2 for frames in (options.calibration, options.frames)]
                step_through(log, _Network(size, own, inputs), range(0, count, apart[0]))
                tested[log] = range(1, count, apart[1])
            example = tuple(torch.from_numpy(inputs[0][name]) for name in NAMES)
            torch.onnx.export(_Exported(model).eval(), example, exact, input_names=list(NAMES), dynamo=False)
        with chdir(folder):  # where it leaves files of its own
            quant_pre_process(exact, prepared, skip_symbolic_shape=True)
        kinds = {"activation_type": QuantType.QUInt8, "weight_type": QuantType.QInt8, "per_channel": True}
        quantize_static(prepared, eight, _Frames(inputs), quant_format=QuantFormat.QDQ, **kinds)
        runs = {
            "OpenVINO float32": openvino_run(exact),
            "ONNX Runtime float32": onnxruntime_run(exact),
            "OpenVINO 8 bits": openvino_run(eight),
            "ONNX Runtime 8 bits": onnxruntime_run(eight),
        }
        taken: dict[str, list[float]] = {name: [] for name in runs}
        for number, given in enumerate(inputs * 3):
            names = list(runs)[number % len(runs) :] + list(runs)[: number % len(runs)]
            for name in names:
                began = time.perf_counter()
                runs[name](given)
                taken[name].append(1e3 * (time.perf_counter() - began))
        print(
            "| runtime | ms a frame | off, % of the features' deviation |",
            *(f"mIoU {Path(log).stem} |" for log in tested),
        )
        for name, run in runs.items():
            off = [np.abs(run(given)[0] - own(given)[0]).mean() / own(given)[0].std() for given in inputs[::4]]
            scores = [f"{100 * step_through(log, _Network(size, run), frames):.1f} |" for log, frames in tested.items()]
            print(f"| {name} | {np.median(taken[name]):.1f} | {100 * np.mean(off):.3f} |", *scores, flush=True)


if __name__ == "__main__":
    main()
