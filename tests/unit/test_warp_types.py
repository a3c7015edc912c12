"""mypy's plug-in for Warp: kernels are Warp's to check, everything around them stays mypy's."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from mypy import api

from tests.conftest import REPOSITORY

MODULE = """
import warp as wp
from some_numbers import COUNT

@wp.struct
class Arrays:
    heights: wp.array2d[wp.float32]

@wp.func
def twice(number, arrays: Arrays) -> float:
    return "text" + number

@wp.kernel(module="unique")
def fill(values: wp.array[wp.vec3]):
    values[wp.tid()] = unknown

def launch(number: int) -> str:
    arrays = Arrays()
    arrays.heights = wp.array([[float(COUNT)]], dtype=wp.float32)
    made = wp.zeros(3, dtype=wp.vec3)

    @wp.kernel
    def inner(values):
        return values + "text"

    wp.launch(fill, dim=made.shape, inputs=[made])
    wp.launch(inner, dim=1, inputs=[twice.key, fill.no_such])  # attr-defined
    arrays.heights = 5  # assignment
    return number  # return-value
"""


def test_a_fault_beside_a_kernel_is_reported_and_one_in_its_body_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernels, numbers = tmp_path / "some_kernels.py", tmp_path / "some_numbers.py"
    kernels.write_text(MODULE)
    # the configuration and the cache of `make lint`
    monkeypatch.chdir(REPOSITORY)
    for count in ("3", "3.0"):  # the second time the module is in mypy's cache, and what it imports has changed
        numbers.write_text(f"COUNT = {count}\n")
        reported, errors, code = api.run([str(kernels), str(numbers), "--no-error-summary"])
        assert not errors
        assert code == 1
        lines = enumerate(MODULE.split("\n"), 1)
        expected = [(str(number), line.split("# ")[1]) for number, line in lines if "# " in line]
        assert re.findall(r"some_kernels\.py:(\d+): error: .*\[(.+)\]", reported) == expected
