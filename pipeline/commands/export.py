"""Describe a release in another form: a STAC collection, or its roads as GeoJSON."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "describe a release as a STAC collection, or its roads as GeoJSON"
NEEDS_PIPELINE = True


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``magtiles export``."""
    parser.add_argument(
        "form",
        choices=["stac", "geojson"],
        help="stac: a collection with an item a tile; geojson: a file a road",
    )
    parser.add_argument("release", type=Path, metavar="RELEASE", help="folder of a release")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new folder")
    parser.add_argument(
        "--base-url",
        metavar="URL",
        help="of stac: where the release's folder is published (default: links relative to DIR)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Write the files and print them."""
    if arguments.form == "geojson":
        return _geojson(arguments)
    from magtiles.pipeline.stac import export_stac

    path, items = export_stac(arguments.release, arguments.out, base_url=arguments.base_url)
    print(f"{path}: a collection of {items} items")
    return 0


def _geojson(arguments: argparse.Namespace) -> int:
    from magtiles.pipeline.road_geojson import export_geojson
    from magtiles.schemas.errors import UsageError

    if arguments.base_url is not None:
        raise UsageError("GeoJSON has no links", where="--base-url", remedy="leave it out")
    for path, count in export_geojson(arguments.release, arguments.out):
        print(f"{path}: {count} features")
    return 0
