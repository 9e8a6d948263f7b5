"""The public data sets that the catalog describes: what there is, and fetching it.

Data are never part of the project: `fetch_source` gets them with pooch from where their
publishers keep them, and checks every digest that their description states.
"""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import tarfile
import tempfile
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import resources
from pathlib import Path, PurePosixPath
from typing import IO
from urllib.parse import urlsplit

from magtiles.schemas.errors import FormatError, IntegrityError, MagtilesError, SourceError
from magtiles.stages.ingest.source import SourceParams, load_header
from magtiles.stages.release.atomic import atomic_path

_LOG = logging.getLogger(__name__)
_BLOCK_BYTES = 1 << 20
_SECONDS = 60


@dataclass(frozen=True)
class FetchedFile:
    """A file of a source: its digest, and whether it was fetched now or was there before."""

    path: Path
    sha256: str
    fetched: bool


def catalog_sources() -> dict[str, Path]:
    """The source TOML of every data set in the catalog, by id, in order of ids."""
    folder = Path(str(resources.files("magtiles.catalog"))) / "sources"
    return {load_header(toml).id: toml for toml in sorted(folder.glob("*.toml"))}


def cache_folder() -> Path:
    """Where fetched data are kept: the folder that MAGTILES_CACHE names, or the user's cache."""
    if named := os.environ.get("MAGTILES_CACHE"):
        return Path(named)
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "magtiles"


def fetch_source(toml: Path, folder: Path) -> list[FetchedFile]:
    """Fetch every file of the source TOML `toml` that is not in `folder` yet.

    Raises
    ------
    SourceError : the TOML says not where to fetch from.
    MagtilesError : the network or the server failed; whole files that came before are kept.
    IntegrityError : a file is not the one whose digest is stated; it is not kept.
    FormatError : an archive is damaged or lacks a file.
    """
    header = load_header(toml)
    missing = [name for name in header.files if not (folder / name).is_file()]
    if missing and not header.urls:
        raise SourceError(
            "key 'urls' is missing: its files cannot be fetched by a program",
            where=f"{toml} [source]",
            remedy=f"get {', '.join(missing)} by hand from {header.url or 'its publisher'} "
            f"into {folder}",
        )
    folder.mkdir(parents=True, exist_ok=True)
    for url in header.urls:
        name = PurePosixPath(urlsplit(url).path).name
        if name in missing:
            _fetch_file(url, folder / name)
        elif missing and name not in header.files:
            _fetch_archive(url, missing, folder)
    return [_checked(folder / name, header, name in missing, toml) for name in header.files]


def _fetch_file(url: str, out: Path) -> None:
    with tempfile.TemporaryDirectory(prefix=".fetch-", dir=out.parent) as temporary:
        _retrieve(url, Path(temporary)).rename(out)


def _fetch_archive(url: str, wanted: list[str], folder: Path) -> None:
    """Keep the `wanted` files of an archive."""
    with tempfile.TemporaryDirectory(prefix=".fetch-", dir=folder) as temporary:
        for name, content in _members(_retrieve(url, Path(temporary)), url):
            if name in wanted:
                with atomic_path(folder / name) as out, out.open("wb") as file:
                    shutil.copyfileobj(content, file, _BLOCK_BYTES)


def _retrieve(url: str, folder: Path) -> Path:
    import pooch

    _LOG.info("fetching %s", url)
    pooch.get_logger().setLevel(logging.WARNING)
    name = PurePosixPath(urlsplit(url).path).name
    downloader = pooch.HTTPDownloader(timeout=_SECONDS)
    try:
        return Path(pooch.retrieve(url, None, fname=name, path=folder, downloader=downloader))
    except (OSError, ValueError) as caught:  # what requests raises is an OSError
        raise MagtilesError(
            f"cannot be fetched: {caught}",
            where=url,
            remedy="check the network and the address, or get the file by hand",
        ) from None


def _members(path: Path, url: str) -> Iterator[tuple[str, IO[bytes]]]:
    """Name, without folders, and content of each file of an archive."""
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                for info in archive.infolist():
                    with archive.open(info) as content:
                        yield PurePosixPath(info.filename).name, content
            return
        with tarfile.open(path) as tar:
            for entry in tar:
                found = tar.extractfile(entry) if entry.isfile() else None
                if found is not None:
                    yield PurePosixPath(entry.name).name, found
    except (zipfile.BadZipFile, tarfile.TarError, EOFError) as caught:
        raise FormatError(f"is not a whole archive: {caught}", where=url) from None


def _checked(path: Path, header: SourceParams, fetched: bool, toml: Path) -> FetchedFile:
    if not path.is_file():
        raise FormatError(
            f"'{path.name}' was in nothing that was fetched",
            where=f"{toml} [source] urls",
            remedy="correct the addresses, or the names of the files",
        )
    with path.open("rb") as file:
        found = hashlib.file_digest(file, "sha256").hexdigest()
    stated = header.sha256.get(path.name)
    if stated is not None and stated.lower() != found:
        if fetched:
            path.unlink()
        raise IntegrityError(
            f"sha256 is {found}",
            where=path,
            expected=f"{stated} as {toml.name} states",
            remedy="fetch it again, or correct the digest if its publisher replaced the file",
        )
    return FetchedFile(path, found, fetched)
