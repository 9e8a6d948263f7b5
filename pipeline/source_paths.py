"""Where the sources that a product names are: beside it, or in the catalog."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from magtiles.schemas.errors import SourceError


def find_source(name: str, product: Path, key: str) -> Path:
    """The source TOML that `key` of a product names: a path beside it, or an id of the catalog.

    Raises SourceError naming the product and the key.
    """
    if name.endswith(".toml"):
        found = product.parent / name
        if found.is_file():
            return found
        raise SourceError(
            f"source '{name}' does not exist",
            where=f"{product} {key}",
            expected=f"a file at {found}",
            remedy="correct the path",
        )
    entry = Path(str(resources.files("magtiles.catalog"))) / "sources" / f"{name}.toml"
    if entry.is_file():
        return entry
    raise SourceError(
        f"the catalog has no source '{name}'",
        where=f"{product} {key}",
        expected="the path of a source TOML, or an id in the catalog",
        remedy="write the path with its .toml",
    )
