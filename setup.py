"""Builds the C kernels into the package with Zig's C compiler, a wheel of the package index; see pyproject.toml.

SEMANTIC_MAPPER_TARGET names another machine to build a wheel for: ``x86_64`` or ``aarch64``.
"""

from __future__ import annotations

import os
import platform
import runpy
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from setuptools import Distribution, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py

ROOT = Path(__file__).resolve().parent
SOURCES = ROOT / "semantic_mapper" / "kernels" / "src"
source_digest = runpy.run_path(str(SOURCES.parent / "digest.py"))["source_digest"]
GLIBC = "2.28"  # the oldest that the library runs on
# Name of each library, and the processor it is compiled for. The best one that the processor can run is loaded.
VARIANTS = {
    "x86_64": {"kernels-x86_64-avx2": "x86_64+avx2+fma", "kernels-x86_64": "x86_64"},
    "aarch64": {"kernels-aarch64": "generic"},
}
FLAGS = ["-std=c11", "-O3", "-fno-math-errno", "-ffp-contract=off", "-fPIC", "-shared", "-g0", "-Wall", "-Wextra"]


def target_machine() -> str:
    """Machine to compile for: this one, unless the environment names another."""
    machine = os.environ.get("SEMANTIC_MAPPER_TARGET") or platform.machine()
    if machine not in VARIANTS or sys.platform != "linux":
        known = " and ".join(VARIANTS)
        raise SystemExit(f"kernels can be built on Linux for {known}, not for {machine} {sys.platform}")
    return machine


def build_kernels(folder: Path, machine: str, sources: Path = SOURCES, headers: tuple[Path, ...] = ()) -> list[Path]:
    """Compile all C of a folder into one shared library a variant; returns the libraries in ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    built: list[Path] = []
    with tempfile.TemporaryDirectory() as cache:  # also where the home folder cannot be written to
        environment = {**os.environ, "ZIG_GLOBAL_CACHE_DIR": cache, "ZIG_LOCAL_CACHE_DIR": cache}
        for name, processor in VARIANTS[machine].items():
            library = folder / f"{name}.so"
            partial = Path(cache) / library.name
            command = [sys.executable, "-m", "ziglang", "cc", f"--target={machine}-linux-gnu.{GLIBC}"]
            command += [f"-mcpu={processor}", *FLAGS, f'-DSOURCE_DIGEST="{source_digest(sources)}"', "-o", str(partial)]
            command += [*(f"-I{path}" for path in headers), *map(str, sorted(sources.glob("*.c"))), "-lm"]
            subprocess.run(command, env=environment, check=True)
            beside = library.with_suffix(".new")
            beside.write_bytes(partial.read_bytes())
            beside.replace(library)  # a process that has loaded the old one keeps it
            built.append(library)
    return built


class BuildWithKernels(build_py):
    """Adds the libraries to what is built, or puts them into the checkout for an editable install."""

    def run(self) -> None:
        if not self.editable_mode:  # what an earlier build left: modules that are gone, libraries of another machine
            shutil.rmtree(self.build_lib, ignore_errors=True)
        super().run()
        root = ROOT if self.editable_mode else Path(self.build_lib)
        build_kernels(root / "semantic_mapper" / "kernels" / "lib", target_machine())


class PlatformDistribution(Distribution):
    """A distribution with compiled code, which setuptools cannot see: a wheel holds it where it belongs."""

    def has_ext_modules(self) -> bool:
        return True


class PlatformWheel(bdist_wheel):
    """A wheel for one machine and any Python 3."""

    def get_tag(self) -> tuple[str, str, str]:
        return "py3", "none", f"manylinux_{GLIBC.replace('.', '_')}_{target_machine()}"


if __name__ == "__main__":
    commands = {"build_py": BuildWithKernels, "bdist_wheel": PlatformWheel}
    setup(distclass=PlatformDistribution, cmdclass=commands)
