"""Writing of tables to files."""

from __future__ import annotations

import io
from pathlib import Path

import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq

from suspnet.ground.storage import write_atomically


def write_table(table: pa.Table, path: Path) -> None:
    """Write a table to `path` with the suffixes .parquet and .csv."""
    for suffix, write in ((".parquet", pq.write_table), (".csv", pacsv.write_csv)):
        stream = io.BytesIO()
        write(table, stream)
        write_atomically(path.with_name(path.name + suffix), stream.getvalue())
