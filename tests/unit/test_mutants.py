"""The faults that ``make mutants`` puts into modules."""

from __future__ import annotations

import ast
import contextlib

import pytest

from tests.support.mutation.mutants import mutants, mutated, noting
from tests.support.mutation.run import equivalent
from tests.support.mutation.trial import REPOSITORY


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("a < b", {"a < b → a <= b", "a < b → a >= b", "a < b → pass"}),
        ("x = a is None", {"a is None → a is not None"}),
        ("x = a and b", {"a and b → a or b", "a and b → a", "a and b → b"}),
        ("x = 1 if not a else b", {"1 → 2", "1 → 0", "not a → a"}),
        ("x = 1 if a else b", {"1 → 2", "1 → 0", "a → not a"}),
        ("x = max(a, -b)", {"max(a, -b) → min(a, -b)", "-b → b"}),
        ("x = a * 0.5", {"a * 0.5 → a / 0.5", "0.5 → 1.5", "0.5 → -0.5"}),
        ("x = {'a', None}", {"{'a', None} → {None}", "{'a', None} → {'a'}", "'a' → 'a mutated'", "None → True"}),
        ("def f(a=True): a += 1", {"True → False", "a += 1 → pass", "a += 1 → a -= 1", "1 → 2", "1 → 0"}),
        ("def f(): raise E(1)", {"raise E(1) → pass"}),
        ("def f(): return a", {"return a → return None"}),
        ("def f(a):\n a = g(a)\n a.b = c", {"a.b = c → pass"}),
        ("def f(a):\n a = g(a)\n a = h(a)", {"a = g(a) → pass", "a = h(a) → pass"}),
        ("match a:\n case 1 | 5 if c: d()", {"case 1 | 5 if c → case 1 | 5 if False", "case 1 | 5 if c → case 1 | 5", "1 | 5 → 5", "1 | 5 → 1", "1 → 2", "1 → 0", "d() → pass"}),
        ("try: a()\nexcept (B, C): pass", {"a() → pass", "except (B, C): pass → except (C,): pass", "except (B, C): pass → except (B,): pass"}),
    ],
)  # fmt: skip
def test_each_part_has_its_faults(source: str, expected: set[str]) -> None:
    keys = [each.key for each in mutants(source)]
    assert not [change for change in expected if not any(key.endswith(f" | {change}") for key in keys)]
    for each in mutants(source):
        tree = mutated(source, each.number)
        compile(tree, "", "exec")
        assert ast.dump(tree) != ast.dump(ast.parse(source)), each.key


@pytest.mark.parametrize(
    "source",
    [
        '"""A module."""',
        "__all__ = ['a', 'b']",
        "if TYPE_CHECKING:\n  a = 1",
        "x: tuple[Literal['a', 1], None]",
        "x = f(f'{a} of {b} nodes', 'two words')",
        "x = ', '.join(a)",
    ],
)
def test_what_only_people_and_type_checkers_read_is_left_alone(source: str) -> None:
    assert not mutants(source)


KERNEL = """
import warp as wp

@wp.kernel
def add(x: wp.array(dtype=float), to: wp.array(dtype=float)):
    # a comment
    to[wp.tid()] = x[wp.tid()] + wp.max(to[0], 2.0)

class Task:
    size = 3

    @cached_property
    def count(self):
        return self.size - 1
"""


def test_decorated_functions_and_kernels_have_faults_which_know_their_function() -> None:
    found = {each.key.rpartition(" | ")[2]: each for each in mutants(KERNEL)}
    in_kernel, in_method, in_class = found["2.0 → 3.0"], found["self.size - 1 → self.size + 1"], found["3 → 4"]
    assert in_kernel.in_kernel and in_kernel.function == ("add", 4) and in_kernel.line == 7
    assert not in_method.in_kernel and in_method.function == ("Task.count", 12) and in_method.line == 14
    assert in_class.function is None
    assert "wp.max(to[0], 3.0)" in ast.unparse(mutated(KERNEL, in_kernel.number))
    assert "wp.max(to[0], 2.0) → wp.min(to[0], 2.0)" in found


def test_a_fault_is_reached_with_its_statement() -> None:
    source = (
        "def f():\n  with a(\n   1):\n    match 2:\n      case 3:\n        b(\n         4)\n  return [5 for x in y]\n"
    )
    statements = {each.key.rpartition(" | ")[2]: each.line for each in mutants(source)}
    lines = [statements[f"{number} → {number + 1}"] for number in range(1, 6)]
    assert lines == [2, 4, 4, 6, 8]
    reached: list[int] = []
    values = {"__reached__": reached.append, "a": lambda x: contextlib.nullcontext(), "b": print, "y": ()}
    exec(compile(noting(source), "", "exec"), values)
    values["f"]()
    assert reached == [2, 4, 8]


def test_a_fault_keeps_its_key_when_its_line_moves_and_equal_faults_are_numbered() -> None:
    source = "def f(a):\n    a.go()\n    a.go()\n"
    keys = [each.key for each in mutants(source)]
    assert keys == ["f | a.go() | a.go() → pass", "f | a.go() | a.go() → pass #2"]
    assert [each.key for each in mutants("\n\n" + source)] == keys
    assert ast.unparse(mutated(source, 1)) == "def f(a):\n    a.go()\n    pass"


def test_every_fault_in_the_reviewed_list_exists() -> None:
    for module, known in equivalent().items():
        keys = {each.key for each in mutants((REPOSITORY / module).read_text())}
        assert not known.keys() - keys, module
