"""Mutants of a module: its syntax tree with one small fault each. Pure.

What people read is left alone (docstrings, messages, the texts of f-strings), and so are annotations, decorators, ``__all__`` and blocks
under ``TYPE_CHECKING``.
"""

from __future__ import annotations

import ast
import copy
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

_COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
_ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.BitOr: ast.BitAnd,
    ast.BitAnd: ast.BitOr,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
}
_FUNCTIONS = {"min": "max", "max": "min", "any": "all", "all": "any", "sorted": "list", "reversed": "iter"}
_METHODS = {"startswith": "endswith", "endswith": "startswith", "partition": "rpartition", "rpartition": "partition"}
_MAKES_DEFS = ast.FunctionDef | ast.AsyncFunctionDef
_CONDITIONAL = ast.If | ast.While | ast.IfExp | ast.Assert


@dataclass(frozen=True)
class Mutant:
    """One fault in a module."""

    number: int
    """By which :func:`mutated` makes it."""
    key: str
    """Its function, its line's text and its change: the same as long as these are."""
    line: int
    """First line of its statement: a test that does not reach it can't notice the fault."""
    function: tuple[str, int] | None
    """Name and first line of the outermost function around it; None for what runs when the module is imported."""
    in_kernel: bool
    """Whether Warp compiles that function, from its text."""


def mutants(source: str) -> list[Mutant]:
    """Every mutant of a module, in the order of its lines."""
    lines, seen, found = source.splitlines(), Counter[str](), []
    for number, site in enumerate(_Walk().sites(ast.parse(source))):
        text = lines[site.line - 1].strip()
        key = f"{site.where} | {text} | {_shown(site.old)} → {_shown(site.new)}"
        seen[key] += 1
        if seen[key] > 1:
            key += f" #{seen[key]}"
        found.append(Mutant(number, key, site.statement, site.function, site.in_kernel))
    return found


def mutated(source: str, number: int) -> ast.Module:
    """The module with the fault of that number. Raises IndexError if there is none."""
    tree = ast.parse(source)
    for count, site in enumerate(_Walk().sites(tree)):
        if count == number:
            value = getattr(site.parent, site.field)
            if isinstance(value, list):
                value[site.index] = site.new
            else:
                setattr(site.parent, site.field, site.new)
            return ast.fix_missing_locations(tree)
    raise IndexError(number)


def noting(source: str) -> ast.Module:
    """The module, where every statement of a function first calls ``__reached__`` with its first line."""
    tree = ast.parse(source)
    blocks: list[list[ast.stmt]] = []
    for function in ast.walk(tree):
        if isinstance(function, _MAKES_DEFS):
            for node in ast.walk(function):
                each = [getattr(node, field, None) for field in ("body", "orelse", "finalbody")]
                blocks += [
                    block for block in each if isinstance(block, list) and not any(block is one for one in blocks)
                ]
    for block in blocks:
        for index in range(len(block) - 1, -1, -1):
            line = ast.Constant(block[index].lineno)
            call = ast.Expr(ast.Call(ast.Name("__reached__", ast.Load()), [line], []))
            block.insert(index, ast.copy_location(call, block[index]))
    return ast.fix_missing_locations(tree)


def _shown(node: ast.AST) -> str:
    if isinstance(node, ast.match_case):
        guard = f" if {ast.unparse(node.guard)}" if node.guard else ""
        text = f"case {ast.unparse(node.pattern)}{guard}"
    else:
        text = ast.unparse(node)
    text = " ".join(text.split())
    return text if len(text) <= 90 else text[:87] + "..."


@dataclass(frozen=True)
class _Site:
    parent: ast.AST
    field: str
    index: int
    old: ast.AST
    new: ast.AST
    where: str
    line: int
    statement: int
    function: tuple[str, int] | None
    in_kernel: bool


class _Walk:
    """Walks a tree in order and gives every place at which a fault can be."""

    def __init__(self) -> None:
        self._names: list[str] = []
        self._function: tuple[str, int] | None = None
        self._in_kernel = False
        self._statement = 0
        self._in_text = False
        self._stored: Counter[str] = Counter()

    def sites(self, tree: ast.Module) -> Iterator[_Site]:
        yield from self._fields(tree)

    def _fields(self, node: ast.AST, *only: str) -> Iterator[_Site]:
        for field in only or node._fields:
            value = getattr(node, field, None)
            for index, each in enumerate(value if isinstance(value, list) else [value]):
                if isinstance(each, ast.AST):
                    yield from self._visit(node, field, index, each)

    def _visit(self, parent: ast.AST, field: str, index: int, node: ast.AST) -> Iterator[_Site]:
        if field in ("annotation", "returns", "decorator_list", "type_params") or _is_for_people(node):
            return
        if isinstance(node, _MAKES_DEFS):
            yield from self._definition(node)
            return
        if isinstance(node, ast.ClassDef):
            yield from self._scope(node.name, node, "bases", "keywords", "body")
            return
        before = self._statement
        if isinstance(node, ast.stmt):
            self._statement = node.lineno
        yield from self._inside(parent, field, index, node)
        self._statement = before

    def _inside(self, parent: ast.AST, field: str, index: int, node: ast.AST) -> Iterator[_Site]:
        before, at = self._in_text, (self._function, self._in_kernel)
        for new in self._faults(parent, field, node):
            old = node.pattern if isinstance(node, ast.match_case) else node
            assert isinstance(old, ast.expr | ast.stmt | ast.pattern | ast.excepthandler), old
            where = ".".join(self._names) or "module"
            yield _Site(parent, field, index, node, new, where, old.lineno, self._statement, *at)
        if isinstance(node, ast.Raise):
            return  # what follows is a message
        self._in_text = before or isinstance(node, ast.JoinedStr)
        yield from self._fields(node)
        self._in_text = before

    def _definition(self, node: ast.FunctionDef | ast.AsyncFunctionDef) -> Iterator[_Site]:
        yield from self._fields(node.args, "defaults", "kw_defaults")
        before = self._function, self._in_kernel, self._stored
        if self._function is None:
            first = min([node.lineno, *(each.lineno for each in node.decorator_list)])
            self._function = ".".join([*self._names, node.name]), first
            self._in_kernel = any(ast.unparse(each).startswith("wp.") for each in node.decorator_list)
        names = (each.id for each in ast.walk(node) if isinstance(each, ast.Name) and isinstance(each.ctx, ast.Store))
        self._stored = Counter(names)
        yield from self._scope(node.name, node, "body")
        self._function, self._in_kernel, self._stored = before

    def _scope(self, name: str, node: ast.AST, *fields: str) -> Iterator[_Site]:
        self._names.append(name)
        yield from self._fields(node, *fields)
        self._names.pop()

    def _faults(self, parent: ast.AST, field: str, node: ast.AST) -> Iterator[ast.AST]:
        """The faulty forms of one node."""
        match node:
            case ast.Constant():
                yield from self._constants(parent, node)
            case ast.Compare():
                yield from _comparisons(node)
            case ast.BoolOp(op, values):
                yield ast.BoolOp(ast.Or() if isinstance(op, ast.And) else ast.And(), values)
                for kept in range(len(values)):
                    rest = values[:kept] + values[kept + 1 :]
                    yield rest[0] if len(rest) == 1 else ast.BoolOp(op, rest)
            case ast.BinOp(left, op, right) if type(op) in _ARITHMETIC:
                yield ast.BinOp(left, _ARITHMETIC[type(op)](), right)
            case ast.UnaryOp(ast.Not() | ast.USub(), operand):
                if not isinstance(operand, ast.Constant):
                    yield operand
            case ast.Call(ast.Name(name), args, keywords) if name in _FUNCTIONS:
                kept_words = [] if name == "sorted" else keywords
                yield ast.Call(ast.Name(_FUNCTIONS[name], ast.Load()), args, kept_words)
            case ast.Call(ast.Attribute(value, name), args, keywords) if name in _METHODS or (
                name in ("min", "max") and isinstance(value, ast.Name)
            ):
                other = _METHODS.get(name) or _FUNCTIONS[name]
                yield ast.Call(ast.Attribute(value, other, ast.Load()), args, keywords)
            case ast.Set(elements) if len(elements) > 1:
                for gone in range(len(elements)):
                    yield ast.Set(elements[:gone] + elements[gone + 1 :])
            case ast.ExceptHandler(ast.Tuple(elements), name, body):
                for gone in range(len(elements)):
                    kept_types = ast.Tuple(elements[:gone] + elements[gone + 1 :], ast.Load())
                    yield ast.ExceptHandler(kept_types, name, body)
            case ast.match_case(pattern, guard, body):
                yield ast.match_case(pattern, ast.Constant(False), body)
                if guard is not None and not _takes_all(pattern):
                    yield ast.match_case(pattern, None, body)
            case ast.MatchOr(patterns):
                for gone in range(len(patterns)):
                    some = patterns[:gone] + patterns[gone + 1 :]
                    yield some[0] if len(some) == 1 else ast.MatchOr(some)
            case ast.stmt():
                yield from self._statements(node)
        if isinstance(node, ast.Name | ast.Attribute | ast.Call | ast.NamedExpr) and (
            (isinstance(parent, _CONDITIONAL) and field == "test")
            or (isinstance(parent, ast.comprehension) and field == "ifs")
        ):
            yield ast.UnaryOp(ast.Not(), node)

    def _constants(self, parent: ast.AST, node: ast.Constant) -> Iterator[ast.expr]:
        value = node.value
        if isinstance(value, bool):
            yield ast.Constant(not value)
        elif isinstance(value, int | float):
            yield ast.Constant(value + 1)
            yield ast.Constant(value - 1) if value >= 1 else ast.UnaryOp(ast.USub(), ast.Constant(1 - value))
        elif value is None:
            if not (isinstance(parent, ast.Compare) and isinstance(parent.ops[0], ast.Is | ast.IsNot)):
                yield ast.Constant(True)
        elif isinstance(value, str | bytes) and not self._is_message(parent, value):
            yield ast.Constant(f"{value} mutated" if isinstance(value, str) else value + b" mutated")

    def _is_message(self, parent: ast.AST, value: str | bytes) -> bool:
        """Whether only people read a text: it has words and is no constant of the module, or it is a part of a longer text."""
        if self._in_text or (isinstance(parent, ast.Attribute) and parent.attr == "join"):
            return True
        has_words = isinstance(value, str) and " " in value and any(map(str.isalpha, value))
        return has_words and not (not self._names and isinstance(parent, ast.Assign))

    def _statements(self, node: ast.stmt) -> Iterator[ast.stmt]:
        match node:
            case ast.Return(value):
                if value is not None and not (isinstance(value, ast.Constant) and value.value is None):
                    yield ast.Return(ast.Constant(None))
            case ast.Expr() | ast.AugAssign() | ast.Raise() | ast.Continue() | ast.Break() | ast.Delete():
                yield ast.Pass()
            case ast.Assign(targets) if self._function is not None and all(map(self._is_elsewhere, targets)):
                yield ast.Pass()
        if isinstance(node, ast.AugAssign) and type(node.op) in _ARITHMETIC:
            yield ast.AugAssign(copy.deepcopy(node.target), _ARITHMETIC[type(node.op)](), node.value)

    def _is_elsewhere(self, target: ast.expr) -> bool:
        """Whether what an assignment changes exists without it."""
        if isinstance(target, ast.Tuple):
            return all(map(self._is_elsewhere, target.elts))
        return not isinstance(target, ast.Name) or self._stored[target.id] > 1


def _comparisons(node: ast.Compare) -> Iterator[ast.expr]:
    for index, op in enumerate(node.ops):
        for other in _COMPARISONS[type(op)]:
            yield ast.Compare(node.left, [*node.ops[:index], other(), *node.ops[index + 1 :]], node.comparators)
        listed = node.comparators[index]
        if isinstance(op, ast.In | ast.NotIn) and isinstance(listed, ast.Tuple) and len(listed.elts) > 1:
            for gone in range(len(listed.elts)):
                rest = ast.Tuple(listed.elts[:gone] + listed.elts[gone + 1 :], ast.Load())
                yield ast.Compare(
                    node.left, node.ops, [*node.comparators[:index], rest, *node.comparators[index + 1 :]]
                )


def _takes_all(pattern: ast.pattern) -> bool:
    return isinstance(pattern, ast.MatchAs) and (pattern.pattern is None or _takes_all(pattern.pattern))


def _is_for_people(node: ast.AST) -> bool:
    """Docstrings, ``__all__``, logging, and imports for types."""
    match node:
        case ast.Expr(ast.Constant(str())):
            return True
        case ast.Assign([ast.Name("__all__")]) | ast.If(ast.Name("TYPE_CHECKING")) | ast.Import() | ast.ImportFrom():
            return True
        case ast.Expr(ast.Call(ast.Attribute(ast.Name(name)))):
            return name.lower().strip("_") in ("log", "logger", "logging")
    return False
