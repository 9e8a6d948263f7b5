"""Receipts: what an artifact was made from, so that it is made again only when that changed.

The receipt of ``grid.nc`` is ``grid.nc.receipt.json`` beside it. It holds names without
folders, so the same inputs give the same artifact and the same identity anywhere.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import json
import platform
from collections.abc import Iterator, Mapping, Sequence
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from magtiles.stages.declare import Params, Stage
from magtiles.stages.release.atomic import atomic_path

_PACKAGES = ("numpy", "scipy", "xarray", "netCDF4", "pyproj", "rasterio", "numba")
_CODE = ("magtiles.schemas", "magtiles.catalog", "magtiles.stages")
_CODE_SUFFIXES = (".py", ".schema.json")


def receipt_path(artifact: Path) -> Path:
    """Where the receipt of an artifact lies."""
    return artifact.with_name(f"{artifact.name}.receipt.json")


def identity(stage: Stage, params: Params, inputs: Mapping[str, Sequence[Path]]) -> dict[str, Any]:
    """Everything that decides the content of a stage's output, as plain JSON values."""
    return {
        "stage": stage.name,
        "version": stage.version,
        "params": params.model_dump(mode="json"),
        "inputs": {
            role: [{"name": path.name, "sha256": digest(path)} for path in paths]
            for role, paths in sorted(inputs.items())
        },
        "packages": package_versions(),
        "code": code_digest(),
    }


def write_receipt(
    artifact: Path, made_from: Mapping[str, Any], contract: str, *, passing: bool = False
) -> None:
    """Write the receipt of a finished artifact that has been checked against `contract`.

    One that is `passing`, which no receipt names as an input, is not hashed: once its size or
    time of change is another, it counts as changed.
    """
    stat = artifact.stat()
    output = {
        "contract": contract,
        "sha256": "" if passing else _sha256(artifact),
        "size": stat.st_size,
        "mtime_ns": stat.st_mtime_ns,
    }
    with atomic_path(receipt_path(artifact)) as temporary:
        text = json.dumps({**made_from, "output": output}, indent=1, sort_keys=True)
        temporary.write_text(text + "\n", encoding="utf-8")


def why_stale(artifact: Path, made_from: Mapping[str, Any]) -> str | None:
    """Why an artifact must be made again, naming each field that changed; None if it need not."""
    if not artifact.is_file():
        return "output missing"
    receipt = read_receipt(artifact)
    if receipt is None:
        return "receipt missing or unreadable"
    changes = list(_changes(receipt, made_from))
    if not changes and digest(artifact) != receipt["output"]["sha256"]:
        changes.append("output changed on disk")
    return "; ".join(changes) or None


def read_receipt(artifact: Path) -> dict[str, Any] | None:
    """The receipt of an artifact, or None when there is none that can be read."""
    try:
        receipt = json.loads(receipt_path(artifact).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    if not isinstance(receipt, dict):
        return None
    if not all(
        isinstance(receipt.get(k), dict) for k in ("params", "inputs", "packages", "output")
    ):
        return None
    return receipt if {"sha256", "size", "mtime_ns"} <= receipt["output"].keys() else None


def digest(path: Path) -> str:
    """The sha256 of a file, from its receipt when size and time of change still match."""
    stat = path.stat()
    receipt = read_receipt(path)
    if receipt is not None and _is_untouched(path, receipt):
        return str(receipt["output"]["sha256"])
    return _sha256_once(path.resolve(), stat.st_size, stat.st_mtime_ns)


def was_checked(path: Path, contract: str) -> bool:
    """Whether this very code checked the artifact against `contract` when it was written."""
    receipt = read_receipt(path)
    return (
        receipt is not None
        and _is_untouched(path, receipt)
        and receipt["output"].get("contract") == contract
        and receipt.get("code") == code_digest()
    )


def _is_untouched(path: Path, receipt: Mapping[str, Any]) -> bool:
    stat, output = path.stat(), receipt["output"]
    return bool((output["size"], output["mtime_ns"]) == (stat.st_size, stat.st_mtime_ns))


@functools.lru_cache(maxsize=1024)
def _sha256_once(path: Path, size: int, mtime_ns: int) -> str:
    return _sha256(path)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def package_versions() -> dict[str, str]:
    """Versions of Python (major.minor) and of every library whose numbers reach an artifact."""
    versions = {name: importlib.metadata.version(name) for name in _PACKAGES}
    return {"python": ".".join(platform.python_version_tuple()[:2]), **versions}


@functools.cache
def code_digest(*more: str) -> str:
    """The sha256 over our modules and schemas that decide what an artifact holds.

    `more` names further packages that do.
    """
    total = hashlib.sha256()
    for package in (*_CODE, *more):
        for name, file in sorted(_code_files(resources.files(package), package)):
            total.update(f"{name}\0".encode() + hashlib.sha256(file.read_bytes()).digest())
    return total.hexdigest()


def _code_files(folder: Traversable, name: str) -> Iterator[tuple[str, Traversable]]:
    for entry in folder.iterdir():
        if entry.is_dir():
            yield from _code_files(entry, f"{name}/{entry.name}")
        elif entry.name.endswith(_CODE_SUFFIXES):
            yield f"{name}/{entry.name}", entry


def _changes(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[str]:
    for key in ("stage", "version"):
        if old.get(key) != new[key]:
            yield f"{key} changed from {old.get(key)!r} to {new[key]!r}"
    yield from _mapping_changes("params", old["params"], new["params"])
    old_inputs, new_inputs = old["inputs"], new["inputs"]
    for role in sorted(old_inputs.keys() | new_inputs.keys()):
        if old_inputs.get(role) != new_inputs.get(role):
            yield f"input {role} changed"
    yield from _mapping_changes("packages", old["packages"], new["packages"])
    if old.get("code") != new["code"]:
        yield "code changed"


def _mapping_changes(name: str, old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[str]:
    for key in sorted(old.keys() | new.keys()):
        if key not in old:
            yield f"{name}.{key} added"
        elif key not in new:
            yield f"{name}.{key} removed"
        elif old[key] != new[key]:
            yield f"{name}.{key} changed from {old[key]!r} to {new[key]!r}"
