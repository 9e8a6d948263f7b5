"""Running one stage on files: contracts checked on both sides, receipts kept."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import xarray as xr

from magtiles.pipeline import receipts
from magtiles.pipeline.artifacts import check_artifact, open_artifact, write_artifact
from magtiles.schemas import contracts
from magtiles.schemas.errors import FormatError, UsageError
from magtiles.stages.declare import (
    FILES,
    OPTIONAL_FILE,
    Many,
    OptionalInput,
    Params,
    Stage,
    parse_params,
)
from magtiles.stages.ingest.source import load_header, source_files

_LOG = logging.getLogger(__name__)

_checked: set[tuple[str, str]] = set()
"""(digest, contract) pairs that passed in this process and need no second look."""


@dataclass(frozen=True)
class StageResult:
    """What `run_stage` did: the artifact, whether it was made now, and why (not).

    `dataset` is what was written, where it was made now.
    """

    out: Path
    rebuilt: bool
    reason: str
    dataset: xr.Dataset | None = None


def run_stage(
    stage: Stage,
    inputs: Mapping[str, Path | Sequence[Path]],
    out: Path,
    params: Mapping[str, Any],
    *,
    force: bool = False,
) -> StageResult:
    """Make `out` with a stage unless its receipt says that it is already what it would be.

    Parameters
    ----------
    inputs : role to a path, or to a list of paths for roles of `FILES` and `Many`.
    params : plain values, as from TOML.
    force : run even when nothing changed.

    Raises
    ------
    ParameterError, UsageError, FormatError, ContractError
        The last names the role whose file breaks its contract, or the stage's output.
    """
    parsed = parse_params(stage.params, params, where=f"stage {stage.name}")
    paths = _paths_by_role(stage, inputs, out)
    made_from = receipts.identity(stage, parsed, _with_data_files(stage, paths))
    reason = "forced" if force else receipts.why_stale(out, made_from)
    if reason is None:
        _LOG.info("%s: %s is up to date", stage.name, out)
        return StageResult(out, rebuilt=False, reason="up to date")
    _LOG.info("%s: making %s (%s)", stage.name, out, reason)
    dataset = _make(stage, parsed, paths, out)
    receipts.write_receipt(out, made_from, contracts.resolve(stage.output))
    return StageResult(out, rebuilt=True, reason=reason, dataset=dataset)


def _make(stage: Stage, params: Params, paths: Mapping[str, list[Path]], out: Path) -> xr.Dataset:
    with contextlib.ExitStack() as opened:
        arguments = {
            role: _argument(stage.inputs[role], role, files, opened)
            for role, files in paths.items()
        }
        result: xr.Dataset = stage.run(**arguments, params=params)
        if not result.chunks:  # what is made when it is written is checked then
            contracts.check(result, stage.output, where=f"output of stage {stage.name}")
        write_artifact(result, out, stage.output)
        return result


def _argument(
    kind: str | Many | OptionalInput, role: str, files: list[Path], opened: contextlib.ExitStack
) -> Path | list[Path] | list[xr.Dataset] | xr.Dataset:
    if kind == FILES:
        return files
    if kind == OPTIONAL_FILE:
        return files[0]
    contract = kind if isinstance(kind, str) else kind.contract
    datasets = []
    for path in files:
        _check_input(path, contracts.resolve(contract), role)
        datasets.append(opened.enter_context(open_artifact(path)))
    return datasets if isinstance(kind, Many) else datasets[0]


def _check_input(path: Path, contract: str, role: str) -> None:
    if receipts.was_checked(path, contract):
        return
    key = (receipts.digest(path), contract)
    if key not in _checked:
        check_artifact(path, contract, role=role)
        _checked.add(key)


def _paths_by_role(
    stage: Stage, inputs: Mapping[str, Path | Sequence[Path]], out: Path
) -> dict[str, list[Path]]:
    where = f"stage {stage.name}"
    for role in inputs.keys() - stage.inputs.keys():
        known = ", ".join(stage.inputs)
        raise UsageError(f"unknown role '{role}'", where=where, expected=f"one of {known}")
    paths: dict[str, list[Path]] = {}
    for role, kind in stage.inputs.items():
        given = inputs.get(role, ())
        files = [given] if isinstance(given, Path) else list(given)
        if not files and (kind == OPTIONAL_FILE or isinstance(kind, OptionalInput)):
            continue
        if not files:
            raise UsageError(f"no file for role '{role}'", where=where, remedy=f"give {role}=FILE")
        if len(files) > 1 and not (kind == FILES or isinstance(kind, Many)):
            raise UsageError(f"{len(files)} files for role '{role}'", where=where, expected="one")
        for path in files:
            _check_input_path(path, role, out)
        paths[role] = files
    return paths


def _check_input_path(path: Path, role: str, out: Path) -> None:
    if not path.is_file():
        raise FormatError("no such file", where=f"{path} (role {role})", remedy="check the path")
    if path.resolve() == out.resolve():
        raise UsageError("the output would replace its input", where=f"{path} (role {role})")


def _with_data_files(stage: Stage, paths: Mapping[str, list[Path]]) -> dict[str, list[Path]]:
    """The inputs together with the data files that source TOMLs among them name."""
    complete = dict(paths)
    for role in (role for role, kind in stage.inputs.items() if kind == FILES):
        given = {path.name for path in paths[role]}
        for toml in (path for path in paths[role] if path.suffix.lower() == ".toml"):
            # A file given beside its TOML stands in for the TOML's own of that name.
            named = [
                file for file in source_files(toml, load_header(toml)) if file.name not in given
            ]
            for file in named:
                if not file.is_file():
                    raise FormatError(
                        "no such file", where=file, remedy=f"fetch it, or correct {toml}"
                    )
            complete[role] = [*complete[role], *named]
    return complete
