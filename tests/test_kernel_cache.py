"""Kernels on disk: many processes that compile at once, and callees that change."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import sys
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numba.core.caching import CacheImpl, IndexDataCacheFile

from semantic_mapper import kernel_cache

TYPES = ("int8", "int16", "int32", "int64", "float32", "float64")
SOURCE = """
from semantic_mapper.kernel_cache import kernel

@kernel()
def total_bytes(values):
    total = 0
    for value in values:
        total += values.itemsize
    return total
"""


def _module(folder: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    (folder / "one_kernel.py").write_text(SOURCE)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delitem(sys.modules, "one_kernel", raising=False)
    return importlib.import_module("one_kernel")


def _compile(kernels: ModuleType, dtype: str, barrier: Any) -> None:
    """Compile for one type; all who save do so at the same time, and take longer over it than they would."""
    load_index = IndexDataCacheFile._load_index

    def slow_index(cache: IndexDataCacheFile) -> Any:
        index = load_index(cache)
        time.sleep(0.05)
        return index

    IndexDataCacheFile._load_index = slow_index  # pyright: ignore[reportAttributeAccessIssue]
    barrier.wait()
    right = kernels.total_bytes(np.ones(3, dtype)) == 3 * np.dtype(dtype).itemsize
    os._exit(0 if right else 1)


def test_signatures_that_are_compiled_at_once_do_not_get_each_others_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernels = _module(tmp_path, monkeypatch)
    fork = multiprocessing.get_context("fork")
    barrier = fork.Barrier(len(TYPES))
    workers = [fork.Process(target=_compile, args=(kernels, dtype, barrier)) for dtype in TYPES]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(120)
    assert [worker.exitcode for worker in workers] == [0] * len(TYPES)
    assert len(list(tmp_path.rglob("*.nbc"))) == len(TYPES)
    for dtype in TYPES:
        assert kernels.total_bytes(np.ones(3, dtype)) == 3 * np.dtype(dtype).itemsize
    assert kernels.total_bytes.stats.cache_hits == dict.fromkeys(kernels.total_bytes.signatures, 1)


def test_code_is_compiled_anew_after_a_change_in_any_kernels_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "package"
    package.mkdir()
    (package / "callee.py").write_text("@kernel()\ndef f(x): return x\n")
    (package / "no_kernels.py").write_text("x = 1\n")
    monkeypatch.setattr(kernel_cache, "_PACKAGE", package)

    def hits() -> int:
        kernel_cache.kernels_stamp.cache_clear()
        kernels = _module(tmp_path, monkeypatch)
        kernels.total_bytes(np.ones(3))
        return sum(kernels.total_bytes.stats.cache_hits.values())

    try:
        assert [hits(), hits()] == [0, 1]
        (package / "no_kernels.py").write_text("x = 2\n")
        assert hits() == 1
        (package / "callee.py").write_text("@kernel()\ndef f(x): return -x\n")
        assert [hits(), hits()] == [0, 1]
    finally:
        kernel_cache.kernels_stamp.cache_clear()


def test_kernels_run_where_no_folder_can_keep_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(CacheImpl, "_locator_classes", [])  # a read-only installation and a read-only home
    kernels = _module(tmp_path, monkeypatch)
    assert kernels.total_bytes(np.ones(3, np.float32)) == 12
    assert not list(tmp_path.rglob("*.nbc"))
    said = capsys.readouterr()
    assert "NUMBA_CACHE_DIR" in said.out + said.err
