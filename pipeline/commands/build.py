"""Build the release of a product and publish it in a store."""

from __future__ import annotations

import argparse
from pathlib import Path

from magtiles.pipeline.output import print_json

HELP = "build and publish the release of a product"
NEEDS_PIPELINE = True


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``magtiles build``."""
    parser.add_argument("product", type=Path, metavar="PRODUCT.toml", help="the product")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument(
        "--store", type=Path, required=True, metavar="DIR", help="the folder of all releases"
    )
    parser.add_argument(
        "--work",
        type=Path,
        default=Path("build/work"),
        metavar="DIR",
        help="intermediate files and their receipts (default: %(default)s)",
    )
    parser.add_argument(
        "--from",
        dest="data",
        type=Path,
        metavar="DATA_DIR",
        help="where the files of sources lie (default: beside each source TOML)",
    )
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="dask scheduler to work with, such as tcp://host:8786, whose workers see the folder "
        "--work (default: a cluster on this machine, where that pays)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Build, publish, and print the folder of the release."""
    from magtiles.pipeline.build import build_product
    from magtiles.pipeline.progress import progress_bar

    with progress_bar(quiet=arguments.quiet) as progress:
        result = build_product(
            arguments.product,
            store=arguments.store,
            work=arguments.work,
            data=arguments.data,
            progress=progress,
            scheduler=arguments.scheduler,
        )
    if arguments.json:
        print_json(result)
        return 0
    print(f"{result.path}: {'published' if result.changed else 'is already published, unchanged'}")
    print("next:")
    for command in (f"info {result.path}", f"plot {result.path} --out map.png"):
        print(f"  magtiles {command}")
    return 0
