"""Write the synthetic samples: a survey with its exact truth, and a field model, with TOML files."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "write the synthetic survey, its truth, and a synthetic field model"
NEEDS_PIPELINE = True


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``magtiles sample``."""
    parser.add_argument("folder", type=Path, metavar="DIR", help="where to write")


def run(arguments: argparse.Namespace) -> int:
    """Write the samples and list their files."""
    from magtiles.pipeline.sample import write_sample
    from magtiles.pipeline.sample_model import write_world

    for path in [*write_sample(arguments.folder), *write_world(arguments.folder)]:
        print(path)
    return 0
