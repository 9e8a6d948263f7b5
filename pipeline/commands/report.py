"""Write one HTML page about a release: maps, spectra, uncertainty, checks, provenance."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "write one offline HTML page about a release"
NEEDS_PIPELINE = True


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``magtiles report``."""
    parser.add_argument("release", type=Path, metavar="RELEASE", help="folder of a release")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.html", help="the page")


def run(arguments: argparse.Namespace) -> int:
    """Write the page and print its path; status 1 when a check failed, which the page shows."""
    from magtiles.pipeline.report import write_report

    passed = write_report(arguments.release, arguments.out)
    print(arguments.out)
    return 0 if passed else 1
