"""What maps have the same bits: one log mapped by other runtimes, processors' code, threads and another OpenCV.

uv pip install onnx onnxruntime setuptools ziglang
uv pip install --target runs/cv4 --no-deps 'opencv-contrib-python-headless<5'
python -m research.bench.exact kitchen.mcap --opencv runs/cv4       # frames of 640x480 with depth and labels
"""

# pyright: reportMissingImports=false
import argparse
import itertools
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np

from semantic_mapper import Mapper, open_log
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.fields import numbers
from semantic_mapper.fields.encoder import COLOURS
from semantic_mapper.fields.sray import SRay
from semantic_mapper.fields.streaming import StreamingSRay
from semantic_mapper.kernels import binding
from semantic_mapper.replay.compare import Tolerances, compare_runs, read_run

SIZE = (60, 80)  # of features
VARIANTS: dict[str, dict[str, str]] = {  # name -> environment
    "one thread, best code": {},
    "the same again": {},
    "two threads": {"OMP_NUM_THREADS": "2"},
    "kernels for SSE2": {"ATEN_CPU_CAPABILITY": "default"},
    "kernels for AVX-512": {},
    "OpenVINO for AVX2": {"ONEDNN_MAX_CPU_ISA": "AVX2"},
    "OpenVINO for SSE4.1": {"ONEDNN_MAX_CPU_ISA": "SSE41"},
    "encoder by torch": {},
    "encoder by ONNX Runtime": {},
}


def map_log(variant: str, log: str, frames: int, folder: Path) -> float:
    """Map the first frames in this process, save ``map.npz``, and return mIoU of the rendered labels."""
    if variant == "kernels for AVX-512":
        built = (folder / "lib", "x86_64", binding.LIBRARY_FOLDER.parent / "src")
        code = "import setup; setup.VARIANTS['x86_64'] = {'kernels-x86_64-avx2': 'x86_64_v4'}; setup.build_kernels("
        code += "__import__('pathlib').Path({!r}), {!r}, __import__('pathlib').Path({!r}))".format(*map(str, built))
        subprocess.run([sys.executable, "-c", code], check=True)
        load = binding.load_library
        binding.load_library = lambda _: load(folder / "lib")
    mapper = Mapper.load()
    field, model = mapper.pipeline.field, mapper.model.eval() if variant.startswith("encoder") else None
    if isinstance(field, StreamingSRay) and isinstance(model, SRay):
        import torch

        from research.bench import runtimes

        run = runtimes.torch_run(model)
        if variant == "encoder by ONNX Runtime":
            seen = torch.zeros(1, COLOURS + numbers.SURFACE_CHANNELS, 2 * SIZE[0], 2 * SIZE[1])
            example = (seen, torch.ones(1, 1, *SIZE), torch.zeros(1, 1, *SIZE), torch.ones(1))
            path = folder / "encoder.onnx"
            names = {"input_names": list(runtimes.NAMES), "dynamo": False}
            torch.onnx.export(runtimes._Exported(model).eval(), example, path, **names)
            run = runtimes.onnxruntime_run(path)
        field._networks = {(2 * SIZE[0], 2 * SIZE[1], True): runtimes._Network(SIZE, run)}  # pyright: ignore
        mapper.pipeline.domain_check = None  # looks at what only the own network gives, and changes no map
    confusion = ConfusionMatrix(mapper.label_set)
    with open_log(log) as reader:
        channels = mapper.label_set.channel_map_from(reader.info.label_set or mapper.label_set)
        for frame in itertools.islice(reader, frames):
            update = mapper.step(frame)
            if frame.label is not None:
                confusion.update(mapper.label_set.to_ids(channels[frame.label]), update.label)
    mapper.voxel_map.save(folder / "map.npz")
    return confusion.metrics().miou or 0.0


def differing(first: Path, second: Path) -> str:
    """Which arrays of two map files have other numbers, and how many; one of another length counts whole."""
    counts: Counter[str] = Counter()
    with np.load(first) as a, np.load(second) as b:
        for name in {name for name in (*a.files, *b.files) if "/" in name}:
            one, other = (np.asarray(archive.get(name, ())) for archive in (a, b))
            one, other = (array.view(f"u{array.itemsize}") for array in (one, other))  # bits: NaN is NaN, and 0 not -0
            kind = name.split("/")[1]
            counts[kind] += int((one != other).sum()) if one.shape == other.shape else max(one.size, other.size)
    return ", ".join(f"{count:,} of {name}" for name, count in sorted(counts.items()) if count) or "none: the same bits"


def main() -> None:
    """Read the command line, map with each variant in a process of its own, and print a table against the first."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log")
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--opencv", default="", help="folder that pip has put another OpenCV in")
    parser.add_argument("--only", nargs=2, metavar=("VARIANT", "FOLDER"), help="one, in this process")
    options = parser.parse_args()
    if options.only:
        print(json.dumps(map_log(options.only[0], options.log, options.frames, Path(options.only[1]))))
        return
    print("| variant | numbers of the map that differ | mIoU | surface, p95 | other labels |")
    other = {"the other OpenCV": {"PYTHONPATH": options.opencv}} if options.opencv else {}
    with tempfile.TemporaryDirectory() as temporary:
        first: Path | None = None
        for number, (variant, given) in enumerate({**VARIANTS, **other}.items()):
            folder = Path(temporary) / str(number)
            folder.mkdir()
            environment = {**os.environ, "OMP_NUM_THREADS": "1", **given}
            command = [sys.executable, "-m", "research.bench.exact", options.log, "--frames", str(options.frames)]
            said = subprocess.check_output([*command, "--only", variant, str(folder)], env=environment, text=True)
            first = first or folder
            maps = first / "map.npz", folder / "map.npz"
            compared = compare_runs(read_run(maps[0]), read_run(maps[1]), Tolerances())
            figures = {figure.name: figure.difference or 0.0 for figure in compared.figures}
            row = f"{differing(*maps)} | {100 * json.loads(said.splitlines()[-1]):.2f} %"
            row += f" | {1e3 * figures['surface_m']:.3f} mm | {100 * figures['labels']:.3f} % |"
            print(f"| {variant} | {row}", flush=True)


if __name__ == "__main__":
    main()
