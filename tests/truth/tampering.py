"""Releases and files changed by someone with bad intent, or by a failing disk."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from magtiles.catalog.releases.digest import canonical_json, manifest_digest


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
