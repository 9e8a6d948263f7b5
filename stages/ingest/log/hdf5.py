"""HDF5 files of columns, such as the flights of the MagNav data sets: datasets of one length."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtiles.schemas.errors import FormatError, SourceError
from magtiles.stages.ingest.foreign import read_foreign
from magtiles.stages.ingest.log.source import Columns, IngestLogParams
from magtiles.stages.ingest.log.table import Table, named_columns, wanted


def read_hdf5(path: Path, params: IngestLogParams, where: str) -> Table:
    """The datasets that [log.columns] names by their paths (``group/name``), with their `units`.

    A dataset of one value holds for all rows.

    Raises
    ------
    FormatError : what `read_foreign` refuses, or lengths differ.
    """
    named = named_columns(wanted(Columns(), params))
    known = read_foreign(path, sorted(set(named.values()))).variables
    arrays = {
        name: _flat(item.values, f"{where} dataset '{name}'")
        for name, item in known.items()
        if item.values is not None
    }
    units = {name: _unit(known[name].attrs) for name in arrays}
    rows = _length(arrays, where)
    columns: dict[str, NDArray[Any]] = {}
    for name, values in arrays.items():
        columns[name] = np.broadcast_to(values, rows) if values.size == 1 else values
        if params.no_data is not None and values.dtype.kind == "f":
            columns[name] = np.where(columns[name] == params.no_data, np.nan, columns[name])
    stated = {name: unit for name, unit in units.items() if unit}
    others = tuple(name for name in known if name not in columns)
    return Table(columns, stated, np.arange(1, rows + 1), where, place="row", others=others)


def _flat(values: NDArray[Any], where: str) -> NDArray[Any]:
    if values.ndim > 1 and values.size != max(values.shape):
        raise FormatError(f"has the shape {values.shape}", where=where, expected="one dimension")
    return values.ravel().astype(np.str_ if values.dtype.kind in "SU" else np.float64)


def _unit(attrs: Mapping[str, Any]) -> str | None:
    for key in ("units", "unit"):
        value = attrs.get(key)
        if isinstance(value, str) and value.strip():
            return value.strip()
    return None


def _length(arrays: dict[str, NDArray[Any]], where: str) -> int:
    lengths = {name: values.size for name, values in arrays.items() if values.size != 1}
    if not lengths and not arrays:
        raise SourceError(
            "no dataset is named",
            where=where,
            remedy="say in [log.columns] which datasets hold what",
        )
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} {size}" for name, size in lengths.items())
        raise FormatError(
            f"datasets differ in length: {listed}", where=where, expected="a value for each row"
        )
    return next(iter(lengths.values()), 1)
