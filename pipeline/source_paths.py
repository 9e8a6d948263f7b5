"""Where the sources that a product names are: beside it, or in the catalog."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from magtiles.pipeline import receipts
from magtiles.pipeline.fetching import cache_folder, catalog_sources
from magtiles.schemas.errors import MissingInputError, SourceError
from magtiles.stages.ingest.source import Source

_CATALOG = Path(str(resources.files("magtiles.catalog"))) / "sources"


def find_source(name: str, product: Path, key: str) -> Path:
    """The source TOML that `key` of a product names: a path beside it, or an id of the catalog.

    Raises SourceError naming the product and the key.
    """
    if name.endswith(".toml"):
        found = product.parent / name
        if found.is_file():
            return found
        raise MissingInputError(
            f"source '{name}' does not exist",
            where=f"{product} {key}",
            expected=f"a file at {found}",
            remedy="correct the path",
        )
    known = catalog_sources()
    if name in known:
        return known[name]
    raise SourceError(
        f"the catalog has no source '{name}'",
        where=f"{product} {key}",
        expected=f"the path of a source TOML, or an id of the catalog: {', '.join(known)}",
        remedy="write the path with its .toml",
    )


def data_files(source: Source[Any], data: Path | None) -> list[Path]:
    """A source's data files: in `data` where it is given, else where they belong.

    That is beside the source TOML, or for a source of the catalog where `magtiles fetch` puts them.
    """
    if data is None and source.path.parent == _CATALOG:
        data = cache_folder() / source.source.id
    return list(source.files) if data is None else [data / file.name for file in source.files]


def check_there(source: Source[Any], data: Path | None) -> None:
    """Raise MissingInputError for a source whose data files are not all there."""
    files = data_files(source, data)
    missing = [file for file in files if not file.is_file()]
    if not missing:
        return
    fetched = source.path.parent == _CATALOG and data is None
    raise MissingInputError(
        f"{len(missing)} of the {len(files)} data files of '{source.source.id}' "
        f"{'is' if len(missing) == 1 else 'are'} missing: no file {missing[0]}",
        where=source.path,
        remedy=f"run magtiles fetch {source.source.id}"
        if fetched
        else "put it there, or name the folder where it is with --from",
    )


def manifest_inputs(source: Source[Any], files: Sequence[Path], role: str) -> list[dict[str, str]]:
    """What a manifest says of a source: each of its data files, with digest and licence."""
    header = source.source
    return [
        {
            "id": f"{header.id}/{file.name}" if len(files) > 1 else header.id,
            "sha256": receipts.digest(file),
            "licence": header.licence,
            "role": role,
        }
        for file in files
    ]
