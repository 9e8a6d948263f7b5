"""Write the synthetic sample survey with its exact truth and its TOML files."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "write the synthetic sample survey and its truth"
NEEDS_PIPELINE = True


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``magtiles sample``."""
    parser.add_argument("folder", type=Path, metavar="DIR", help="where to write")


def run(arguments: argparse.Namespace) -> int:
    """Write the sample and list its files."""
    from magtiles.pipeline.sample import write_sample

    for path in write_sample(arguments.folder):
        print(path)
    return 0
