"""Digests: of bytes, of JSON documents, and of arrays whatever file holds them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray


def sha256(data: bytes) -> str:
    """Hexadecimal SHA-256."""
    return hashlib.sha256(data).hexdigest()


def canonical_json(document: Any) -> bytes:
    """JSON with sorted keys, no spaces and no NaN, in UTF-8."""
    text = json.dumps(
        document, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    )
    return text.encode()


def manifest_digest(document: Mapping[str, Any]) -> str:
    """Digest of a manifest: of its canonical JSON without the key `manifest_digest`."""
    return sha256(canonical_json({k: v for k, v in document.items() if k != "manifest_digest"}))


def array_digest(variables: Mapping[str, NDArray[Any]]) -> str:
    """Digest of arrays by name: the same whatever the container, compression or byte order.

    SHA-256 over, for every variable in order of name, one line of canonical JSON
    ``[name, dtype, shape]`` ending in a newline, then the values little-endian in C order. Text
    counts as UTF-8, filled up with zero bytes to the longest: its dtype is ``bytes24`` for three.
    """
    total = hashlib.sha256()
    for name in sorted(variables):
        values = np.asarray(variables[name])
        if values.dtype.kind == "U":
            values = np.char.encode(values, "utf-8")
        little = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
        total.update(canonical_json([name, values.dtype.name, list(values.shape)]) + b"\n")
        total.update(little.data if little.ndim else little.tobytes())
    return total.hexdigest()
