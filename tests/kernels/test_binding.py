"""Arguments on their way to C, and what is said of those that do not fit."""

import platform
import struct
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from semantic_mapper.errors import DependencyError, ShapeError
from semantic_mapper.kernels import binding, kernel
from semantic_mapper.types import Bool, Float32, Int64


class Weights(NamedTuple):
    factor: float
    used: Bool


@kernel
def _sum_arguments(values: Int64, weights: Weights, negate: bool, bias: int, other: NDArray[Any]) -> int: ...


@kernel
def count_visits(visits: Int64) -> None: ...


VALUES = np.arange(12).reshape(3, 4)  # columns 1 and 3 add up to 15 and 21
WEIGHTS = Weights(0.5, np.array([False, True, False, True]))
BYTES, FLOATS = np.zeros(3, np.uint8), np.zeros((2, 2, 2, 2), np.float32)


def test_numbers_arrays_and_named_tuples_arrive_in_c() -> None:
    assert _sum_arguments(VALUES, WEIGHTS, False, 0, BYTES) == 18 + 1
    assert _sum_arguments(VALUES, WEIGHTS, True, 100, FLOATS) == -18 + 100 + 4
    assert _sum_arguments(VALUES[:0], WEIGHTS, False, -7, BYTES) == -7 + 1
    assert _sum_arguments(VALUES, WEIGHTS._replace(factor=np.float32(2)), np.bool_(0), np.int32(5), BYTES) == 72 + 5 + 1


def test_a_kernel_that_returns_nothing_returns_none_and_writes_into_the_array() -> None:
    visits = np.zeros(3, np.int64)
    assert count_visits(visits) is None  # its range is empty
    count_visits.function(1, 3, count_visits.pack(visits))
    assert visits.tolist() == [0, 1, 1]


@pytest.mark.parametrize(
    ("values", "match"),
    [
        (VALUES.astype(np.int32), "argument values: expected an array of int64, got int32"),
        (VALUES.astype(">i8"), "argument values: expected an array of int64, got >i8"),
        (VALUES.tolist(), "argument values: expected an array of int64, got <class 'list'>"),
        (VALUES[:, ::2], r"argument values: expected a contiguous array .* got shape \(3, 2\)"),
        (VALUES.T, "contiguous"),
        (VALUES[None, None, None], "at most 4 dimensions"),
    ],
)
def test_arrays_that_do_not_fit_are_named(values: Any, match: str) -> None:
    with pytest.raises(ShapeError, match=f"kernel sum_arguments, {match}" if match.startswith("argument") else match):
        _sum_arguments(values, WEIGHTS, False, 0, BYTES)


def test_a_kernel_that_the_library_has_not_or_has_otherwise_is_named() -> None:
    def sum_arguments(values: Int64, other: Float32) -> int: ...
    def no_such_kernel() -> int: ...

    sum_arguments.__annotations__ = {"values": Int64, "other": Float32, "return": int}
    with pytest.raises(DependencyError, match=r"no kernel sum_arguments that takes 96 bytes .*`make setup`"):
        kernel(sum_arguments)(VALUES, np.zeros(1, np.float32))
    with pytest.raises(DependencyError, match=r"no kernel no_such_kernel .*`make setup`"):
        kernel(no_such_kernel)()


def test_a_library_that_is_missing_or_of_another_machine_is_named(tmp_path: Path) -> None:
    with pytest.raises(DependencyError, match=f"no compiled kernels for .* in {tmp_path}.*make setup"):
        binding.load_library(tmp_path)
    library = tmp_path / f"kernels-{platform.machine()}.so"
    header = b"\x7fELF\x02\x01\x01" + bytes(9) + struct.pack("<HH", 3, 8)  # a 64-bit shared object for MIPS
    library.write_bytes(header.ljust(64, b"\0"))
    with pytest.raises(DependencyError, match=f"cannot load the compiled kernels {library}"):
        binding.load_library(tmp_path)
