"""List the stages with their roles, contracts and parameters."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from magtiles.pipeline.output import print_json

if TYPE_CHECKING:
    from magtiles.stages.declare import Many, OptionalInput, Stage

HELP = "list the stages with their roles, contracts and parameters"
NEEDS_PIPELINE = True


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``magtiles stages``."""
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    """Print every registered stage."""
    from magtiles.stages.registry import STAGES

    described = [describe(stage) for stage in STAGES]
    if arguments.json:
        print_json(described)
        return 0
    for stage in described:
        roles = ", ".join(f"{role}={kind}" for role, kind in stage["inputs"].items())
        print(f"{stage['name']} (version {stage['version']}): {roles} -> {stage['output']}")
        for parameter in stage["params"]:
            print("    " + _line(parameter))
    return 0


def describe(stage: Stage) -> dict[str, Any]:
    """A stage as plain values; a parameter without key `default` must be given."""
    return {
        "name": stage.name,
        "version": stage.version,
        "inputs": {role: _kind(kind) for role, kind in stage.inputs.items()},
        "output": stage.output,
        "params": _describe_params(stage),
    }


def _describe_params(stage: Stage) -> list[dict[str, Any]]:
    described = []
    for name, field in stage.params.model_fields.items():
        extra = field.json_schema_extra
        unit = extra.get("unit") if isinstance(extra, dict) else None
        entry: dict[str, Any] = {"name": name, "unit": unit, "doc": field.description}
        if not field.is_required():
            entry["default"] = field.get_default(call_default_factory=True)
        described.append(entry)
    return described


def _kind(kind: str | Many | OptionalInput) -> str:
    from magtiles.stages.declare import Many

    if isinstance(kind, str):
        return kind
    return f"{kind.contract} ({'one or more' if isinstance(kind, Many) else 'or none'})"


def _line(parameter: dict[str, Any]) -> str:
    unit = f" [{parameter['unit']}]" if parameter["unit"] not in (None, "1") else ""
    default = f" = {parameter['default']}" if "default" in parameter else " (required)"
    return f"{parameter['name']}{unit}{default}: {parameter['doc'] or ''}"
