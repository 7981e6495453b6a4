"""Build the wheels of all machines here, by cross-compilation, and check what they hold.

python -m tools.wheels --out dist
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import platform
import struct
import subprocess
import sys
import sysconfig
import tempfile
import zipfile
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).resolve().parent.parent
UV = ROOT / ".tools" / "bin" / "uv"
ELF_MACHINES = {62: "x86_64", 183: "aarch64"}  # e_machine in the header
LIBRARIES = "semantic_mapper/kernels/lib/"
# Runs one kernel of the installed package, and says where the package lies.
SMOKE = """
from pathlib import Path
import numpy as np
import semantic_mapper
from semantic_mapper.replay.page import Section, write_page
from semantic_mapper.mapping.blocks import find_blocks, make_block_index, pack_keys
write_page(Path("page.html"), "a page, whose template is in the wheel", [Section()])
keys = np.array([[0, 0, 3], [0, -1, 5]], np.int32)
index = make_block_index(keys, np.array([30, 50], np.int32))
assert find_blocks(index, pack_keys(keys[::-1])).tolist() == [50, 30]
print(semantic_mapper.__file__)
"""


def main() -> None:
    """Build and check; exits with an error where a wheel is not as it should be."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="folder for the wheels")
    arguments = parser.parse_args()
    settings = load_setup()
    for machine, libraries in settings.VARIANTS.items():
        wheel = build_wheel(arguments.out, machine)
        problems = find_problems(wheel, machine, set(libraries), settings.source_digest(settings.SOURCES))
        if not problems and machine == platform.machine():
            problems = try_installed(wheel)
        if problems:
            sys.exit("\n".join(f"{wheel.name}: {problem}" for problem in problems))
        print(f"{wheel}: {len(libraries)} libraries for {machine}, {wheel.stat().st_size / 1e6:.1f} MB")


def load_setup() -> ModuleType:
    """``setup.py``, which knows the machines and the libraries of each."""
    spec = importlib.util.spec_from_file_location("project_setup", ROOT / "setup.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def build_wheel(out: Path, machine: str) -> Path:
    """Build the wheel of one machine into ``out``, in place of what it held of that machine."""
    for old in out.glob(f"semantic_mapper-*_{machine}.whl"):
        old.unlink()
    environment = os.environ | {"SEMANTIC_MAPPER_TARGET": machine}
    subprocess.run(
        [UV, "build", "--quiet", "--wheel", "--python", sys.executable, "--out-dir", out, ROOT],
        env=environment,
        check=True,
    )
    (wheel,) = out.glob(f"semantic_mapper-*_{machine}.whl")
    return wheel


def find_problems(wheel: Path, machine: str, libraries: set[str], digest: str) -> list[str]:
    """What is wrong with a wheel: its tag, its libraries, the machine or the sources that they were compiled for."""
    problems: list[str] = []
    tag = "-".join(wheel.stem.split("-")[2:])
    if not (tag.startswith("py3-none-manylinux_") and tag.endswith(f"_{machine}")):
        problems.append(f"tag {tag} is not that of a manylinux wheel for {machine} and any Python 3")
    with zipfile.ZipFile(wheel) as archive:
        (metadata,) = (name for name in archive.namelist() if name.endswith(".dist-info/WHEEL"))
        if f"Tag: {tag}\n" not in archive.read(metadata).decode().replace("\r\n", "\n"):
            problems.append(f"its metadata do not have tag {tag}")
        shared = [name for name in archive.namelist() if name.endswith(".so")]
        if sorted(shared) != sorted(f"{LIBRARIES}{name}.so" for name in libraries):
            problems.append(f"libraries {sorted(shared)} instead of {sorted(libraries)} in {LIBRARIES}")
        for name in shared:
            content = archive.read(name)
            built_for = elf_machine(content)
            if built_for != machine:
                problems.append(f"{name} is compiled for {built_for}")
            if digest.encode() not in content:
                problems.append(f"{name} is compiled from other sources")
    return problems


def elf_machine(content: bytes) -> str:
    """Processor that an ELF file is compiled for."""
    if content[:6] != b"\x7fELF\x02\x01":
        return "nothing that is known: no 64-bit little-endian ELF file"
    (number,) = struct.unpack_from("<H", content, 18)
    return ELF_MACHINES.get(number, f"ELF machine {number}")


def try_installed(wheel: Path) -> list[str]:
    """Install a wheel of this machine into a fresh virtual environment, and run a kernel there.

    The packages that it needs come from this environment, by PYTHONPATH, where the project's editable install does not
    count.
    """
    with tempfile.TemporaryDirectory() as folder:
        venv = Path(folder, "venv")
        subprocess.run([UV, "venv", "--quiet", "--seed", "--python", sys.executable, venv], check=True)
        python = venv / "bin" / "python"
        pip = [python, "-m", "pip", "--quiet", "--disable-pip-version-check", "install", "--no-deps"]
        subprocess.run([*pip, wheel.resolve()], check=True)
        done = subprocess.run(
            [python, "-P", "-c", SMOKE],
            cwd=folder,
            env=os.environ | {"PYTHONPATH": sysconfig.get_path("purelib")},
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            return [f"a kernel or a page fails where it is installed:\n{done.stderr}"]
        if not Path(done.stdout.strip()).is_relative_to(venv):
            return [f"the installed package was not tried, but {done.stdout.strip()}"]
    return []


if __name__ == "__main__":
    main()
