"""Fitting an aircraft's own field from a calibration flight: ``fit-tolles-lawson``."""

from __future__ import annotations

import datetime
from typing import Annotated, Any, Literal

import numpy as np
import pydantic
import xarray as xr
from numpy.typing import NDArray

from magtiles.schemas.errors import ContractError, CoverageError, ParameterError
from magtiles.stages.declare import Params, Stage, quantity
from magtiles.stages.vehicle.tolles_lawson.filter import Filter
from magtiles.stages.vehicle.tolles_lawson.manoeuvres import (
    Manoeuvre,
    find_manoeuvres,
    heading_groups,
    mark,
)
from magtiles.stages.vehicle.tolles_lawson.merit import measure
from magtiles.stages.vehicle.tolles_lawson.runs import Run, find_runs
from magtiles.stages.vehicle.tolles_lawson.solve import Regularisation, Solution, solve
from magtiles.stages.vehicle.tolles_lawson.terms import (
    DERIVATIVE_SPAN_S,
    SHORTEST,
    Derivative,
    direction_cosines,
    null_directions,
    term_columns,
    term_names,
    term_units,
)

Floats = NDArray[np.float64]

_TYPICAL_RATE = 2.0 * np.pi * 0.3  # rad/s, of manoeuvres: scales eddy terms for the solver
_SAME_UNIT = (0.8, 1.25)


def _rising(band: tuple[float, float]) -> tuple[float, float]:
    if not 0.0 < band[0] < band[1]:
        raise ValueError("two frequencies in Hz above zero, the lower first")
    return band


class FitTollesLawsonParams(Params):
    """Parameters of fit-tolles-lawson."""

    form: Literal["map_less", "map_based"] = quantity(
        "1", default="map_less", doc="Fit to the band-passed field, or to field less map."
    )
    induced_terms: Literal[5, 6] = quantity("1", default=5, doc="5 leaves out induced_zz.")
    eddy_terms: Literal[8, 9] = quantity("1", default=8, doc="8 leaves out eddy_zz.")
    derivative_of: Derivative = quantity(
        "1", default="direction_cosines", doc="What eddy terms take the derivative of."
    )
    derivative_span_s: float = quantity(
        "s", default=DERIVATIVE_SPAN_S, ge=0, doc="Samples that a derivative is fitted to."
    )
    band_hz: Annotated[tuple[float, float], pydantic.AfterValidator(_rising)] = quantity(
        "Hz", default=(0.1, 0.9), doc="Band of the manoeuvres, for the fit and the merits."
    )
    low_pass_hz: float | None = quantity(
        "Hz", default=None, gt=0, doc="Low-pass of a map-based fit; default none."
    )
    samples: Literal["manoeuvres", "all"] = quantity(
        "1", default="manoeuvres", doc="Which samples to fit."
    )
    span: tuple[str, str] | None = quantity(
        "1", default=None, doc="First and last time of the calibration, ISO, UTC; default all."
    )
    least_swing_deg: float = quantity(
        "degree", default=1.5, gt=0, doc="Amplitude from which an oscillation is a manoeuvre."
    )
    least_excitation: float = quantity(
        "1", default=3e-5, gt=0, doc="Relative change of the field that observes a direction."
    )
    ridge: float = quantity(
        "1", default=0.0, ge=0, doc="Damps directions excited by less than this; 0 for none."
    )
    allow_unobserved: bool = quantity(
        "1", default=False, doc="Leave what the motion does not observe at zero."
    )


def fit_tolles_lawson(track: xr.Dataset, *, params: FitTollesLawsonParams) -> xr.Dataset:
    """Tolles-Lawson coefficients of an aircraft (Nielsen 2023), from a calibration flight.

    Map-less: the columns of A and `field_total`, both band-passed, so that the Earth's field and
    its anomalies, which vary slowly, drop out. Map-based: A, and `field_total` less the track's
    `expected_total` (core field and map); a constant is free, for the map's level. A track's
    `diurnal` is part of what is expected.

    Parameters
    ----------
    track : track/1 with `field_total` and `field_body` (time, axis), nT, of a magnetometer that
        sees the Earth's field (forward, right, down, or any axes fixed to the aircraft).

    Returns
    -------
    sensor-calibration/1: `coefficient` (term) in nT, 1 and s, its `covariance`, which holds for
    white noise, `residual_rms` and `condition`; `level`, what the terms add up to on average,
    which no flight can tell from the Earth's field; `null_direction` where 6 or 9 terms were
    asked for; `cosine_range` (axis, bound) of the attitudes seen.

    Raises
    ------
    ContractError : a field is missing, units differ, or times are uneven.
    CoverageError : no manoeuvres, or a motion that does not observe terms, which it names.
    ParameterError : the band does not fit the sampling.
    """
    _check_fields(track, params)
    filters = Filter(*params.band_hz), _fit_filter(params)
    usable = _usable(track, params)
    runs = find_runs(track, usable, SHORTEST)
    manoeuvres = find_manoeuvres(track, runs, params.least_swing_deg)
    names = term_names(params.induced_terms, params.eddy_terms)
    raw, response = _model(track, runs, names, params)
    columns, target, inside = _filtered(raw, response, runs, filters[1])
    if params.samples == "manoeuvres":
        inside &= mark(manoeuvres, inside.size)
    _check_enough(track, inside, manoeuvres, params, len(names))
    field_nt = float(np.median(np.linalg.norm(_body(track)[inside], axis=1)))
    scale = np.array([_scale(name, field_nt) for name in names])
    if params.form == "map_based":  # a free constant
        columns, target = columns - columns[inside].mean(axis=0), target - target[inside].mean()
    step = runs[0].step_s
    solution = solve(
        columns[inside],
        target[inside],
        scale,
        null_directions(names),
        Regularisation(params.least_excitation, params.ridge),
        filters[1].noise_gain(step),
    )
    left = len(solution.unobserved)
    if left == len(names) or (left and not params.allow_unobserved):
        raise _unobserved(track, names, solution)
    level = float(raw[inside].mean(axis=0) @ solution.coefficient)
    fitted = _dataset(track, names, solution, level, inside)
    merits = _merits(response, raw @ solution.coefficient, runs, filters[0], manoeuvres)
    return fitted.assign_attrs(_record(track, params, inside, manoeuvres) | merits)


def _check_fields(track: xr.Dataset, params: FitTollesLawsonParams) -> None:
    where = track.attrs.get("source")
    needed = {
        "field_total": "a scalar magnetometer's field, nT",
        "field_body": "a vector magnetometer's field in axes fixed to the aircraft, nT",
    }
    if params.form == "map_based":
        needed["expected_total"] = "core field and map along the track: run expect-total-field"
    for name, meaning in needed.items():
        if name not in track:
            raise ContractError(f"'{name}' is missing", where=where, expected=meaning)
    if "compensation" in track.attrs:
        raise ContractError(
            "is compensated already", where=where, expected="the field as it was measured"
        )
    _check_units(track)


def _check_units(track: xr.Dataset) -> None:
    length, total = np.linalg.norm(_body(track), axis=1), track["field_total"].values
    both = np.isfinite(length) & (total > 0.0)
    ratio = float(np.median(length[both] / total[both])) if both.any() else 1.0
    if not _SAME_UNIT[0] < ratio < _SAME_UNIT[1]:
        raise ContractError(
            f"'field_body' is {ratio:.3g} times as long as 'field_total'",
            where=track.attrs.get("source"),
            expected="both in nT, of one field",
            remedy="correct the unit in the source's TOML, or calibrate the vector magnetometer",
        )


def _fit_filter(params: FitTollesLawsonParams) -> Filter:
    if params.form == "map_based":
        return Filter(None, params.low_pass_hz)
    if params.low_pass_hz is not None:
        raise ParameterError(
            "low_pass_hz is of a map-based fit",
            where="low_pass_hz",
            remedy='set band_hz, or form = "map_based"',
        )
    return Filter(*params.band_hz)


def _usable(track: xr.Dataset, params: FitTollesLawsonParams) -> NDArray[np.bool_]:
    usable: NDArray[np.bool_] = np.isfinite(track["field_total"].values)
    usable &= np.isfinite(direction_cosines(_body(track))).all(axis=1)
    if params.form == "map_based":
        usable &= np.isfinite(_expected(track))
    if params.span is not None:
        first, last = (_time(text) for text in params.span)
        time = track["time"].values
        usable &= (time >= first) & (time <= last)
    return usable


def _time(text: str) -> np.datetime64:
    try:
        time = datetime.datetime.fromisoformat(text)
    except ValueError:
        raise ParameterError(
            f"'{text}' is no time", where="span", expected="ISO, such as 2024-05-01T10:20:00"
        ) from None
    if time.tzinfo is not None:
        time = time.astimezone(datetime.UTC).replace(tzinfo=None)
    return np.datetime64(time, "ns")


def _body(track: xr.Dataset) -> Floats:
    return np.asarray(track["field_body"].values, np.float64)


def _model(
    track: xr.Dataset, runs: list[Run], names: tuple[str, ...], params: FitTollesLawsonParams
) -> tuple[Floats, Floats]:
    """Columns (time, terms) and what they are to explain (time,), nT; NaN outside the runs."""
    body = _body(track)
    columns = np.full((len(body), len(names)), np.nan)
    for run in runs:
        columns[run.rows] = term_columns(
            body[run.rows], run.step_s, names, params.derivative_of, params.derivative_span_s
        )
    response = track["field_total"].values.astype(np.float64)
    if params.form == "map_based":
        response = response - _expected(track)
    return columns, response


def _filtered(
    columns: Floats, response: Floats, runs: list[Run], band: Filter
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Columns and response, filtered, and which rows lie far enough from the ends of a run."""
    both = np.column_stack([columns, response])
    out, inside = np.full_like(both, np.nan), np.zeros(len(both), dtype=bool)
    for run in runs:
        edge = band.edge(run.step_s)
        if len(run) <= 2 * edge:
            continue
        out[run.rows] = band.apply(both[run.rows], run.step_s)
        inside[run.start + edge : run.stop - edge] = True
    return out[:, :-1], out[:, -1], inside


def _scale(name: str, field_nt: float) -> float:
    """Size of a term's column at full swing, per unit of its coefficient."""
    return {"p": 1.0, "i": field_nt, "e": field_nt * _TYPICAL_RATE}[name[0]]


def _check_enough(
    track: xr.Dataset,
    inside: NDArray[np.bool_],
    manoeuvres: list[Manoeuvre],
    params: FitTollesLawsonParams,
    terms: int,
) -> None:
    found = int(inside.sum())
    if found > terms:
        return
    what = f"{found} of {inside.size} samples can be fitted"
    if params.samples == "manoeuvres" and not manoeuvres:
        what = f"no oscillation of {params.least_swing_deg:g} degrees on a steady heading"
    raise CoverageError(
        what,
        where=track.attrs.get("source"),
        expected="rolls, pitches and yaws on four headings, sampled without gaps",
        remedy="bring a calibration flight, or look for gaps and flags in the track",
    )


def _unobserved(track: xr.Dataset, names: tuple[str, ...], solution: Solution) -> CoverageError:
    share = (solution.unobserved**2).sum(axis=0)
    most = [names[i] for i in np.argsort(-share) if share[i] > 0.1]
    return CoverageError(
        f"the motion does not observe {len(solution.unobserved)} of {len(names)} directions, "
        f"mostly of {', '.join(most)}",
        where=track.attrs.get("source"),
        expected="rolls, pitches and yaws on four headings",
        remedy="bring a calibration flight, or set allow_unobserved for a compensation that "
        "holds on the headings flown only",
    )


def _dataset(
    track: xr.Dataset,
    names: tuple[str, ...],
    solution: Solution,
    level: float,
    inside: NDArray[np.bool_],
) -> xr.Dataset:
    cosines = direction_cosines(_body(track)[inside])
    bounds = np.stack([cosines.min(axis=0), cosines.max(axis=0)], axis=1)
    rms = float(np.sqrt(np.mean(solution.residual**2)))
    variables: dict[str, Any] = {
        "coefficient": ("term", solution.coefficient, {"long_name": "in coefficient_unit"}),
        "coefficient_unit": ("term", term_units(names)),
        "covariance": (("term", "term_other"), solution.covariance),
        "residual_rms": ((), rms, {"units": "nT"}),
        "condition": ((), solution.condition, {"units": "1"}),
        "level": ((), level, {"units": "nT", "long_name": "mean of the terms, not observed"}),
        "cosine_range": (("axis", "bound"), bounds, {"units": "1"}),
    }
    null = null_directions(names)
    if len(null):
        about = "multiples of a row may be added to coefficient"
        variables["null_direction"] = (("null", "term"), null, {"long_name": about})
    return xr.Dataset(variables, coords={"term": list(names)})


def _merits(
    response: Floats, compensation: Floats, runs: list[Run], band: Filter, found: list[Manoeuvre]
) -> dict[str, Any]:
    if not found:
        return {}
    both = np.column_stack([response, compensation])
    signals, _, inside = _filtered(both, response, runs, band)
    signals[~inside] = np.nan
    whole = [one for one in found if inside[one.start : one.stop].all()]
    if not whole:
        return {}
    before, after = measure(signals[:, 0], whole), measure(signals[:, 0] - signals[:, 1], whole)
    return {
        "figure_of_merit_before_nt": before.figure_nt,
        "figure_of_merit_after_nt": after.figure_nt,
        "figure_of_merit_manoeuvres": before.manoeuvres,
        "improvement_ratio": before.noise_nt / after.noise_nt if after.noise_nt else np.inf,
    }


def _record(
    track: xr.Dataset,
    params: FitTollesLawsonParams,
    inside: NDArray[np.bool_],
    manoeuvres: list[Manoeuvre],
) -> dict[str, Any]:
    time = track["time"].values[inside]
    return {
        "source": str(track.attrs["source"]),
        "method": f"Tolles-Lawson, {params.form.replace('_', '-')}",
        "derivative_of": params.derivative_of,
        "derivative_scheme": "of quartics fitted by least squares (Savitzky-Golay)",
        "derivative_span_s": params.derivative_span_s,
        "band_hz": list(params.band_hz),
        "low_pass_hz": "none" if params.low_pass_hz is None else params.low_pass_hz,
        "regularisation": f"singular values: least excitation {params.least_excitation:g}, "
        f"ridge {params.ridge:g}",
        "samples": int(inside.sum()),
        "first_time": str(time.min()),
        "last_time": str(time.max()),
        "manoeuvres": len(manoeuvres),
        "headings": len(set(heading_groups(manoeuvres))),
    }


def _expected(track: xr.Dataset) -> Floats:
    """Core field, map and, where the track has it, the variation of the day (time,), nT."""
    expected: Floats = track["expected_total"].values.astype(np.float64)
    return expected + track["diurnal"].values if "diurnal" in track else expected


STAGE = Stage(
    name="fit-tolles-lawson",
    version=1,
    params=FitTollesLawsonParams,
    inputs={"track": "track/1"},
    output="sensor-calibration/1",
    run=fit_tolles_lawson,
)
