"""Write the synthetic samples: survey, flight, drives, observatories, field model, and truth."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "write the synthetic survey, flight, drives, observatories and field model, with their truth"
NEEDS_PIPELINE = True


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``magtiles sample``."""
    parser.add_argument("folder", type=Path, metavar="DIR", help="where to write")
    parser.add_argument("--suburb", action="store_true", help="drives of a suburb, too (8 MB)")


def run(arguments: argparse.Namespace) -> int:
    """Write the samples and list their files."""
    from magtiles.pipeline.sample import write_sample
    from magtiles.pipeline.sample_drives import ROADS, SUBURB, roads_tables, write_drives
    from magtiles.pipeline.sample_model import write_world
    from magtiles.pipeline.synthetic_observatories import TemporalSample

    folder: Path = arguments.folder
    survey = write_sample(folder, temporal=TemporalSample(), roads=roads_tables("drives"))
    roads = (*ROADS, SUBURB) if arguments.suburb else ROADS
    for path in [*survey, *write_world(folder), *write_drives(folder / "drives", roads)]:
        print(path)
    return 0
