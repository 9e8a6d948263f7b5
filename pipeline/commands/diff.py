"""Say what changed from one release to another: which version bump, and by how much."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from magtiles.pipeline.output import print_json, print_table

if TYPE_CHECKING:
    from magtiles.pipeline.difference import Difference

HELP = "say what changed between two releases, and which version bump that is"
NEEDS_PIPELINE = True

_QUANTITIES = ("total", "north", "east", "down", "nn", "ne", "nd", "ee", "ed")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``magtiles diff``."""
    parser.add_argument("old", type=Path, metavar="OLD", help="folder of a release")
    parser.add_argument("new", type=Path, metavar="NEW", help="folder of another")
    parser.add_argument("--map", type=Path, metavar="FILE.png", help="draw new minus old")
    parser.add_argument(
        "--level", type=float, metavar="HEIGHT", help="level to draw, m (default: the lowest)"
    )
    parser.add_argument("--quantity", choices=_QUANTITIES, default="total", help="what to draw")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    """Print the changes; status 1 when the new version says too little of them."""
    from magtiles.pipeline.difference import compare_releases, difference_figure
    from magtiles.pipeline.plotting import save_png

    found = compare_releases(arguments.old, arguments.new)
    if arguments.map is not None:
        figure = difference_figure(
            arguments.old, arguments.new, height=arguments.level, quantity=arguments.quantity
        )
        save_png(figure, arguments.map)
    if arguments.json:
        print_json(found)
    else:
        _print(found)
    return 0 if found.enough else 1


def _print(found: Difference) -> None:
    print(f"{found.old} to {found.new}: {found.reason}")
    if found.bump is not None:
        verdict = "and has it" if found.enough else "and has NOT got it"
        print(f"due a {found.bump.upper()} bump, {verdict}")
    for heights, which in ((found.only_old, "old"), (found.only_new, "new")):
        if heights:
            print(f"levels of the {which} one only: {', '.join(f'{h:g}' for h in heights)} m")
    if len(set(found.height_references)) > 1:
        old, new = (one.replace("_", " ") for one in found.height_references)
        print(f"heights count from {old} in the old, {new} in the new: equal numbers are compared")
    if found.gained or found.lost:
        print(f"coverage: {found.gained} nodes gained, {found.lost} lost")
    if found.interpolated:
        print("the lattices differ: the new one was interpolated at the old one's nodes")
    if found.bump is not None and found.levels:
        _print_values(found)
        _print_sigmas(found)
        for height, count in found.flags.items():
            if count:
                print(f"flags changed at {count} nodes of level {height:g}")


def _print_values(found: Difference) -> None:
    rows = [
        (
            f"{one.height_m:g}",
            one.quantity,
            f"{one.changed / max(one.nodes, 1):.1%}",
            f"{one.rms:.4g}",
            f"{one.largest:.4g}",
            one.unit,
            f"{one.sigmas:.3g}",
            "-" if one.latitude is None else f"{one.latitude:.5f}, {one.longitude:.5f}",
        )
        for one in found.levels
        if one.changed
    ]
    if rows:
        header = ("height", "quantity", "changed", "rms", "largest", "unit", "sigmas", "where")
        print_table(header, rows)
    else:
        print("total, vector and tensor: no value changed")


def _print_sigmas(found: Difference) -> None:
    rows = [
        (
            f"{one.height_m:g}",
            one.of,
            f"{one.changed / one.nodes:.1%}",
            f"{one.median:.4g}",
            f"{one.smallest:.4g}",
            f"{one.largest:.4g}",
        )
        for one in found.sigmas
        if one.changed
    ]
    if rows:
        print_table(("height", "1 sigma of", "changed", "new/old", "least", "most"), rows)
