"""Sign the manifest of a release, which holds the digest of every other file."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "sign a release"
NEEDS_PIPELINE = True


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``magtiles sign``."""
    parser.add_argument("release", type=Path, metavar="RELEASE", help="folder of a release")
    parser.add_argument(
        "--key", type=Path, required=True, metavar="FILE.key", help="a secret key of minisign"
    )


def run(arguments: argparse.Namespace) -> int:
    """Sign, and print the file of the signature."""
    from magtiles.stages.release.sign import sign_release

    print(sign_release(arguments.release, arguments.key))
    print("next:")
    print(f"  magtiles validate {arguments.release} --public-key FILE.pub --require-signature")
    return 0
