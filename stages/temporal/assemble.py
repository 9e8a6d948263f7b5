"""Temporal models of many observatories, months and parts as one: ``assemble-temporal``."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from magtiles.schemas.errors import ContractError
from magtiles.stages.declare import Many, Params, Stage
from magtiles.stages.temporal.dip import dip_latitude

_KEYS = {"observatory": "iaga_code", "segment": "segment_start"}
"""Dimension to the variable that tells its entries apart; others are told by their own name."""

_CLASS = ("class_kp", "class_season", "class_local_time")

_UNKNOWN = {"tau_unidentified": 1, "class_tau_unidentified": 1}
"""What an integer is where nothing was estimated; 0 for those not named."""

_ALIKE = ("segment_s", "cadence_s")


class AssembleTemporalParams(Params):
    """Parameters of assemble-temporal: none."""


def assemble_temporal(
    models: Sequence[xr.Dataset], *, params: AssembleTemporalParams
) -> xr.Dataset:
    """The union of temporal models over observatories, months, segments and classes.

    An observatory may come in several models: curves in one and statistics in another, or
    months apart. What no model says is missing. Observatories are in the order of their codes,
    times ascend. `dip_latitude` is that of the IGRF in the middle of all months and segments.

    Raises ContractError where two models say different things of the same observatory, where
    their segments differ in length, or their curves in minutes.
    """
    keyed = [_keyed(model) for model in models]
    merged = functools.reduce(_merge, keyed)
    merged = merged.sortby([d for d in ("observatory", "month", "segment") if d in merged.dims])
    result = _unkeyed(merged, models)
    latitude, longitude, elevation = (
        result[name].values for name in ("latitude", "longitude", "elevation")
    )
    result["dip_latitude"].values = dip_latitude(latitude, longitude, elevation, _middle(result))
    result.attrs = _attributes(models)
    return result


def _keyed(model: xr.Dataset) -> xr.Dataset:
    """The model with every dimension labelled and integers as floats, so that NaN is missing."""
    labels: dict[str, Any] = {d: model[k].values for d, k in _KEYS.items() if k in model}
    if "rank" in model.dims:
        labels["rank"] = np.arange(model.sizes["rank"])
    if "class" in model.dims:
        labels["class"] = [" ".join(map(str, row)) for row in zip(*_codes(model), strict=True)]
    floats = {
        name: model[name].astype(np.float64)
        for name in model.data_vars
        if model[name].dtype.kind in "iu"
    }
    dropped = [name for name in (*_KEYS.values(), "dip_latitude") if name in model]
    return model.assign(floats).drop_vars(dropped).assign_coords(labels)


def _codes(model: xr.Dataset) -> list[list[int]]:
    return [model[name].values.tolist() for name in _CLASS]


def _merge(one: xr.Dataset, other: xr.Dataset) -> xr.Dataset:
    if "minute" in one and "minute" in other and not one["minute"].equals(other["minute"]):
        raise ContractError(
            f"curves of {one.sizes['minute']} and of {other.sizes['minute']} minutes",
            where=_sources(one, other),
            expected="the same minutes in all models",
        )
    _check_agreement(one, other)
    both = xr.merge([one, other], join="outer", compat="no_conflicts", combine_attrs="override")
    return both.assign_attrs(source=_joined([one, other]))


def _check_agreement(one: xr.Dataset, other: xr.Dataset) -> None:
    """Refuse models that say different things of the same observatory, time or class."""
    common = xr.align(one, other, join="inner")
    for name in (n for n in one.data_vars if n in other.data_vars):
        first, second = (part[name] for part in common)
        differ = (first != second) & first.notnull() & second.notnull()
        if differ.any():
            at = np.argwhere(differ.values)[0]
            place = {d: first[d].values[i] for d, i in zip(first.dims, at, strict=True)}
            code = place.pop("observatory", None)
            cell = ", ".join(f"{d} {v}" for d, v in place.items())
            raise ContractError(
                f"{first.values[tuple(at)]:g} in one model and {second.values[tuple(at)]:g} "
                f"in another{f' at {cell}' if cell else ''}",
                where=" ".join(filter(None, (code, str(name)))),
                expected=f"one statement of each observatory; found {_sources(one, other)}",
                remedy="leave one of the models out, or correct the code of one",
            )


def _unkeyed(merged: xr.Dataset, models: Sequence[xr.Dataset]) -> xr.Dataset:
    """Labels back as variables, integers as integers, attributes as they were."""
    result = merged.copy()
    for dimension, name in _KEYS.items():
        if dimension in result.coords:
            result[name] = (dimension, result[dimension].values)
    result = result.drop_vars([d for d in (*_KEYS, "rank", "class") if d in result.coords])
    for model in models:
        for variable in (v for v in map(str, model.data_vars) if v in result):
            stated = model[variable]
            if stated.dtype.kind in "iu":
                whole = result[variable].fillna(_UNKNOWN.get(variable, 0))
                result[variable] = whole.astype(stated.dtype)
            result[variable].attrs = dict(stated.attrs)
    count = result.sizes["observatory"]
    result["dip_latitude"] = ("observatory", np.zeros(count), {"units": "degree"})
    return result


def _middle(model: xr.Dataset) -> np.datetime64:
    times = [model[k].values for k in ("month", "segment_start") if k in model]
    first, last = min(t.min() for t in times), max(t.max() for t in times)
    middle: np.datetime64 = first + (last - first) // 2
    return middle


def _attributes(models: Sequence[xr.Dataset]) -> dict[str, Any]:
    """The sources of all models; what they were made with, where they agree on it."""
    attributes: dict[str, Any] = {"source": _joined(models)}
    for name in _ALIKE:
        found = {float(m.attrs[name]) for m in models if name in m.attrs}
        if name == "segment_s" and len(found) > 1:
            raise ContractError(
                f"segments of {' and '.join(f'{s:g}' for s in sorted(found))} s",
                where="segment_s",
                expected="one length of segment in all models",
                remedy="run fit-fogm with the same segment_s",
            )
        if len(found) == 1:
            attributes[name] = found.pop()
    return attributes


def _joined(models: Sequence[xr.Dataset]) -> str:
    parts = [part for model in models for part in str(model.attrs["source"]).split("; ")]
    return "; ".join(dict.fromkeys(parts))


def _sources(one: xr.Dataset, other: xr.Dataset) -> str:
    return f"'{one.attrs['source']}' and '{other.attrs['source']}'"


STAGE = Stage(
    name="assemble-temporal",
    version=1,
    params=AssembleTemporalParams,
    inputs={"models": Many("temporal-model/1")},
    output="temporal-model/1",
    run=assemble_temporal,
)
