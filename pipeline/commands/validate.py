"""Check a release: contracts, digests, coverage, overlaps, physics, and its own answers."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from magtiles.pipeline.output import print_json, print_table
from magtiles.schemas.errors import UsageError

if TYPE_CHECKING:
    from magtiles.pipeline.validate import Check

HELP = "check a release against its contracts and its physics"
NEEDS_PIPELINE = True


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``magtiles validate``."""
    parser.add_argument("release", type=Path, metavar="RELEASE", help="folder of a release")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument(
        "--public-key", type=Path, metavar="FILE.pub", help="the publisher's minisign key"
    )
    parser.add_argument(
        "--require-signature", action="store_true", help="fail where the release is not signed"
    )
    parser.add_argument("--junit", type=Path, metavar="FILE.xml", help="write JUnit XML too")


def run(arguments: argparse.Namespace) -> int:
    """Print every check; status 1 when any fails."""
    from magtiles.pipeline.validate import validate_release

    if arguments.require_signature and arguments.public_key is None:
        raise UsageError("--require-signature is given without --public-key FILE.pub")
    checks = validate_release(
        arguments.release,
        public_key=arguments.public_key,
        require_signature=arguments.require_signature,
    )
    passed = all(check.passed for check in checks)
    if arguments.junit is not None:
        from magtiles.pipeline.junit import write_junit

        write_junit(checks, arguments.release, arguments.junit)
    if arguments.json:
        print_json({"release": arguments.release, "passed": passed, "checks": checks})
    else:
        _print_checks(checks)
    return 0 if passed else 1


def _print_checks(checks: list[Check]) -> None:
    rows = [
        (
            "ok" if check.passed else "FAILED",
            check.name,
            "-" if check.measured is None else f"{check.measured:.4g}",
            "-" if check.bound is None else f"{check.bound:.4g}",
            check.unit,
            check.where,
        )
        for check in checks
    ]
    print_table(("", "check", "measured", "bound", "unit", "where"), rows)
    failed = sum(not check.passed for check in checks)
    print(f"{len(checks)} checks, {failed} failed" if failed else f"{len(checks)} checks passed")
