"""Draw a level of a release: map with hillshade, uncertainty and flags beside it."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "draw a level of a release as PNG"
NEEDS_PIPELINE = True

_QUANTITIES = ("total", "north", "east", "down", "nn", "ne", "nd", "ee", "ed")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``magtiles plot``."""
    parser.add_argument("release", type=Path, metavar="RELEASE", help="folder of a release")
    parser.add_argument(
        "--level", type=float, metavar="HEIGHT", help="height of a level, m (default: the lowest)"
    )
    parser.add_argument("--quantity", choices=_QUANTITIES, default="total", help="what to draw")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.png", help="the picture")


def run(arguments: argparse.Namespace) -> int:
    """Draw and print the path of the picture."""
    from magtiles.pipeline.plotting import save_png
    from magtiles.pipeline.preview import release_figure

    figure = release_figure(arguments.release, height=arguments.level, quantity=arguments.quantity)
    save_png(figure, arguments.out)
    print(arguments.out)
    return 0
