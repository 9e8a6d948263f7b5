"""Describe a release in the form of another catalogue: STAC, a collection with an item a tile."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "describe a release as a STAC collection"
NEEDS_PIPELINE = True


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``magtiles export``."""
    parser.add_argument("form", choices=["stac"], metavar="stac", help="the form")
    parser.add_argument("release", type=Path, metavar="RELEASE", help="folder of a release")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new folder")
    parser.add_argument(
        "--base-url",
        metavar="URL",
        help="where the release's folder is published (default: links relative to DIR)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Write the collection and print its file."""
    from magtiles.pipeline.stac import export_stac

    path, items = export_stac(arguments.release, arguments.out, base_url=arguments.base_url)
    print(f"{path}: a collection of {items} items")
    return 0
