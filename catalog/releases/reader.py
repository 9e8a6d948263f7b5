"""Opening a release."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from functools import cached_property, partial
from pathlib import Path

from magtiles.catalog.releases.expected import ReleaseAnomaly, core_field
from magtiles.catalog.releases.folder import check_folder, read_bytes, read_verified
from magtiles.catalog.releases.manifest import (
    MANIFEST_NAME,
    MAX_MANIFEST_BYTES,
    SIGNATURE_NAME,
    UNLISTED,
    Manifest,
    parse_manifest,
)
from magtiles.catalog.releases.roads import Roads
from magtiles.catalog.releases.signature import check_signature, read_public_key
from magtiles.catalog.releases.store import DEFAULT_CACHE_BYTES, TileStore
from magtiles.catalog.releases.temporal import TemporalModel
from magtiles.catalog.releases.temporal_file import read_temporal
from magtiles.catalog.releases.tile import TileData
from magtiles.schemas.errors import IntegrityError, QueryError, UsageError

_LOG = logging.getLogger(__name__)


class Release:
    """An open release, from `open_release`. Safe to share between threads."""

    def __init__(
        self, path: Path, manifest: Manifest, allow_extrapolated: bool, cache_bytes: int
    ) -> None:
        self.path = path
        self.manifest = manifest
        # Not the bound method: in a cycle, tiles would be closed by whichever thread collects it.
        self._read = partial(_read_file, path, manifest)
        self._extrapolate = allow_extrapolated
        self._store = TileStore(path, manifest, cache_bytes)

    @cached_property
    def anomaly(self) -> ReleaseAnomaly:
        """Queries of the anomaly, and of the whole field that is expected with it."""
        return ReleaseAnomaly(self.manifest, self._store, self._extrapolate, self._read)

    @cached_property
    def temporal(self) -> TemporalModel:
        """The model of time variations; raises QueryError when the release has none.

        Verified when it is first asked for: IntegrityError when it is not what the manifest
        says.
        """
        record = self.manifest.temporal
        if record is None:
            raise self._lacks("temporal model")
        manifest, read = self.manifest, self._read
        return TemporalModel(
            read_temporal(read(record.path), self.path / record.path),
            lambda: core_field(manifest, read),
            f"release {self.manifest.product} {self.manifest.version}",
            allow_extrapolated=self._extrapolate,
        )

    @cached_property
    def roads(self) -> Roads:
        """Maps of roads by name, each verified when it is first asked for.

        Raises QueryError when the release has none.
        """
        if not self.manifest.roads:
            raise self._lacks("road maps")
        return Roads(self.path, self.manifest, self._read)

    def tiles(self) -> Iterator[TileData]:
        """Every tile, whole: size, sha256, contract and lattice verified. IntegrityError."""
        return self._store.read_all()

    def file(self, path: str) -> bytes:
        """The verified bytes of one file of the release, by its path in the manifest."""
        return self._read(path)

    def __repr__(self) -> str:
        return f"<Release {self.manifest.product} {self.manifest.version} at {self.path}>"

    def _lacks(self, what: str) -> QueryError:
        return QueryError(
            f"has no {what}", where=f"release {self.manifest.product} {self.manifest.version}"
        )


def _read_file(folder: Path, manifest: Manifest, path: str) -> bytes:
    for record in manifest.files:
        if record.path == path:
            return read_verified(folder / path, size=record.size, digest=record.sha256)
    raise IntegrityError("is not part of the release", where=folder / path)


def open_release(
    path: str | os.PathLike[str],
    *,
    allow_extrapolated: bool = False,
    cache_bytes: int = DEFAULT_CACHE_BYTES,
    public_key: str | os.PathLike[str] | None = None,
    require_signature: bool = False,
) -> Release:
    """Open a release folder, ``<store>/<product>/<version>``.

    Checks the manifest, and that the folder holds exactly the files it lists, of their sizes;
    a tile's sha256 and contract are checked when it is first touched. Nothing is executed.

    Parameters
    ----------
    path : the folder that holds ``manifest.json``.
    allow_extrapolated : answer with numbers, not NaN, where the map is beyond its coverage.
    cache_bytes : memory for tiles and their splines; least recently used tiles go first, and
        one tile is always kept.
    public_key : file of the publisher's minisign key; a wrong signature is then refused (this
        needs the package cryptography).
    require_signature : refuse a release without a signature, too.

    Raises
    ------
    IntegrityError : the release is not what its manifest says, is no release, or not signed.
    FormatError : the file of the public key holds none.
    UsageError : a signature is required without a key, or cryptography is not installed.
    """
    folder = Path(path)
    if not (folder / MANIFEST_NAME).is_file():
        raise IntegrityError(
            "is no release", where=folder, expected=f"a folder with {MANIFEST_NAME}",
            remedy="give <store>/<product>/<version>",
        )  # fmt: skip
    manifest = _read_manifest(folder, public_key, require_signature)
    check_folder(folder, {file.path: file.size for file in manifest.files}, UNLISTED)
    return Release(folder, manifest, allow_extrapolated, cache_bytes)


def _read_manifest(
    folder: Path, public_key: str | os.PathLike[str] | None, required: bool
) -> Manifest:
    """Read the manifest, whose very bytes are proven to be signed where a key is given."""
    where = folder / MANIFEST_NAME
    data = read_bytes(where, limit=MAX_MANIFEST_BYTES)
    if public_key is not None:
        key = read_public_key(Path(public_key))
        if check_signature(data, folder / SIGNATURE_NAME, key, required=required) is None:
            _LOG.warning("%s is not signed", folder)
    elif required:
        raise UsageError(
            "a signature is required, but no public key given", remedy="give public_key"
        )
    return parse_manifest(data, where)
