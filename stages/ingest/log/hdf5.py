"""HDF5 files of columns, such as the flights of the MagNav data sets: datasets of one length."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from magtiles.schemas.errors import FormatError, SourceError
from magtiles.stages.ingest.log.source import Columns, IngestLogParams
from magtiles.stages.ingest.log.table import Table, named_columns, wanted

_DEFLATE_LIMIT = 1032  # the most zlib can expand: a file that declares more holds none of it


def read_hdf5(path: Path, params: IngestLogParams, where: str) -> Table:
    """The datasets that [log.columns] names by their paths (``group/name``), with their `units`.

    A dataset of one value holds for all rows. Links to other files are not followed.

    Raises
    ------
    FormatError : the file is damaged, a dataset lies in other files or declares more than the
        file can hold, or lengths differ.
    """
    named = named_columns(wanted(Columns(), params))
    try:
        with h5py.File(path, "r") as file:
            known = _datasets(file)
            asked = [name for name in known if name in set(named.values())]
            _check_sizes([known[name] for name in asked], path, where)
            arrays = {name: _read(known[name], f"{where} dataset '{name}'") for name in asked}
            units = {name: _unit(known[name]) for name in asked}
    except (OSError, RuntimeError, KeyError, ValueError) as caught:
        raise FormatError(
            f"is not a whole HDF5 file: {str(caught).replace(str(path), path.name)[:200]}",
            where=where,
            remedy="fetch it again",
        ) from None
    rows = _length(arrays, where)
    columns: dict[str, NDArray[Any]] = {}
    for name, values in arrays.items():
        columns[name] = np.broadcast_to(values, rows) if values.size == 1 else values
        if params.no_data is not None and values.dtype.kind == "f":
            columns[name] = np.where(columns[name] == params.no_data, np.nan, columns[name])
    stated = {name: unit for name, unit in units.items() if unit}
    others = tuple(name for name in known if name not in columns)
    return Table(columns, stated, np.arange(1, rows + 1), where, place="row", others=others)


def _datasets(file: h5py.File) -> dict[str, h5py.Dataset]:
    """Every dataset that lies in the file itself, by its path."""
    found: dict[str, h5py.Dataset] = {}

    def visit(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset):
            found[name] = item

    file.visititems(visit)  # does not follow links, neither soft nor external
    return found


def _check_sizes(datasets: list[h5py.Dataset], path: Path, where: str) -> None:
    declared = sum(int(dataset.nbytes) for dataset in datasets)
    if declared > _DEFLATE_LIMIT * path.stat().st_size:
        raise FormatError(
            f"declares {declared} bytes of arrays in a file of {path.stat().st_size}", where=where
        )
    for dataset in datasets:
        if dataset.external or dataset.is_virtual:
            raise FormatError(
                f"dataset '{dataset.name}' lies in other files",
                where=where,
                remedy="copy it into the file",
            )


def _read(dataset: h5py.Dataset, where: str) -> NDArray[Any]:
    if dataset.ndim > 1 and dataset.size != max(dataset.shape):
        raise FormatError(f"has the shape {dataset.shape}", where=where, expected="one dimension")
    kind = dataset.dtype.kind
    if kind in "biuf":
        return np.asarray(dataset[()], dtype=np.float64).ravel()
    if h5py.check_string_dtype(dataset.dtype) is not None:
        return np.asarray(dataset.asstr()[()], dtype=np.str_).ravel()
    raise FormatError(f"is of type {dataset.dtype}", where=where, expected="numbers or text")


def _unit(dataset: h5py.Dataset) -> str | None:
    for key in ("units", "unit"):
        value = dataset.attrs.get(key)
        if isinstance(value, bytes):
            value = value.decode("latin-1")
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
