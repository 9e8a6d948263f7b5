"""Stage ``ingest-log``: a log and its source TOML become a track/1, a row for each field sample."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.flags import TrackFlag, flag_attributes
from magtiles.schemas.errors import FormatError, SourceError
from magtiles.stages.declare import FILES, Stage
from magtiles.stages.ingest.log.files import data_file, read_log
from magtiles.stages.ingest.log.order import out_of_order
from magtiles.stages.ingest.log.raw import FieldSamples, RawLog
from magtiles.stages.ingest.log.source import TRACK, IngestLogParams, rotation
from magtiles.stages.ingest.raw import nanotesla_per
from magtiles.stages.ingest.source import locate_all, merge
from magtiles.stages.vehicle.positions import (
    Fixes,
    Positions,
    Real,
    Times,
    attitude_at,
    interpolated,
    moved_by_lever,
    positions_at,
)

_LOG = logging.getLogger(__name__)

_CREDIBLE_NT = 1e6
"""No sensor on a vehicle that could be calibrated reads more; the core field is 22,000-67,000."""


def ingest_log(files: Sequence[Path], *, params: IngestLogParams) -> xr.Dataset:
    """One log as a track/1; `magtiles.stages.ingest.log` says what that holds.

    Parameters
    ----------
    files : the log (MCAP, PX4 ULog, ASEG-GDF2 with its definitions, MGD77, MGD77T, trackline CSV,
        HDF5 or CSV; also inside gzip, xz or zip), its source TOML, or both.
    params : the [log] keys of the TOML; either may state them.

    Raises
    ------
    FormatError : the file is missing, empty, damaged, or not what its own schemas say.
    SourceError : a key is missing or contradicts the log; several sensors could be meant.
    IntegrityError : the file's digest is not the one its source states.
    """
    found, source = locate_all([Path(f) for f in files], TRACK)
    params = merge(params, source)
    path, definition = data_file(found)
    raw = read_log(path, definition, params)
    if raw.rows:
        params = params.model_copy(update={"units": None})  # a table's columns are in nT by now
    where = str(path) if source is None else f"{source.path} [log]"
    name = path.name if source is None else source.source.id
    return _Assembly(raw, params, path, where).dataset(name)


STAGE = Stage(
    name="ingest-log",
    version=1,
    params=IngestLogParams,
    inputs={"files": FILES},
    output="track/1",
    run=ingest_log,
)


class _Assembly:
    """A raw log on its way to the contract."""

    def __init__(self, raw: RawLog, params: IngestLogParams, path: Path, where: str) -> None:
        self.raw, self.params, self.path, self.where = raw, params, path, where
        self.shift = self._shift_to_utc()
        recorded = raw.samples.time + self.shift
        self.order = np.argsort(recorded, kind="stable")
        self.time: Times = recorded[self.order]
        self.flag = np.zeros(self.time.size, dtype=np.uint16)
        self._flag_clock(recorded)

    def dataset(self, name: str) -> xr.Dataset:
        """The track."""
        field = self._field()
        attitude = self._attitude()
        positions = self._positions(attitude)
        self.flag |= positions.flag
        variables: dict[str, Any] = {
            "latitude": (("time",), positions.latitude, _LATITUDE),
            "longitude": (("time",), positions.longitude, _LONGITUDE),
            "height": (("time",), positions.height, {"units": "m", "positive": "up"}),
            **field,
            **self._rows(),
            **self._samples(),
            "quality_flag": (("time",), self.flag, flag_attributes(TrackFlag, np.uint16)),
        }
        if attitude is not None:
            variables["attitude"] = (("time", "quaternion"), attitude, _ATTITUDE)
        if self.params.undulation_m is not None:
            variables["reference_surface_height"] = (
                ("time",),
                np.full(self.time.size, self.params.undulation_m),
                {"units": "m", "positive": "up", "long_name": "geoid height above the ellipsoid"},
            )
        coords = {"time": ("time", self.time, {"standard_name": "time"})}
        return xr.Dataset(variables, coords=coords, attrs=self._attrs(name))

    def _shift_to_utc(self) -> np.timedelta64:
        start = self.params.start_time
        if self.raw.clock == "utc":
            if start is not None:
                raise SourceError(
                    "key 'start_time' is set, but the log's clock is UTC",
                    where=self.where,
                    remedy="remove it",
                )
            return np.timedelta64(0, "ns")
        if start is None:
            raise SourceError(
                "the log's clock counts from boot, and no fix says what UTC it was",
                where=self.path,
                remedy="state the UTC of the first field sample with the key 'start_time'",
            )
        first = np.datetime64(start.removesuffix("+00:00"), "ns")
        return np.timedelta64(first - self.raw.samples.time[0], "ns")

    def _flag_clock(self, recorded: Times) -> None:
        """CLOCK_STEP for rows whose time breaks the order, or that have no own time."""
        late = out_of_order(recorded, self.raw.run)
        back = np.flatnonzero(np.diff(recorded) < np.timedelta64(0))
        if back.size and late.any():
            row = int(back[0]) + 1
            _LOG.warning(
                "%s: time goes back %d times, first at sample %d from %s to %s; "
                "%d samples are sorted in and flagged clock_step",
                self.path, back.size, row, recorded[row - 1], recorded[row], late.sum(),
            )  # fmt: skip
        restamped = self.raw.samples.restamped
        if restamped is not None:
            late |= restamped
            _LOG.warning(
                "%s: %d samples are stamped before 1980; they have the times of their recording "
                "and are flagged clock_step",
                self.path, restamped.sum(),
            )  # fmt: skip
        self.flag[late[self.order]] |= TrackFlag.CLOCK_STEP.value

    def _field(self) -> dict[str, Any]:
        samples = self.raw.samples
        with np.errstate(over="ignore", invalid="ignore"):  # damaged values are refused below
            values = samples.values[self.order] * _factor(samples, self.params, self.where)
        place = f"{self.path} topic {samples.topic}"
        _check_field(values, place)
        self.flag[~np.isfinite(values.reshape(values.shape[0], -1)).all(axis=1)] |= (
            TrackFlag.FIELD_GAP.value
        )
        if values.ndim == 1:
            return {"field_total": (("time",), values, {"units": "nT"})}
        turn = rotation(self.params.sensor_to_body)
        if turn is not None:
            values = values @ turn.T
        return {"field_body": (("time", "axis"), values, {"units": "nT"})}

    def _attitude(self) -> Real | None:
        if self.raw.attitudes is None:
            return None
        shifted = _later(self.raw.attitudes, self.shift)
        return attitude_at(self.time, shifted, max_gap_s=self.params.max_gap_s)

    def _positions(self, attitude: Real | None) -> Positions:
        rows = self.raw.rows
        if "latitude" in rows:
            latitude, longitude, height = (rows[name][self.order] for name in _PLACES)
            lost = ~(np.isfinite(latitude) & np.isfinite(longitude))
            flag = np.where(lost, TrackFlag.NO_FIX.value, 0).astype(np.uint16)
            return Positions(latitude, longitude, height, flag)
        fixes = self._fixes
        if fixes is None:
            _LOG.warning("%s: no fixes, so no row has a position (flagged no_fix)", self.path)
            blank = np.full(self.time.size, np.nan)
            lost = np.full(self.time.size, TrackFlag.NO_FIX, dtype=np.uint16)
            return Positions(blank, blank, blank, lost)
        positions = positions_at(self.time, fixes, max_gap_s=self.params.max_gap_s)
        self._warn_apart(fixes, positions)
        if self.params.lever_arm_m is None:
            return positions
        turns = np.full((self.time.size, 4), np.nan) if attitude is None else attitude
        return moved_by_lever(positions, turns, np.array(self.params.lever_arm_m))

    @cached_property
    def _fixes(self) -> Fixes | None:
        if self.raw.fixes is None:
            return None
        fixes: Fixes = _later(self.raw.fixes, self.shift)
        wrong = (abs(fixes.latitude) > 90) | (abs(fixes.longitude) > 360)
        if wrong.any():
            row = int(np.argmax(wrong))
            raise FormatError(
                f"fix {row} is at latitude {fixes.latitude[row]:g}, longitude "
                f"{fixes.longitude[row]:g}",
                where=self.path,
                expected="degrees",
            )
        return fixes

    def _warn_apart(self, fixes: Fixes, positions: Positions) -> None:
        if np.isfinite(positions.latitude).any():
            return
        reason = (
            "no fix is valid"
            if not fixes.valid.any()
            else (
                f"fixes from {fixes.time[0]} to {fixes.time[-1]}, field from {self.time[0]} to "
                f"{self.time[-1]}"
            )
        )
        _LOG.warning("%s: no row has a position: %s", self.path, reason)

    def _rows(self) -> dict[str, Any]:
        rows = {k: v[self.order] for k, v in self.raw.rows.items() if k not in _PLACES}
        variables: dict[str, Any] = {
            name: (("time",), values, _ROW_ATTRS.get(name) or self.raw.row_attrs.get(name, {}))
            for name, values in rows.items()
        }
        if self.raw.speeds is not None:
            speed = interpolated(
                self.time,
                self.raw.speeds.time + self.shift,
                self.raw.speeds.speed,
                max_gap_s=self.params.max_gap_s,
            )
            variables["speed"] = (("time",), speed, _ROW_ATTRS["speed"])
        return variables

    def _samples(self) -> dict[str, Any]:
        """Fixes and attitudes as they came, on their own dimensions."""
        variables: dict[str, Any] = {}
        if self._fixes is not None:
            for name, attrs in _FIX.items():
                variables[f"fix_{name}"] = (("fix",), getattr(self._fixes, name), attrs)
        if self.raw.attitudes is not None:
            samples = self.raw.attitudes
            one = ("attitude_sample",)
            variables["attitude_time"] = (one, samples.time + self.shift, {})
            variables["attitude_quaternion"] = ((*one, "quaternion"), samples.quaternion, _ATTITUDE)
            rate = {"units": "rad s-1"}
            variables["angular_rate"] = ((*one, "axis"), samples.angular_rate, rate)
        return variables

    def _attrs(self, name: str) -> dict[str, Any]:
        params = self.params
        attrs: dict[str, Any] = {
            "Conventions": "CF-1.11",
            "source": name,
            "height_reference": self._height_reference(),
            "max_gap_s": params.max_gap_s,
            "magnetometer_topic": self.raw.samples.topic,
            **self.raw.attrs,
        }
        if params.lever_arm_m is not None:
            attrs["lever_arm_m"] = list(params.lever_arm_m)
        turn = rotation(params.sensor_to_body)
        if turn is not None and self.raw.samples.values.ndim == 2:
            attrs["sensor_to_body"] = [float(value) for value in turn.ravel()]
        if self.raw.samples.sigma is not None:
            factor = _factor(self.raw.samples, params, self.where)
            attrs["field_sigma_nt"] = [float(s) for s in self.raw.samples.sigma * factor]
        return attrs

    def _height_reference(self) -> str:
        stated = self.params.height_reference or self.raw.height_reference
        if self.params.undulation_m is not None and stated != "mean_sea_level":
            raise SourceError(
                f"key 'undulation_m' with height_reference = '{stated}'",
                where=self.where,
                expected="only where heights are above mean sea level",
            )
        if stated is not None:
            return stated
        if self.raw.fixes is None and "height" not in self.raw.rows:
            return "ellipsoid"  # of heights that are all missing
        raise SourceError(
            "key 'height_reference' is missing, and the log does not say what heights count from",
            where=self.where,
            expected="ellipsoid, mean_sea_level or terrain",
        )


def _later(samples: Any, shift: np.timedelta64) -> Any:
    """Samples on the clock that is `shift` ahead."""
    fields = dict(vars(samples))
    fields["time"] = fields["time"] + shift
    return type(samples)(**fields)


def _factor(samples: FieldSamples, params: IngestLogParams, where: str) -> float:
    unit = params.units or samples.unit
    if unit is None:
        raise SourceError(
            f"key 'units' is missing, and messages of '{samples.topic}' do not say",
            where=where,
            remedy="state the unit of the field with the key 'units'",
        )
    factor = nanotesla_per(unit, where=f"{where} units")
    if samples.unit is not None and factor != nanotesla_per(samples.unit, where=where):
        _LOG.warning(
            "%s: the field is taken as %s, though messages of its type are in %s",
            where, unit, samples.unit,
        )  # fmt: skip
    return factor


def _check_field(values: NDArray[np.float64], where: str) -> None:
    """Raise FormatError for an axis that is NaN throughout, or a value that no sensor gives."""
    columns = values.reshape(values.shape[0], -1)
    names = ("x", "y", "z") if columns.shape[1] == 3 else ("the field",)
    for name, column in zip(names, columns.T, strict=True):
        if not np.isfinite(column).any():
            raise FormatError(
                f"{name} is not finite in any of {column.size} messages",
                where=where,
                remedy="choose another magnetometer",
            )
        worst = int(np.nanargmax(np.abs(column)))
        if abs(column[worst]) > _CREDIBLE_NT:
            raise FormatError(
                f"{name} is {column[worst]:g} nT in sample {worst}",
                where=where,
                expected=f"at most {_CREDIBLE_NT:g} nT",
                remedy="if the driver writes another unit than its messages', state it with the "
                "key 'units'",
            )


_PLACES = ("latitude", "longitude", "height")
_LATITUDE = {"units": "degrees_north", "standard_name": "latitude"}
_LONGITUDE = {"units": "degrees_east", "standard_name": "longitude"}
_ATTITUDE = {"units": "1", "long_name": "w, x, y, z from body to north, east, down"}
_ROW_ATTRS = {"speed": {"units": "m s-1"}, "diurnal": {"units": "nT"}}
_FIX: dict[str, dict[str, str]] = {
    "time": {},
    "latitude": {"units": "degrees_north"},
    "longitude": {"units": "degrees_east"},
    "height": {"units": "m"},
    "status": {"long_name": "-1 no fix, 0 fix, 1 satellite-based, 2 ground-based augmentation"},
    "horizontal_sigma": {"units": "m"},
    "vertical_sigma": {"units": "m"},
}
