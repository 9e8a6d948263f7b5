"""Draw a level or a road of a release, with what is doubtful of it, or the artifact in a file."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HELP = "draw a level or a road of a release, or a track, as PNG"
NEEDS_PIPELINE = True

TEMPORAL_KINDS = ("quiet-days", "residual", "autocorrelation", "sigma-tau")
_QUANTITIES = ("total", "north", "east", "down", "nn", "ne", "nd", "ee", "ed")
_OF_ROADS = ("field", "matchability")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``magtiles plot``."""
    parser.add_argument(
        "release",
        type=Path,
        metavar="RELEASE",
        help="folder of a release, or a file: a track's path, or its compensation; a road map; "
        "a calibration",
    )
    parser.add_argument(
        "--track", type=Path, metavar="FILE", help="the track that a calibration was made from"
    )
    parser.add_argument(
        "--level", type=float, metavar="HEIGHT", help="height of a level, m (default: the lowest)"
    )
    parser.add_argument("--road", metavar="NAME", help="a road of the release instead of a level")
    parser.add_argument(
        "--quantity",
        choices=(*_QUANTITIES, *_OF_ROADS),
        help="what to draw of a level (default: total), or what colours a road: "
        + " or ".join(_OF_ROADS),
    )
    parser.add_argument(
        "--temporal",
        nargs=2,
        metavar=("CODE", "KIND"),
        help="an observatory's picture of the release instead, by IAGA code and kind: "
        + ", ".join(TEMPORAL_KINDS),
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.png", help="the picture")


def run(arguments: argparse.Namespace) -> int:
    """Draw and print the path of the picture."""
    from magtiles.pipeline.plotting import save_png

    if arguments.temporal is not None:
        arguments.out.write_bytes(_temporal_picture(arguments.release, *arguments.temporal))
        print(arguments.out)
        return 0
    save_png(_figure(arguments), arguments.out)
    print(arguments.out)
    return 0


def _figure(arguments: argparse.Namespace) -> Figure:
    if arguments.release.is_file():
        from magtiles.pipeline.artifact_plots import artifact_figure

        return artifact_figure(arguments.release, arguments.track)
    _check_quantity(arguments.quantity, of_road=arguments.road is not None)
    if arguments.road is not None:
        return _road_figure(arguments.release, arguments.road, arguments.quantity or "field")
    from magtiles.pipeline.preview import release_figure

    quantity = arguments.quantity or "total"
    return release_figure(arguments.release, height=arguments.level, quantity=quantity)


def _check_quantity(quantity: str | None, *, of_road: bool) -> None:
    known = _OF_ROADS if of_road else _QUANTITIES
    if quantity is not None and quantity not in known:
        from magtiles.schemas.errors import UsageError

        raise UsageError(
            f"is '{quantity}'",
            where="--quantity",
            expected=f"one of {', '.join(known)}",
            remedy="leave --road out" if of_road else "name a road with --road",
        )


def _road_figure(folder: Path, name: str, quantity: str) -> Figure:
    from magtiles.catalog import open_release
    from magtiles.pipeline.artifacts import open_artifact
    from magtiles.pipeline.road_plots import road_figure
    from magtiles.schemas.errors import UsageError

    release = open_release(folder)
    if name not in release.manifest.roads:
        known = ", ".join(sorted(release.manifest.roads))
        raise UsageError(
            f"the release has no road '{name}'",
            where="--road",
            expected=f"one of {known}" if known else "a release with [[roads]]",
        )
    release.roads[name]  # verifies the file, which is then drawn with all that it holds
    with open_artifact(folder / release.manifest.roads[name].path) as road:
        return road_figure(road, "matchability" if quantity == "matchability" else "field")


def _temporal_picture(folder: Path, code: str, kind: str) -> bytes:
    """The verified PNG of an observatory, drawn when the release was made from its record."""
    from magtiles.catalog import open_release
    from magtiles.schemas.errors import UsageError

    release = open_release(folder)
    path = f"preview/temporal-{code}-{kind}.png"
    held = [f.path for f in release.manifest.files if f.path.startswith("preview/temporal-")]
    if path not in held:
        names = (name.removeprefix("preview/temporal-").removesuffix(".png") for name in held)
        words = [" ".join(name.split("-", 1)) for name in names]
        raise UsageError(
            f"the release has no picture '{code} {kind}'",
            where="--temporal",
            expected=f"one of {', '.join(words)}" if words else "a release with observatories",
        )
    return release.file(path)
