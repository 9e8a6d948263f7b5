"""Not doing the same work for every level of a map.

The levels of a product are made one after another from one grid; its plane, its spectrum and
the places of the output nodes are the same for all. The latest of each is kept, under a key
of everything it depends on, so that what comes out is the same with and without it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable
from typing import Any, TypeVar

import numpy as np
import xarray as xr

Value = TypeVar("Value")

_latest: dict[str, tuple[Hashable, Any]] = {}


def latest(kind: str, key: Hashable, make: Callable[[], Value]) -> Value:
    """What `make` gave for this key, if that was the last one of its kind, or gives now."""
    kept = _latest.get(kind)
    if kept is None or kept[0] != key:
        _latest.pop(kind, None)
        kept = key, make()
        _latest[kind] = kept
    value: Value = kept[1]
    return value


def content_key(dataset: xr.Dataset) -> str:
    """A digest of a dataset's values and attributes."""
    digest = hashlib.sha256(repr(sorted(dataset.attrs.items(), key=str)).encode())
    for name in sorted(map(str, dataset.variables)):
        variable = dataset[name]
        digest.update(f"{name} {variable.dims} {variable.dtype} {variable.shape}".encode())
        digest.update(repr(sorted(variable.attrs.items(), key=str)).encode())
        digest.update(np.ascontiguousarray(variable.values).data)
    return digest.hexdigest()
