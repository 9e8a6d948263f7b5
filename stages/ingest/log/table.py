"""Rows of columns, as any format of tables has them, and the units that they are in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtiles.schemas.errors import FormatError, SourceError
from magtiles.stages.ingest.log.source import Columns, IngestLogParams
from magtiles.stages.ingest.raw import nanotesla_per
from magtiles.stages.vehicle.positions import Real

METRES = {"m": 1.0, "metre": 1.0, "metres": 1.0, "meter": 1.0, "meters": 1.0}
METRES |= {"ft": 0.3048, "foot": 0.3048, "feet": 0.3048, "km": 1000.0}
DEGREES = dict.fromkeys(("deg", "degree", "degrees", "degrees_north", "degrees_east"), 1.0)
DEGREES |= dict.fromkeys(("rad", "radian", "radians"), 180.0 / np.pi)
SPEEDS = {"m/s": 1.0, "m s-1": 1.0, "km/h": 1.0 / 3.6, "kn": 1852.0 / 3600.0}
SPEEDS |= {"knot": 1852.0 / 3600.0, "knots": 1852.0 / 3600.0}


@dataclass(frozen=True)
class Table:
    """Columns of a file, and what the file or its format says of them.

    Attributes
    ----------
    columns : name to values (n,): float64 with NaN where missing, text with '' where missing, or
        instants (UTC).
    units : units that the file states, by column.
    number : (n,) the place of each row in the file, counted from 1.
    place : what `number` counts: ``line`` or ``row``.
    where : the file's name.
    meaning : which columns are what, where the format defines it.
    height_reference : what the format's heights count from.
    others : names of columns that were not read, since nothing asked for them.
    """

    columns: Mapping[str, NDArray[Any]]
    units: Mapping[str, str]
    number: NDArray[np.int64]
    where: str
    place: str = "line"
    meaning: Columns = field(default_factory=Columns)
    height_reference: str | None = None
    others: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """All columns of the file."""
        return (*self.columns, *self.others)

    def at(self, row: int) -> str:
        """Where a row is, for messages."""
        return f"{self.where} {self.place} {self.number[row]}"

    def numbers(self, name: str) -> Real:
        """A column as numbers. Raises FormatError naming the first row that holds none."""
        values = self.columns[name]
        if values.dtype.kind != "U":
            return np.asarray(values, dtype=np.float64)
        out = np.full(values.size, np.nan)
        for row, text in enumerate(values):
            try:
                out[row] = float(text) if text else np.nan
            except ValueError:
                raise FormatError(
                    f"column '{name}' holds '{text[:40]}'", where=self.at(row), expected="a number"
                ) from None
        return out

    def rows(self, kept: NDArray[np.bool_]) -> Table:
        """The table with only the rows that are `kept` (n,)."""
        columns = {name: values[kept] for name, values in self.columns.items()}
        return Table(
            columns, self.units, self.number[kept], self.where, self.place, self.meaning,
            self.height_reference, self.others,
        )  # fmt: skip


def wanted(meaning: Columns, params: IngestLogParams) -> Columns:
    """Which column is what: the format's own, where [log.columns] says nothing else."""
    stated = {} if params.columns is None else params.columns.model_dump(exclude_none=True)
    return meaning.model_copy(update={k: v for k, v in stated.items() if v != {}})


def named_columns(columns: Columns) -> dict[str, str]:
    """Every column that is asked for, by the key that asks: `source.residual`, `time`, ..."""
    named = columns.model_dump(exclude_none=True, exclude={"source"})
    return named | {f"source.{name}": column for name, column in columns.source.items()}


def check_named(columns: Columns, table: Table, params: IngestLogParams) -> None:
    """Raise SourceError for the first key whose column is not there."""
    named = {f"columns.{key}": name for key, name in named_columns(columns).items()}
    named |= {f"column_units.{name}": name for name in params.column_units or {}}
    for key, name in named.items():
        if name not in table.names:
            raise SourceError(
                f"key '{key}' names the column '{name}', which is missing",
                where=table.where,
                expected=f"one of {', '.join(table.names) or 'none'}",
            )


@dataclass(frozen=True)
class Units:
    """Columns of a table in the units of magtiles: by the file, else by the [log] keys."""

    table: Table
    params: IngestLogParams

    def of(self, name: str) -> str | None:
        """The unit of a column. Raises SourceError where file and `column_units` differ."""
        stated = (self.params.column_units or {}).get(name)
        own = self.table.units.get(name)
        if stated is not None and own is not None and stated != own:
            raise SourceError(
                f"key 'column_units' says '{stated}' of column '{name}'",
                where=self.table.where,
                expected=f"'{own}', as the file says",
                remedy="remove it",
            )
        return stated or own

    def require(self, name: str) -> str:
        """The unit of a column. Raises SourceError, naming the key, where none is known."""
        unit = self.of(name)
        if unit is None:
            raise SourceError(
                f"the unit of column '{name}' is not known",
                where=self.table.where,
                remedy=f'state it: column_units = {{ "{name}" = "..." }} under [log]',
            )
        return unit

    def field(self, name: str) -> Real:
        """A column of the field (n,), nT. The key `units` is for columns without their own."""
        unit = self.of(name) or self.params.units or self.require(name)
        place = f"{self.table.where} column '{name}'"
        return self.table.numbers(name) * nanotesla_per(unit, where=place)

    def scaled(self, name: str, known: Mapping[str, float], default: str | None = None) -> Real:
        """A column (n,) in the unit of `known` that is 1; one without a unit is in `default`."""
        unit = self.of(name) or default or self.require(name)
        factor = known.get(unit.strip().lower())
        if factor is None:
            raise SourceError(
                f"the unit of column '{name}' is '{unit}'",
                where=self.table.where,
                expected=f"one of {', '.join(known)}",
            )
        return self.table.numbers(name) * factor
