"""Run one stage alone on files. Values of parameters are TOML: 2000.0, [1, 2], "text"."""

from __future__ import annotations

import argparse
import tomllib
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magtiles.pipeline.output import print_json
from magtiles.schemas.errors import UsageError

if TYPE_CHECKING:
    from magtiles.stages.declare import Stage

HELP = "run one stage on files"
NEEDS_PIPELINE = True


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``magtiles run``."""
    parser.add_argument("stage", metavar="STAGE", help="a name that 'magtiles stages' lists")
    parser.add_argument(
        "--in",
        dest="inputs",
        metavar="ROLE=FILE",
        action="append",
        default=[],
        help="an input; repeat it for more roles and more files of one role",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="what to write")
    parser.add_argument(
        "--param",
        dest="params",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        help="a parameter; the value is TOML",
    )
    parser.add_argument("--force", action="store_true", help="run even when nothing changed")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run the stage and say whether the output was made, and why."""
    from magtiles.pipeline.runner import run_stage
    from magtiles.stages.declare import parse_params

    inputs = _inputs(arguments.inputs)
    stage = find_stage(arguments.stage, inputs)
    params = parse_assignments(arguments.params)
    parse_params(stage.params, params, where=f"stage {stage.name}", error=UsageError)
    result = run_stage(stage, inputs, arguments.out, params, force=arguments.force)
    if arguments.json:
        print_json(result)
    else:
        print(f"{result.out}: {'made' if result.rebuilt else 'kept'} ({result.reason})")
    return 0


def parse_assignments(words: list[str]) -> dict[str, Any]:
    """Parameters from ``key=value`` words with TOML values.

    Raises UsageError that names the word: no ``=``, given twice, or no TOML.
    """
    values: dict[str, Any] = {}
    for word in words:
        key, text = _split(word, "--param", "KEY=VALUE")
        if key in values:
            raise UsageError("given twice", where=f"--param {key}")
        values[key] = _toml_value(key, text)
    return values


def _toml_value(key: str, text: str) -> Any:
    try:
        table = tomllib.loads(f"value = {text}")
    except tomllib.TOMLDecodeError:
        table = {}
    if table.keys() != {"value"}:
        raise UsageError(
            f"{text!r} is no TOML value",
            where=f"--param {key}",
            remedy=f"""for text, quote it: --param '{key}="{text}"'""",
        )
    return table["value"]


def _inputs(words: list[str]) -> dict[str, list[Path]]:
    files: dict[str, list[Path]] = {}
    for word in words:
        role, path = _split(word, "--in", "ROLE=FILE")
        files.setdefault(role, []).append(Path(path))
    return files


def _split(word: str, option: str, form: str) -> tuple[str, str]:
    key, equals, value = word.partition("=")
    if not (key and equals and value):
        raise UsageError(f"found {word!r}", where=option, expected=form)
    return key.strip(), value


def find_stage(name: str, roles: Collection[str]) -> Stage:
    """The stage of a name; of several, the one that takes `roles`, else the first.

    Raises UsageError for an unknown name.
    """
    from magtiles.stages.registry import STAGES

    named = [stage for stage in STAGES if stage.name == name]
    if not named:
        known = ", ".join(dict.fromkeys(stage.name for stage in STAGES))
        raise UsageError(f"no stage named '{name}'", expected=f"one of {known}")
    return next((stage for stage in named if stage.inputs.keys() >= set(roles)), named[0])
