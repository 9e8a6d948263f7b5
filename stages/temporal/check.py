"""Stage ``check-observatory``: faults of a record are flagged and reported, not repaired."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.flags import RecordFlag
from magtiles.catalog.models import FieldModel
from magtiles.schemas.errors import SourceError
from magtiles.stages.declare import OPTIONAL_FILE, Params, Stage, quantity
from magtiles.stages.ingest.field_model import named_model
from magtiles.stages.temporal.faults import find_spikes, find_steps, find_stuck
from magtiles.stages.temporal.level import Place, core_vector, daily_medians, explain

_LOG = logging.getLogger(__name__)

Real = NDArray[np.float64]

_VECTOR = ("field_north", "field_east", "field_down")
_ELEMENTS = (*_VECTOR, "field_total")
_FINEST_STORMS_S = 60.0
"""In coarser series a storm moves the field as far from sample to sample as a fault does."""

_LISTED = 20  # times that a finding names


class CheckObservatoryParams(Params):
    """Parameters of check-observatory."""

    reference_field: str = quantity(
        "1", default="IGRF-14", min_length=1, doc="Core field model to compare the level with."
    )
    spike_threshold: float = quantity(
        "1", default=8.0, gt=0, doc="Least size of a spike, in local scales of differences."
    )
    spike_floor_nt: float = quantity("nT", default=2.0, ge=0, doc="Least size of a spike.")
    step_threshold: float = quantity(
        "1", default=10.0, gt=0, doc="Least height of a step, in local scales of differences."
    )
    step_floor_nt: float = quantity("nT", default=3.0, ge=0, doc="Least height of a step.")
    stuck_samples: int = quantity(
        "1", default=30, ge=3, doc="Least number of samples of one value."
    )
    total_threshold: float = quantity(
        "1", default=10.0, gt=0, doc="Scalar against vector: deviation from the day, in sigma."
    )
    total_floor_nt: float = quantity(
        "nT", default=3.0, ge=0, doc="Scalar against vector: least deviation from the day."
    )
    level_tolerance_nt: float = quantity(
        "nT", default=1000.0, gt=0, doc="What the crust may add to the core field."
    )
    position_tolerance_nt: float = quantity(
        "nT", default=5000.0, gt=0, doc="Difference from the core field that no crust explains."
    )
    allow_position_mismatch: bool = quantity(
        "1", default=False, doc="Flag a field that cannot be that of the position, and go on."
    )


@dataclass
class _Report:
    """The flags (n,) and findings of a record, as they are found."""

    time: NDArray[np.datetime64]
    flags: NDArray[np.uint8]
    findings: list[dict[str, Any]] = field(default_factory=list)

    def add(
        self, flag: RecordFlag, element: str, found: NDArray[np.bool_], said: Mapping[str, Any]
    ) -> None:
        """Flag samples, and say so if there are any."""
        if not found.any():
            return
        self.flags[found] |= np.uint8(flag.value)
        times = self.time[found][:_LISTED].astype("datetime64[s]")
        self.findings.append(
            {
                "check": str(flag.name).lower(),
                "element": element,
                "samples": int(found.sum()),
                "times": [str(t) for t in times],
                **said,
            }
        )


def check_observatory(
    series: xr.Dataset, *, params: CheckObservatoryParams, model: Path | None = None
) -> xr.Dataset:
    """An observatory-series/1 with `quality_flag` set and the attribute `findings` (JSON).

    Values stay as they are. Spikes and steps are looked for in series of a minute or finer; a
    step is flagged at its first sample. The position is wrong where the median vector is further
    from the core field there than `position_tolerance_nt`, or than `level_tolerance_nt` while it
    agrees with the place that a usual mistake would hide, such as the other sign of the latitude.

    Raises
    ------
    SourceError : the field cannot be that of the stated position, unless
        `allow_position_mismatch`; another `reference_field` than IGRF without its file.
    """
    values = np.stack([series[name].values.astype(np.float64) for name in _ELEMENTS])
    report = _Report(series["time"].values, series["quality_flag"].values.copy())
    _note_missing(series, values, report)
    core = named_model(params.reference_field, model, role="model")
    _check_level(series, values[:3], core, params, report)
    if series.attrs.get("total_field_from") != "vector":
        _check_total(values, params, report)
    if float(series.attrs["cadence_s"]) <= _FINEST_STORMS_S:
        _check_jumps(series, values, params, report)
    for i, name in enumerate(_VECTOR):
        others = [v for j, v in enumerate(values[:3]) if j != i]
        stuck = find_stuck(values[i], others, params.stuck_samples)
        report.add(RecordFlag.STUCK, name, stuck, {})
    code = series.attrs["iaga_code"]
    for finding in report.findings:
        level = logging.INFO if finding["check"] == "missing" else logging.WARNING
        _LOG.log(level, "%s: %s", code, _sentence(finding))
    checked = series.assign(
        quality_flag=("time", report.flags, series["quality_flag"].attrs)
    ).assign_attrs(findings=json.dumps(report.findings), reference_field=core.name)
    return checked


STAGE = Stage(
    name="check-observatory",
    version=1,
    params=CheckObservatoryParams,
    inputs={"series": "observatory-series/1", "model": OPTIONAL_FILE},
    output="observatory-series/1",
    run=check_observatory,
)


def _sentence(finding: Mapping[str, Any]) -> str:
    said = {k: v for k, v in finding.items() if k not in ("check", "element", "samples", "times")}
    when = f", from {finding['times'][0]}" if finding["times"] else ""
    more = "".join(f", {key.replace('_', ' ')} {value}" for key, value in said.items())
    return f"{finding['check']}: {finding['samples']} samples of {finding['element']}{when}{more}"


def _note_missing(series: xr.Dataset, values: Real, report: _Report) -> None:
    """Count what is missing; the marks are flagged at ingest."""
    absent = str(series.attrs.get("elements_not_recorded", ""))
    for name, element in zip(_ELEMENTS, values, strict=True):
        missing = np.isnan(element)
        if missing.any():
            marked = missing & ((report.flags & RecordFlag.MISSING_MARK) != 0)
            finding: dict[str, Any] = {
                "check": "missing",
                "element": name,
                "samples": int(missing.sum()),
                "times": [str(t) for t in report.time[missing][:1].astype("datetime64[s]")],
                "marked": int(marked.sum()),
            }
            report.findings.append(finding | ({"not_recorded": absent} if absent else {}))


def _check_level(
    series: xr.Dataset,
    vector: Real,
    core: FieldModel,
    params: CheckObservatoryParams,
    report: _Report,
) -> None:
    day, medians = daily_medians(report.time, vector)
    known = np.isfinite(medians).all(axis=0)
    if not known.any():
        return
    attrs = series.attrs
    place = Place(float(attrs["latitude"]), float(attrs["longitude"]), float(attrs["elevation"]))
    dates = report.time[0].astype("datetime64[D]") + np.arange(medians.shape[1])
    expected = core_vector(core, place, dates).T
    distance = np.full(known.shape, np.nan)
    distance[known] = np.linalg.norm(medians[:, known] - expected[:, known], axis=0)
    off = np.nan_to_num(distance) > params.level_tolerance_nt
    said = {"largest_difference_nt": round(float(np.nanmax(distance)), 1)}
    report.add(RecordFlag.LEVEL_MISMATCH, "vector", off[day], said)
    middle = dates[known][known.sum() // 2]
    found = np.median(medians[:, known], axis=1)
    misfit = float(np.linalg.norm(found - core_vector(core, place, middle)))
    if misfit <= params.level_tolerance_nt:
        return
    mistake = explain(core, place, middle, found, min(params.level_tolerance_nt, misfit / 2))
    if mistake is None and misfit <= params.position_tolerance_nt:
        return
    said_position = {
        "check": "position_mismatch",
        "element": "vector",
        "samples": int(off[day].sum()),
        "times": [str(middle)],
        "difference_nt": round(misfit, 1),
        "likely_mistake": mistake or "unknown",
    }
    if not params.allow_position_mismatch:
        raise _wrong_position(series, place, misfit, mistake, core.name)
    report.findings.append(said_position)


def _wrong_position(
    series: xr.Dataset, place: Place, misfit: float, mistake: str | None, model: str
) -> SourceError:
    return SourceError(
        f"the record of {series.attrs['iaga_code']} is {misfit:.0f} nT from {model} at latitude "
        f"{place.latitude:g}, longitude {place.longitude:g}"
        + ("" if mistake is None else f", and agrees with it if {mistake}"),
        where=series.attrs["source"],
        expected="a header position whose core field the record's level is near",
        remedy="correct the position, or the declination baseline; a record of variations only "
        "needs allow_position_mismatch = true",
    )


def _check_total(values: Real, params: CheckObservatoryParams, report: _Report) -> None:
    """The scalar less the vector's magnitude, against its median of the day."""
    difference = values[3] - np.sqrt((values[:3] ** 2).sum(axis=0))
    if not np.isfinite(difference).any():
        return
    day, medians = daily_medians(report.time, difference[None])
    deviation = np.abs(difference - medians[0][day])
    sigma = 1.4826 * float(np.nanmedian(deviation))
    least = max(params.total_threshold * sigma, params.total_floor_nt)
    said = {
        "median_nt": round(float(np.nanmedian(difference)), 2),
        "sigma_nt": round(sigma, 3),
        "largest_nt": round(float(np.nanmax(deviation)), 2),
    }
    report.add(RecordFlag.TOTAL_MISMATCH, "field_total", np.nan_to_num(deviation) > least, said)


def _check_jumps(
    series: xr.Dataset, values: Real, params: CheckObservatoryParams, report: _Report
) -> None:
    """Spikes and steps of each element; steps also of the scalar less the vector's magnitude."""
    scalar = series.attrs.get("total_field_from") != "vector"
    for i, name in enumerate(_ELEMENTS if scalar else _VECTOR):
        spikes = find_spikes(values[i], params.spike_threshold, params.spike_floor_nt)
        report.add(RecordFlag.SPIKE, name, spikes, {})
    tests = [
        (name, values[i], [values[j] for j in range(3) if j != i]) for i, name in enumerate(_VECTOR)
    ]
    if scalar:
        magnitude = np.sqrt((values[:3] ** 2).sum(axis=0))
        tests.append(("field_total less vector", values[3] - magnitude, []))
    for name, element, others in tests:
        at, heights = find_steps(element, others, params.step_threshold, params.step_floor_nt)
        steps = np.zeros(report.time.shape, np.bool_)
        steps[at] = True
        said = {"heights_nt": [round(float(h), 2) for h in heights[:_LISTED]]}
        report.add(RecordFlag.STEP, name, steps, said)
