"""Publishing a release: built beside its place, validated, then there by one rename."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import re
import shutil
import socket
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from magtiles.catalog.releases.digest import canonical_json, manifest_digest, sha256
from magtiles.catalog.releases.manifest import (
    CONTRACT,
    MANIFEST_NAME,
    NAME,
    Manifest,
    parse_manifest,
    read_manifest,
)
from magtiles.catalog.releases.reader import open_release
from magtiles.catalog.releases.road_table import PATH as ROAD_PATH
from magtiles.catalog.releases.temporal_table import PATH as TEMPORAL_PATH
from magtiles.catalog.releases.tile_table import UNITS
from magtiles.catalog.releases.versions import (
    check_same,
    check_successor,
    format_version,
    parse_version,
)
from magtiles.schemas import contracts
from magtiles.schemas.errors import ContractError, SourceError, VersionError
from magtiles.stages.release.atomic import remove_temporaries, sync, write_bytes, writing
from magtiles.stages.release.checks import CHECKS_NAME, Spread, make_checks, replay_checks
from magtiles.stages.release.lock import locked
from magtiles.stages.release.provenance import CONTRACT as PROVENANCE_CONTRACT
from magtiles.stages.release.provenance import build_date, statement
from magtiles.stages.release.records import (
    IDENTITY_ATTRIBUTES,
    MeasuredTile,
    common_lattice,
    measure_tile,
)
from magtiles.stages.release.road_file import measure_road
from magtiles.stages.release.temporal_file import measure_temporal

LATEST_NAME = "latest.json"
PROVENANCE_NAME = "provenance.json"

_STAGING = ".staging."
_LOCK_NAME = ".publish.lock"
_COPIED_BYTES = 1 << 20
_DEAD_S = 86400.0
"""Age after which what another machine left of a release is dead; publishing takes minutes."""
_EXTRA_ROLES = {
    r"preview/[A-Za-z0-9_-][A-Za-z0-9._-]*": "preview",
    r"core_field\.shc": "core_field",
    r"temporal\.nc": "temporal",
    ROAD_PATH: "road",
}
_DATUM = "WGS84"


@dataclass(frozen=True)
class PublishResult:
    """Where the release is, and whether this call made it."""

    path: Path
    changed: bool


def publish_release(
    store: Path,
    *,
    product: str,
    version: str,
    tiles: Sequence[Path | MeasuredTile],
    identity: Mapping[str, Any],
    inputs: Sequence[Mapping[str, Any]],
    provenance: Mapping[str, Any],
    extra_files: Mapping[str, Path],
    spread: Spread | None = None,
) -> PublishResult:
    """Publish tiles as ``<store>/<product>/<version>``, read-only and never changed again.

    Parameters
    ----------
    tiles : files of contract anomaly-tile/1 that cover a lattice whole, or what `measure_tile`
        found of them; they are copied.
    identity : what the release is, beyond the tiles' reference field, epoch and definition;
        a value that contradicts the tiles raises ContractError.
    inputs : the sources, each with the keys id, sha256, licence and role.
    provenance : how it was made, as `slsa_predicate` says it.
    extra_files : ``preview/*``, ``core_field.shc``, ``temporal.nc`` (as `write_temporal` makes
        it, and with a core field) and ``roads/*.nc`` (as `write_road` makes them, at
        `road_path`), path in the release to file.
    spread : makes the release's checks, and tries them, elsewhere than here; as `map`.

    Returns
    -------
    The release's folder; `changed` is False when the version exists with this very content.

    Raises
    ------
    VersionError : the version exists with other content, or is too small a step.
    ContractError, FormatError : tiles that are none, or do not fit together.
    """
    if not re.fullmatch(NAME, product):
        raise SourceError(f"'{product}' is no product name", expected=f"letters like {NAME}")
    parse_version(version)
    measured = [measure_tile(t) if isinstance(t, Path) else t for t in tiles]
    measured.sort(key=lambda t: str(t.entry["path"]))
    document = _document(product, version, measured, identity, inputs)
    extras = {path: _extra(path, file) for path, file in sorted(extra_files.items())}
    _add_files(document, extras)
    if TEMPORAL_PATH in extra_files:
        _add_temporal(document, extra_files)
    for path in (path for path in extra_files if re.fullmatch(ROAD_PATH, path)):
        _complete_entry(document, measure_road(extra_files[path], path), extra_files[path])
    home, final = store / product, store / product / version
    with writing(final), locked(home, _LOCK_NAME, doing="publishing"):
        _remove_dead(home)
        changed = not _exists_already(home, _sealed(document))
        if changed:
            _build(home, final, document, measured, extras, provenance, spread)
        _point_to_latest(home)
    return PublishResult(final, changed)


def published_versions(home: Path) -> list[Manifest]:
    """The manifests of all versions in ``<store>/<product>``, oldest version first."""
    folders = [f for f in home.iterdir() if f.is_dir() and re.fullmatch(r"\d+\.\d+\.\d+", f.name)]
    manifests = [read_manifest(folder) for folder in folders]
    return sorted(manifests, key=lambda m: parse_version(m.version))


def _exists_already(home: Path, new: Manifest) -> bool:
    """Whether the version is there with the same content. VersionError when it may not be."""
    existing = published_versions(home)
    for manifest in existing:
        if manifest.version == new.version:
            check_same(manifest, new, parse_version(existing[-1].version))
            return True
    check_successor(existing, new)
    return False


def _document(
    product: str,
    version: str,
    tiles: Sequence[MeasuredTile],
    identity: Mapping[str, Any],
    inputs: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """The manifest as far as tiles and arguments tell it."""
    if not tiles:
        raise ContractError("there are none", where="tiles", expected="at least one tile")
    lattice = common_lattice(tiles)
    document = {
        "contract": CONTRACT,
        "product": product,
        "version": version,
        "magtiles": importlib.metadata.version("magtiles"),
        "identity": _identity(tiles, identity),
        "lattice": {key: getattr(lattice, key) for key in lattice.__dataclass_fields__},
        "heights_m": list(_shared(tiles, lambda t: t.heights, "height")),
        "height_reference": _shared(
            tiles, lambda t: t.attributes["height_reference"], "height_reference"
        ),
        "inputs": [dict(item) for item in inputs],
        "files": [
            {**t.entry, "bounds": lattice.bounds(t.entry["row"], t.entry["column"])} for t in tiles
        ],
    }
    if (date := build_date()) is not None:
        document["created"] = date
    return document


def _identity(tiles: Sequence[MeasuredTile], given: Mapping[str, Any]) -> dict[str, Any]:
    known: dict[str, Any] = {"datum": _DATUM, "units": dict(UNITS)}
    for name in IDENTITY_ATTRIBUTES:
        known[name] = _shared(tiles, lambda t, name=name: t.attributes[name], name)
    for name, value in given.items():
        if name in known and known[name] != value:
            raise ContractError(
                f"is {value!r}",
                where=f"identity {name}",
                expected=f"{known[name]!r} as in the tiles",
            )
    return {**given, **known}


def _shared(tiles: Sequence[MeasuredTile], get: Any, name: str) -> Any:
    for tile in tiles:
        if get(tile) != get(tiles[0]):
            raise ContractError(
                f"{name} is {get(tile)!r}",
                where=tile.source,
                expected=f"{get(tiles[0])!r} as in {tiles[0].source.name}",
            )
    return get(tiles[0])


def _extra(path: str, file: Path) -> bytes:
    if not any(re.fullmatch(pattern, path) for pattern in _EXTRA_ROLES):
        raise ContractError(
            "has no place in a release",
            where=path,
            expected=f"preview/<name>, core_field.shc, {TEMPORAL_PATH} or roads/<name>.nc",
        )
    return file.read_bytes()


def _role(path: str) -> str:
    for pattern, role in _EXTRA_ROLES.items():
        if re.fullmatch(pattern, path):
            return role
    return {PROVENANCE_NAME: "provenance", CHECKS_NAME: "checks"}[path]


def _add_files(document: dict[str, Any], files: Mapping[str, bytes]) -> None:
    document["files"] += [
        {"path": path, "size": len(data), "sha256": sha256(data), "role": _role(path)}
        for path, data in files.items()
    ]


def _add_temporal(document: dict[str, Any], extra_files: Mapping[str, Path]) -> None:
    """Replace the plain entry of temporal.nc by its whole record."""
    if "core_field.shc" not in extra_files:
        raise ContractError(
            "comes without a core field, which tells dip latitude and total field by",
            where=extra_files[TEMPORAL_PATH],
            expected="core_field.shc beside it",
            remedy="name a reference field whose coefficients are at hand, such as IGRF-14",
        )
    record = measure_temporal(extra_files[TEMPORAL_PATH])
    _complete_entry(document, record, extra_files[TEMPORAL_PATH])


def _complete_entry(document: dict[str, Any], record: dict[str, Any], file: Path) -> None:
    """Replace the plain entry of a file by its whole record."""
    plain = next(entry for entry in document["files"] if entry["path"] == record["path"])
    if plain["sha256"] != record["sha256"]:
        raise ContractError("changed while it was being published", where=file)
    plain |= record


def _sealed(document: Mapping[str, Any]) -> Manifest:
    """The manifest with its own digest, as the reader would parse it."""
    return parse_manifest(_seal(document), "manifest of the new release")


def _seal(document: Mapping[str, Any]) -> bytes:
    plain = json.loads(canonical_json(document))
    return canonical_json({**plain, "manifest_digest": manifest_digest(plain)})


def _build(
    home: Path,
    final: Path,
    document: dict[str, Any],
    tiles: Sequence[MeasuredTile],
    files: Mapping[str, bytes],
    provenance: Mapping[str, Any],
    spread: Spread | None,
) -> None:
    """Build in a temporary sibling and rename it to `final`; on failure nothing stays."""
    staging = home / f"{_STAGING}{socket.gethostname()}.{os.getpid()}"
    staging.mkdir()
    try:
        (staging / "tiles").mkdir()
        with ThreadPoolExecutor(2) as threads:
            copies = list(threads.map(lambda tile: _copy(tile, staging), tiles))
            # The disk takes them while the release is tried.
            synced = [threads.submit(sync, copy) for copy in copies]
            for path, data in files.items():
                (staging / path).parent.mkdir(exist_ok=True)
                (staging / path).write_bytes(data)
            _complete(staging, document, provenance, spread)
            for copy in synced:
                copy.result()
        _protect(staging)
        _rename(staging, final)
    except BaseException:
        _remove(staging)
        raise
    sync(home)


def _copy(tile: MeasuredTile, staging: Path) -> Path:
    # A hard link would let a later write to the work file change the release.
    copy, found = staging / str(tile.entry["path"]), hashlib.sha256()
    with tile.source.open("rb") as source, copy.open("wb") as target:
        while part := source.read(_COPIED_BYTES):
            found.update(part)
            target.write(part)
    if found.hexdigest() != tile.entry["sha256"]:
        raise ContractError("changed while it was being published", where=tile.source)
    return copy


def _complete(
    staging: Path, document: dict[str, Any], provenance: Mapping[str, Any], spread: Spread | None
) -> None:
    """Add checks, provenance and the final manifest, then read the release back and try it."""
    (staging / MANIFEST_NAME).write_bytes(_seal(document))
    checks = canonical_json(make_checks(open_release(staging), spread))
    (staging / CHECKS_NAME).write_bytes(checks)
    _add_files(document, {CHECKS_NAME: checks})
    made = canonical_json(_provenance(document, provenance))
    (staging / PROVENANCE_NAME).write_bytes(made)
    _add_files(document, {PROVENANCE_NAME: made})
    contracts.check_document(json.loads(_seal(document)), CONTRACT, where=MANIFEST_NAME)
    (staging / MANIFEST_NAME).write_bytes(_seal(document))
    replay_checks(open_release(staging), spread)


def _provenance(document: Mapping[str, Any], predicate: Mapping[str, Any]) -> dict[str, Any]:
    """The statement of how every file that the manifest lists so far was made."""
    made = statement({file["path"]: file["sha256"] for file in document["files"]}, predicate)
    contracts.check_document(made, PROVENANCE_CONTRACT, where=PROVENANCE_NAME)
    return made


def _protect(staging: Path) -> None:
    """Sync everything and take away the permission to write."""
    for folder, _, names in os.walk(staging, topdown=False):
        for name in names:
            sync(Path(folder, name))
            Path(folder, name).chmod(0o444)
        sync(Path(folder))
        Path(folder).chmod(0o555)


def _rename(staging: Path, final: Path) -> None:
    try:
        staging.rename(final)
    except OSError:
        if not final.exists():
            raise
        raise VersionError(
            "was published by another process meanwhile", where=final, remedy="build again"
        ) from None


def _remove_dead(home: Path) -> None:
    """Remove what killed builds left; a living process, or another machine, keeps its own."""
    remove_temporaries(home)
    here = f"{_STAGING}{socket.gethostname()}."
    for folder in home.glob(f"{_STAGING}*"):
        pid = folder.name.removeprefix(here)
        ended = pid.isdigit() and not _alive(int(pid))
        if ended or time.time() - folder.stat().st_mtime > _DEAD_S:
            _remove(folder)


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    # One process publishes one release at a time, so what carries its own number is dead.
    return pid != os.getpid()


def _remove(folder: Path) -> None:
    for inner, _, _ in os.walk(folder):
        Path(inner).chmod(0o755)
    shutil.rmtree(folder)


def _point_to_latest(home: Path) -> None:
    newest = published_versions(home)[-1]
    latest = {
        "product": newest.product,
        "version": format_version(parse_version(newest.version)),
        "manifest_digest": newest.manifest_digest,
    }
    path, data = home / LATEST_NAME, canonical_json(latest)
    if not path.is_file() or path.read_bytes() != data:
        write_bytes(path, data)
