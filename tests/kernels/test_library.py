"""The compiled library and the sources and declarations that belong to it."""

from __future__ import annotations

import ctypes
import importlib
import importlib.util
import pkgutil
import re
from pathlib import Path
from types import ModuleType

import semantic_mapper
from semantic_mapper.kernels import binding

ROOT = Path(__file__).resolve().parents[2]
SOURCES = ROOT / "semantic_mapper" / "kernels" / "src"
ONLY_TESTED = {"count_visits", "sum_arguments"}


def load_setup() -> ModuleType:
    spec = importlib.util.spec_from_file_location("project_setup", ROOT / "setup.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_library_was_compiled_from_these_sources() -> None:
    expected = load_setup().source_digest()
    compiled = (ctypes.c_char * len(expected)).in_dll(binding.load_library(), "source_digest").value.decode()
    assert compiled == expected, "the kernels were compiled from other sources: run `make setup`"


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
