"""Fetch public data sets by their id in the catalog, or by a source TOML."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "fetch public data sets and check their digests"
NEEDS_PIPELINE = True


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``magtiles fetch``."""
    parser.add_argument(
        "source", nargs="+", metavar="SOURCE", help="an id of the catalog, or a source TOML"
    )
    parser.add_argument(
        "--to",
        type=Path,
        metavar="DIR",
        help="folder for the files (default: a folder of the id in MAGTILES_CACHE)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Fetch each source; print the path and digest of every file."""
    from magtiles.pipeline.fetching import cache_folder, catalog_sources, fetch_source
    from magtiles.schemas.errors import SourceError
    from magtiles.stages.ingest.source import load_header

    known = catalog_sources()
    for name in arguments.source:
        toml = Path(name) if name.endswith(".toml") else known.get(name)
        if toml is None:
            raise SourceError(
                f"the catalog has no source '{name}'",
                expected=f"one of {', '.join(known)}, or the path of a source TOML",
            )
        folder = arguments.to or cache_folder() / load_header(toml).id
        header = load_header(toml)
        for file in fetch_source(toml, folder):
            state = "fetched" if file.fetched else "was there"
            pinned = (
                "" if file.path.name in header.sha256 else "  (no digest stated: note this one)"
            )
            print(f"{file.path}  {state}  sha256 {file.sha256}{pinned}")
    return 0
