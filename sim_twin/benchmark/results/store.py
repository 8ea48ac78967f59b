"""Rows on disk: a folder of small Parquet files, one per scenario, that Parquet readers read as one table.

A Parquet file cannot be appended to, and a partial one cannot be read. So each scenario's rows go into a file of their
own, which appears under its name once complete: a killed run loses only the scenarios in flight, and `--resume`
continues with the missing ones.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from hal.base.errors import OutputExistsError
from hal.base.files import PARTIAL, atomic_path
from sim_twin.benchmark.episodes.rows import TRACEBACK, Row

FOLDER, TABLE, ERROR_LOG = "episodes", "episodes.parquet", "errors.log"
_LONGEST_NAME = 100


class Store:
    """The rows of one run, in `out`.

    Raises:
        OutputExistsError: there are rows already and `resume` is False.
    """

    def __init__(self, out: Path, resume: bool) -> None:
        self._folder = out / FOLDER
        self._table = out / TABLE
        self._errors = out / ERROR_LOG
        if not resume and any(self._folder.glob("*.parquet")):
            raise OutputExistsError(
                f"store: {out} has the episodes of an earlier run. Add --resume to continue it, or give another --out."
            )
        self._folder.mkdir(parents=True, exist_ok=True)
        for partial in self._folder.glob(f"*{PARTIAL}"):
            partial.unlink()

    def done(self) -> set[tuple[str, str]]:
        """Return the (scenario, method) pairs with a row."""
        return {(row["scenario"], row["method"]) for row in self.rows([])}

    def add(self, rows: Iterable[Row]) -> None:
        """Keep the rows of one scenario; on return they are on the disk.

        Tracebacks of error rows go to `ERROR_LOG`, not into the table.
        """
        rows = list(rows)
        self._log_errors(rows)
        rows = [{name: value for name, value in row.items() if name != TRACEBACK} for row in rows]
        methods = "+".join(sorted(str(row["method"]).replace(":", "_").replace("=", "") for row in rows))
        if len(methods) > _LONGEST_NAME or "/" in methods:  # many variants, or one with the path of its scoring
            methods = hashlib.sha256(methods.encode()).hexdigest()[:16]
        path = self._folder / f"{rows[0]['scenario']}-{methods}.parquet"
        with atomic_path(path) as partial:
            pq.write_table(pa.Table.from_pylist(_align_columns(rows)), partial)
            with partial.open("rb") as file:
                os.fsync(file.fileno())

    def _log_errors(self, rows: Iterable[Row]) -> None:
        entries = [f"{row['scenario']}, {row['method']}\n{row[TRACEBACK]}\n" for row in rows if TRACEBACK in row]
        if entries:
            with self._errors.open("a", encoding="utf-8") as file:
                file.writelines(entries)

    def rows(self, columns: list[str] | None = None) -> list[Row]:
        """Return all rows, sorted by scenario and method; columns that a row lacks are None.

        Args:
            columns: in addition to scenario and method; None is all.
        """
        if columns is not None:
            columns = ["scenario", "method", *columns]
        tables = [pq.read_table(path, columns=columns) for path in sorted(self._folder.glob("*.parquet"))]
        if not tables:
            return []
        # Files of different methods lack different columns, or have only nulls in one
        rows = pa.concat_tables(tables, promote_options="permissive").to_pylist()
        return sorted(rows, key=lambda row: (row["scenario"], row["method"]))

    def write_table(self) -> Path:
        """Write all rows as one file next to the folder and return its path."""
        with atomic_path(self._table) as partial:
            pq.write_table(pa.Table.from_pylist(_align_columns(self.rows())), partial)
        return self._table


def _align_columns(rows: list[Row]) -> list[Row]:
    """Return `rows` with the same columns in each."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    return [{name: row.get(name) for name in names} for row in rows]
