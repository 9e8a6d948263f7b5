"""Draw a level of a release with its uncertainty and flags, or the artifact in a file."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "draw a level of a release, or a track, as PNG"
NEEDS_PIPELINE = True

TEMPORAL_KINDS = ("quiet-days", "residual", "autocorrelation", "sigma-tau")
_QUANTITIES = ("total", "north", "east", "down", "nn", "ne", "nd", "ee", "ed")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``magtiles plot``."""
    parser.add_argument(
        "release",
        type=Path,
        metavar="RELEASE",
        help="folder of a release, or a file: a track's path, or its compensation; a calibration",
    )
    parser.add_argument(
        "--track", type=Path, metavar="FILE", help="the track that a calibration was made from"
    )
    parser.add_argument(
        "--level", type=float, metavar="HEIGHT", help="height of a level, m (default: the lowest)"
    )
    parser.add_argument("--quantity", choices=_QUANTITIES, default="total", help="what to draw")
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
    from magtiles.pipeline.preview import release_figure

    if arguments.temporal is not None:
        arguments.out.write_bytes(_temporal_picture(arguments.release, *arguments.temporal))
        print(arguments.out)
        return 0
    if arguments.release.is_file():
        from magtiles.pipeline.artifact_plots import artifact_figure

        save_png(artifact_figure(arguments.release, arguments.track), arguments.out)
        print(arguments.out)
        return 0
    figure = release_figure(arguments.release, height=arguments.level, quantity=arguments.quantity)
    save_png(figure, arguments.out)
    print(arguments.out)
    return 0


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
