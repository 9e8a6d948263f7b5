"""Releases and files changed by someone with bad intent, or by a failing disk."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import netCDF4
import numpy as np
import pytest

from magtiles.catalog.releases.digest import canonical_json, manifest_digest, sha256
from magtiles.schemas.errors import IntegrityError


def reseal(folder: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Edit a release's manifest and make its digest true again."""
    document = json.loads((folder / "manifest.json").read_bytes())
    change(document)
    document["manifest_digest"] = manifest_digest(document)
    (folder / "manifest.json").write_bytes(canonical_json(document))


def flipped_bits(data: bytes, count: int) -> Iterator[bytes]:
    """The same bytes but for one bit, somewhere."""
    for position in np.random.default_rng(5).integers(0, 8 * len(data), count).tolist():
        flipped = bytearray(data)
        flipped[position // 8] ^= 1 << position % 8
        yield bytes(flipped)


def flipped_bytes(data: bytes, count: int, among: int) -> Iterator[bytes]:
    """The same bytes but for one, `among` the first."""
    for position in np.random.default_rng(8).integers(0, among, count).tolist():
        flipped = bytearray(data)
        flipped[position] ^= 0xFF
        yield bytes(flipped)


def assert_whole_or_refused(read: Callable[[bytes], Any], data: bytes, flipped: int) -> int:
    """How many of so many bytes, from the first, it refuses when one is another; all short ends."""
    refused = 0
    for damaged in flipped_bytes(data, flipped, min(len(data), 40_000)):
        try:
            read(damaged)
        except IntegrityError:
            refused += 1
    for end in (0, 1, 7, 8, 100, len(data) // 2, len(data) - 1):
        with pytest.raises(IntegrityError):
            read(data[:end])
    return refused


class Seal(NamedTuple):
    """A change of a manifest, and what is said of it."""

    change: Callable[[dict[str, Any]], Any]
    message: str
    id: str


class Edit(NamedTuple):
    """A change of an open netCDF file, and what is said of it."""

    edit: Callable[[Any], Any]
    message: str
    id: str


def put(name: str, value: Any, index: Any = 0) -> Callable[[Any], Any]:
    """An edit of a value."""

    def edit(file: Any) -> None:
        file[name][index] = value

    return edit


def attribute(name: str, value: Any) -> Callable[[Any], Any]:
    """An edit of a global attribute."""
    return lambda file: file.setncattr(name, value)


def forge(path: Path, edit: Callable[[Any], Any]) -> dict[str, Any]:
    """Edit a netCDF file; what a manifest would have to say of it to be true."""
    with netCDF4.Dataset(path, "a") as file:
        file.set_auto_maskandscale(False)
        edit(file)
    data = path.read_bytes()
    return {"size": len(data), "sha256": sha256(data)}


class Bomb(NamedTuple):
    """Sizes of dimensions and options of variables, and what is said of a file of them."""

    sizes: dict[str, int]
    options: dict[str, Any]
    message: str
    id: str


def unwritten(
    path: Path, contract: str, sizes: Mapping[str, int], rules: Mapping[str, Any], **options: Any
) -> bytes:
    """A file of a contract's names, of whatever sizes, in which no value is written."""
    with netCDF4.Dataset(path, "w") as file:
        file.setncattr("contract", contract)
        for name, size in sizes.items():
            file.createDimension(name, size)
        for name, rule in rules.items():
            dtype = str if rule.dtypes == ("str",) else rule.dtypes[-1]
            variable = file.createVariable(name, dtype, rule.dims, fill_value=False, **options)
            if rule.units:
                variable.units = rule.units
    return path.read_bytes()
