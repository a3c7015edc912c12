"""Items of lists, and loops over them."""

from __future__ import annotations

import ast
from collections.abc import Callable
from dataclasses import dataclass

from racer.rewards.parameters import BY_NAME
from racer.rewards.translation.emitter import Emitting
from racer.rewards.translation.expression_values import (
    C_TYPES,
    Constant,
    ItemList,
    Number,
    Outside,
    RuntimeList,
    Thing,
    Value,
    cast,
    codes,
    described,
    flat,
    joined,
    number,
    rebuilt,
    shape_of,
)
from shared_store.contract.error_text import nearest


@dataclass(frozen=True)
class Iterated:
    """Something to go through.

    Attributes:
        length: C++ expression of how many items it has.
        item: From an index that is valid to the item.
        known: How many, where that is known.
    """

    length: str
    item: Callable[[str], Value]
    known: int | None = None


class Items(Emitting):
    """Translates indices, slices and loops."""

    _entry: Callable[..., Value]

    def _Subscript(self, node: ast.Subscript) -> Value:
        base = self.expression(node.value)
        if isinstance(node.slice, ast.Slice):
            return self._slice(base, node)
        return self.item(base, self.expression(node.slice), node)

    def item(self, base: Value, index: Value, node: ast.AST) -> Value:
        """``base[index]``."""
        if isinstance(base, Thing) and base.kind == "params":
            return self.key(index, node)
        known: int | None = index.constant if isinstance(index, Number) else None
        if isinstance(base, Constant) and isinstance(base.value, dict):
            return self._entry(base.value, index, node)
        index = self.numeric(index, node)
        if index.kind == "float":
            raise Outside(node, "an index that is a float")
        if isinstance(base, Constant) and isinstance(base.value, list | tuple):
            if known is not None and -len(base.value) <= known < len(base.value):
                return self.program.wrap(base.value[known], node)
            return self._cells(base, f"py_index({cast(index, 'int')}, {len(base.value)}, {self.at(node)})", node)
        if isinstance(base, ItemList):
            if known is not None and -len(base.items) <= known < len(base.items):
                return base.items[known]
            place = self.fresh()
            self.emit(f"const long long {place} = py_index({cast(index, 'int')}, {len(base.items)}, {self.at(node)});")
            return self.chosen(base.items, place, node)
        if isinstance(base, RuntimeList):
            place = self.fresh()
            self.emit(f"const long long {place} = py_index({cast(index, 'int')}, {base.length}, {self.at(node)});")
            return base.row(place)
        raise Outside(node, f"an item of {described(shape_of(base))}")

    def key(self, index: Value, node: ast.AST) -> Value:
        """``params[index]``."""
        name = index.constant if isinstance(index, Number) else None
        if not isinstance(name, str):
            raise Outside(node, "a key of params that is not known")
        if name not in BY_NAME:
            raise Outside(node, f"params has no key {name!r} ({nearest(name, BY_NAME)})")
        return self.program.parameter(name)

    def chosen(self, items: tuple[Value, ...], place: str, node: ast.AST) -> Value:
        """One of several values, by a number that is known when it runs."""
        if not items:
            return number(0)
        shape = shape_of(items[0])
        for item in items[1:]:
            shape = joined(shape, shape_of(item))
        if shape is None or not flat(shape):
            raise Outside(node, "an item of a list whose items have several types")
        rows = [codes(item, shape) for item in items]
        names = []
        for kind, column in zip(flat(shape), zip(*rows, strict=True), strict=True):
            names.append(self.fresh())
            chain = "".join(f"{place} == {count} ? {code} : " for count, code in enumerate(column[:-1])) + column[-1]
            self.emit(f"const {C_TYPES[kind]} {names[-1]} = {chain};")
        return rebuilt(shape, names)

    def _cells(self, base: Constant, index: str, node: ast.AST) -> Value:
        """A row of a constant list, by a number that is known when it runs."""
        name, kinds = self.program.table(base, node)
        place = self.fresh()
        self.emit(f"const long long {place} = {index};")
        cells = tuple(
            Number(kind, f"({C_TYPES[kind]}){name}[{len(kinds)} * {place} + {column}]")
            for column, kind in enumerate(kinds)
        )
        return ItemList(cells) if isinstance(base.value[0], list | tuple) else cells[0]

    def _slice(self, base: Value, node: ast.Subscript) -> Value:
        assert isinstance(node.slice, ast.Slice)
        bounds: list[int | None] = []
        for each in (node.slice.lower, node.slice.upper, node.slice.step):
            value = self.expression(each) if each is not None else None
            if value is not None and (not isinstance(value, Number) or not isinstance(value.constant, int)):
                raise Outside(node, "a slice whose bounds are not known")
            bounds.append(None if value is None else value.constant)
        if isinstance(base, ItemList):
            return ItemList(base.items[slice(*bounds)])
        if isinstance(base, Constant) and isinstance(base.value, list | tuple) and bounds[2] != 0:
            return self.program.wrap(base.value[slice(*bounds)], node)
        raise Outside(node, f"a slice of {described(shape_of(base))}")

    # loops

    def iterated(self, value: Value, node: ast.AST) -> Iterated:
        """The items of a loop."""
        if isinstance(value, Constant) and isinstance(value.value, dict):
            value = ItemList(tuple(self.program.wrap(key, node) for key in value.value))
        if isinstance(value, ItemList):
            held = self.hold(value)
            assert isinstance(held, ItemList)
            return Iterated(str(len(held.items)), lambda index: self.chosen(held.items, index, node), len(held.items))
        if isinstance(value, Constant) and isinstance(value.value, list | tuple):
            constant = value
            return Iterated(str(len(value.value)), lambda index: self._cells(constant, index, node), len(value.value))
        if isinstance(value, RuntimeList):
            return Iterated(value.length, value.row)
        if isinstance(value, Thing) and isinstance(value.scope, Iterated):
            return value.scope
        raise Outside(node, f"a loop over {described(shape_of(value))}")

    def each(self, value: Value, node: ast.AST, body: Callable[[Value], None]) -> None:
        """A loop: ``body`` adds the lines that use an item."""
        found = self.iterated(value, node)
        count, index = self.fresh(), self.fresh()
        self.emit(f"const long long {count} = {found.length};")
        self.check()
        self.emit(f"for (long long {index} = 0; {index} < {count}; ++{index}) {{")
        self.emit(self.round(node))
        body(found.item(index))
        self.check()
        self.emit("}")
