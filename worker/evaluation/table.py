"""The table of an evaluation: one row an episode, as Parquet."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from shared_store.volume.files import write_atomic
from worker.evaluation.episodes import Episodes


def write_table(
    path: Path,
    played: Episodes,
    seed: int | None,
    facts: Mapping[str, str],
    further: Mapping[str, Sequence[Any]] | None = None,
) -> None:
    """Write the episodes, whole or not at all. The same episodes are the same bytes. Raises OSError.

    Columns: ``episode`` (its number), ``seed`` (of the worlds; none of those of a training), ``return``, ``length`` [steps], ``success``,
    ``cause``, and of each term ``reward_NAME`` (weighted sum) or ``metric_NAME`` (mean over the steps, or the last value).

    Args:
        path: Of the file.
        played: The episodes.
        seed: Of the worlds.
        facts: What was evaluated, for the key-value metadata of the file: ``run``, ``checkpoint``, ``task``, ``config`` (JSON).
        further: Columns of further facts, by name; numbers are float64 unless all are whole.
    """
    import pyarrow as arrow
    import pyarrow.parquet

    count = len(played.rows)
    successes = played.successes
    columns = {
        "episode": arrow.array(range(count), arrow.int64()),
        "seed": arrow.array([seed] * count, arrow.int64()),
        # of float32 sums: no digit of them is lost
        "return": arrow.array(played.returns.numpy(), arrow.float64()),
        "length": arrow.array(played.lengths.long().numpy(), arrow.int64()),
        "success": arrow.array([None] * count if successes is None else successes.tolist(), arrow.bool_()),
        "cause": arrow.array(played.ends, arrow.string()),
        **{name: arrow.array(played.term(name).numpy(), arrow.float64()) for name in played.terms},
    }
    for name, values in (further or {}).items():
        whole = all(isinstance(value, int) for value in values)
        text = all(isinstance(value, str) for value in values)
        columns[name] = arrow.array(values, arrow.string() if text else arrow.int64() if whole else arrow.float64())
    buffer = io.BytesIO()
    pyarrow.parquet.write_table(arrow.table(columns).replace_schema_metadata(dict(facts)), buffer)
    for left in path.parent.glob(f".{path.name}.*.tmp"):  # of an evaluation that was killed
        left.unlink(missing_ok=True)
    write_atomic(path, buffer.getvalue())
