"""Make a pair of keys to sign releases with, in minisign's format, without a password."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "make keys to sign releases with"
NEEDS_PIPELINE = True


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``magtiles keygen``."""
    parser.add_argument(
        "--secret", type=Path, required=True, metavar="FILE.key", help="the key to keep secret"
    )
    parser.add_argument(
        "--public", type=Path, required=True, metavar="FILE.pub", help="the key to hand out"
    )


def run(arguments: argparse.Namespace) -> int:
    """Write both files and print the id of the key."""
    from magtiles.stages.release.sign import generate_keys

    key = generate_keys(arguments.secret, arguments.public)
    print(f"{arguments.public}: key {key.name}")
    print("next:")
    print(f"  magtiles sign RELEASE --key {arguments.secret}")
    return 0
