"""Write the synthetic samples: a survey, observatories and a field model, with exact truth."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "write the synthetic survey, flight, observatories and field model, with their truth"
NEEDS_PIPELINE = True


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``magtiles sample``."""
    parser.add_argument("folder", type=Path, metavar="DIR", help="where to write")


def run(arguments: argparse.Namespace) -> int:
    """Write the samples and list their files."""
    from magtiles.pipeline.sample import write_sample
    from magtiles.pipeline.sample_model import write_world
    from magtiles.pipeline.synthetic_observatories import TemporalSample

    survey = write_sample(arguments.folder, temporal=TemporalSample())
    for path in [*survey, *write_world(arguments.folder)]:
        print(path)
    return 0
