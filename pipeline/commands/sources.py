"""List the public data sets of the catalog, with their terms and whether they are at hand."""

from __future__ import annotations

import argparse

from magtiles.pipeline.output import print_json, print_table

HELP = "list the public data sets that the catalog describes"
NEEDS_PIPELINE = True


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``magtiles sources``."""
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    """Print one line for each source."""
    from magtiles.pipeline.fetching import cache_folder, catalog_sources
    from magtiles.stages.ingest.source import load_header

    found = []
    for name, toml in catalog_sources().items():
        header = load_header(toml)
        here = sum((cache_folder() / name / file).is_file() for file in header.files)
        found.append(
            {
                "id": name,
                "kind": header.kind,
                "title": header.title,
                "licence": header.licence,
                "files": len(header.files),
                "fetched": here,
                "by_program": bool(header.urls),
                "url": header.url,
            }
        )
    if arguments.json:
        print_json(found)
        return 0
    rows = [
        (
            str(one["id"]),
            str(one["kind"]),
            f"{one['fetched']} of {one['files']}",
            str(one["licence"]),
            str(one["title"]),
        )
        for one in found
    ]
    print_table(("id", "kind", "fetched", "licence", "title"), rows)
    return 0
