"""The command line: ``magtiles COMMAND ...``.

Imports only what a reader-only installation has; commands import the rest when they run.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.metadata
import importlib.util
import logging
import os
import re
import sys
import traceback
from collections.abc import Iterator, Sequence
from types import ModuleType

from magtiles.pipeline.commands import (
    build,
    diff,
    export,
    fetch,
    info,
    keygen,
    plot,
    query,
    report,
    run,
    sample,
    sign,
    sources,
    stages,
    validate,
)
from magtiles.schemas.errors import MagtilesError, UsageError

COMMANDS: tuple[ModuleType, ...] = (
    build,
    validate,
    diff,
    info,
    query,
    plot,
    report,
    keygen,
    sign,
    export,
    sample,
    sources,
    fetch,
    stages,
    run,
)
"""Each offers HELP, NEEDS_PIPELINE, add_arguments(parser) and run(arguments) -> exit status."""

BAD_DATA, BAD_USE, INTERRUPTED, BROKEN_PIPE = 1, 2, 130, 141

_EXTRA = (
    "cdflib",
    "cryptography",
    "distributed",
    "google.protobuf",
    "h5py",
    "harmonica",
    "jsonschema",
    "lz4",
    "matplotlib",
    "mcap",
    "pandas",
    "pooch",
    "ppigrf",
    "pydantic",
    "pyproj",
    "pystac",
    "pyulog",
    "rasterio",
    "rich",
    "scipy",
    "verde",
    "xarray",
    "zstandard",
)
_NEGATIVE_NUMBERS = re.compile(r"-\.?\d[-+.,\deE]*")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status and raises nothing.

    0 done, 1 bad data, 2 bad use (or a missing extra), 130 interrupted, 141 broken pipe.
    """
    given = sys.argv[1:] if argv is None else list(argv)
    try:
        arguments = _parser().parse_args(
            [_shield(word) for word in given], argparse.Namespace(verbose=0, quiet=False)
        )
    except SystemExit as leaving:  # argparse has printed the help, the version or the error
        return leaving.code if isinstance(leaving.code, int) else BAD_USE
    command: ModuleType = arguments.command
    if command.NEEDS_PIPELINE and not _has_extra():
        print('this command needs: pip install "magtiles[pipeline]"', file=sys.stderr)
        return BAD_USE
    with _logging(arguments.verbose, arguments.quiet):
        return _guarded(command, arguments)


def _guarded(command: ModuleType, arguments: argparse.Namespace) -> int:
    try:
        status: int = command.run(arguments)
        sys.stdout.flush()  # a closed pipe shows up here, not at interpreter exit
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:
        # Python flushes stdout once more at exit: give it somewhere to go.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except UsageError as error:
        return _report(error, str(error), arguments, BAD_USE)
    except MagtilesError as error:
        return _report(error, str(error), arguments, BAD_DATA)
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        return _report(error, f"{place}{error.strerror or error}", arguments, BAD_DATA)
    except MemoryError as error:
        text = "not enough memory: ask for less at once (a region, a wider spacing), or add some"
        return _report(error, text, arguments, BAD_DATA)
    except Exception as error:  # a fault of ours; still not a bare traceback
        text = f"internal error, please report it: {type(error).__name__}: {error}"
        return _report(error, text + " (-vv shows where)", arguments, BAD_DATA)
    return status


def _report(error: Exception, text: str, arguments: argparse.Namespace, status: int) -> int:
    print(f"magtiles: error: {text}", file=sys.stderr)
    if arguments.verbose >= 2:
        traceback.print_exception(error, file=sys.stderr)
    return status


def _parser() -> argparse.ArgumentParser:
    common = argparse.ArgumentParser(add_help=False)
    volume = common.add_argument_group("logging")
    # SUPPRESS: a default of the sub-command would overwrite what stood before its name.
    volume.add_argument(
        "-v",
        "--verbose",
        action="count",
        default=argparse.SUPPRESS,
        help="say what is done; twice for details and tracebacks",
    )
    volume.add_argument(
        "-q", "--quiet", action="store_true", default=argparse.SUPPRESS, help="errors only"
    )
    parser = argparse.ArgumentParser(
        prog="magtiles",
        description="Versioned, verified magnetic anomaly maps for navigation.",
        parents=[common],
        allow_abbrev=False,
    )
    version = importlib.metadata.version("magtiles")
    parser.add_argument("--version", action="version", version=f"magtiles {version}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for module in COMMANDS:
        name = module.__name__.rpartition(".")[2]
        sub = commands.add_parser(
            name,
            help=module.HELP,
            description=module.__doc__,
            parents=[common],
            allow_abbrev=False,
        )
        module.add_arguments(sub)
        sub.set_defaults(command=module)
    return parser


def _shield(word: str) -> str:
    # argparse takes "-104.5,-103" for an option unless it holds a space.
    return f" {word}" if _NEGATIVE_NUMBERS.fullmatch(word) else word


def _has_extra() -> bool:
    return all(_is_there(name) for name in _EXTRA)


def _is_there(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:  # the package that `name` is in
        return False


@contextlib.contextmanager
def _logging(verbose: int, quiet: bool) -> Iterator[None]:
    levels = {0: logging.WARNING, 1: logging.INFO}
    logger = logging.getLogger("magtiles")
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(levelname)s %(name)s: %(message)s"))
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.ERROR if quiet else levels.get(verbose, logging.DEBUG))
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)
