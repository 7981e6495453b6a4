"""The compiled library and the sources and declarations that belong to it."""

import importlib
import pkgutil
import re
import shutil
from pathlib import Path

import pytest

import semantic_mapper
from semantic_mapper.errors import DependencyError
from semantic_mapper.kernels import binding

ROOT = Path(__file__).resolve().parents[2]
SOURCES = ROOT / "semantic_mapper" / "kernels" / "src"
ONLY_TESTED = {"count_visits", "sum_arguments"}


def test_a_library_of_other_sources_is_refused(tmp_path: Path) -> None:
    shutil.copytree(binding.LIBRARY_FOLDER, tmp_path / "lib")
    shutil.copytree(SOURCES, tmp_path / "src")
    binding.load_library(tmp_path / "lib")
    binding.load_library.cache_clear()
    with (tmp_path / "src" / "surface.c").open("a") as changed:
        changed.write("\n")
    with pytest.raises(DependencyError, match="compiled from other sources"):
        binding.load_library(tmp_path / "lib")


def declarations() -> dict[str, list[binding.Kernel]]:
    """All kernels that the package declares, by the names of their C functions."""
    found: dict[str, list[binding.Kernel]] = {}
    for module in pkgutil.walk_packages(semantic_mapper.__path__, "semantic_mapper."):
        if module.name == "semantic_mapper.testing":  # a plugin of pytest, which wants to load it itself
            continue
        for value in vars(importlib.import_module(module.name)).values():
            kernel = value._kernel if isinstance(value, binding.ParallelKernel) else value
            if isinstance(kernel, binding.Kernel) and kernel.__module__ == module.name:
                found.setdefault(kernel.name, []).append(kernel)
    return found


def test_each_c_function_has_one_declaration_that_fits_it() -> None:
    declared = declarations()
    defined = re.findall(r"^KERNEL\((\w+),", "\n".join(p.read_text() for p in SOURCES.glob("*.c")), re.MULTILINE)
    assert len(set(defined)) == len(defined)
    assert set(declared) == set(defined) - ONLY_TESTED
    for kernels in declared.values():
        for kernel in kernels:
            assert kernel.function  # the sizes of both structs are compared
