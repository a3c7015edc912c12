"""Updates of many rows: one statement for each kind of change, where the unit of work would send one a row."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from functools import cache
from typing import Any, cast

from sqlalchemy import Table, Update, bindparam, update
from sqlalchemy.orm import InstanceState, LoaderCallableStatus, Session, attributes

from orchestrator.persistence.batch_models import Attempt, Job, Node

_BATCHED: tuple[type[Any], ...] = (Job, Attempt, Node)
"""Tables whose rows change together. Their keys never change."""


def write_changes(session: Session, changed_objects: Iterable[object]) -> Sequence[Any]:
    """Write the changed columns of rows that are in the database; returns their objects. What else has changed is left to the flush."""
    groups: dict[tuple[Any, tuple[str, ...]], list[InstanceState[Any]]] = defaultdict(list)
    for each in changed_objects:
        if isinstance(each, _BATCHED):
            state: InstanceState[Any] = attributes.instance_state(each)
            kind: Any = type(each)
            columns = _columns(kind)
            changed = tuple(sorted(key for key in state.committed_state if key in columns and _differs(state, key)))
            if changed:
                groups[kind, changed].append(state)
    for kind, changed in sorted(groups, key=lambda group: (group[0].__name__, group[1])):
        states = sorted(groups[kind, changed], key=_identity)  # a session's order differs from one time to the next
        columns = _columns(kind)
        statement, keys = _statement(kind, changed)
        rows = [
            {**{f"key_{name}": state.dict[name] for name in keys}, **{name: state.dict[name] for name in changed}}
            for state in states
        ]
        session.connection().execute(statement, rows)
        for state in states:
            if all(key in columns for key in state.committed_state):
                state._commit_all(
                    state.dict, session.identity_map
                )  # nothing is left for the flush; there is no public way
            else:
                state._commit(state.dict, changed)
    return [state.obj() for states in groups.values() for state in states]


def _identity(state: InstanceState[Any]) -> tuple[Any, ...]:
    assert state.key is not None
    return state.key[1]


def _differs(state: InstanceState[Any], key: str) -> bool:
    """Whether a column that was set has another value than before."""
    before = state.committed_state[key]
    return key in state.dict and (before is LoaderCallableStatus.NO_VALUE or before != state.dict[key])


@cache
def _columns(kind: Any) -> frozenset[str]:
    """Names of the attributes that are columns."""
    return frozenset(attributes.manager_of_class(kind).mapper.column_attrs.keys())


@cache
def _statement(kind: Any, changed: tuple[str, ...]) -> tuple[Update, Sequence[str]]:
    """An update of these attributes by the primary key, whose parts are named ``key_…``; and these parts."""
    mapper = attributes.manager_of_class(kind).mapper
    keys = [mapper.get_property_by_column(column).key for column in mapper.primary_key]
    table = cast(Table, mapper.local_table)
    where = [column == bindparam(f"key_{key}") for key, column in zip(keys, mapper.primary_key, strict=True)]
    values: dict[str, Any] = {mapper.columns[name].name: bindparam(name) for name in changed}
    return update(table).where(*where).values(values), keys
