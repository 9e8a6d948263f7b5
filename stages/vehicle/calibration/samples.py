"""The samples of a track that a calibration may use, with the core field at each."""

from __future__ import annotations

import datetime
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import pydantic
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.flags import TrackFlag
from magtiles.schemas.errors import ContractError, CoverageError, ParameterError
from magtiles.stages.field.core_field import Core, ellipsoidal_height
from magtiles.stages.ingest.field_model import named_model

Real = NDArray[np.float64]

UNFIT_FIELD = TrackFlag.FIELD_SPIKE | TrackFlag.FIELD_GAP
"""Samples that carry one of these do not count in a calibration."""
AXES = ("forward", "right", "down")

_FEWEST = 50
_CORE_NODES = 100
"""Places along a track at which the core field is evaluated; between them it is linear."""
_UNIT_FACTOR = 10.0
"""Factor between the field measured and the core field that no bias explains, but a unit does."""


def _utc(value: object) -> object:
    try:
        if isinstance(value, str):
            value = datetime.datetime.fromisoformat(value)
        if isinstance(value, datetime.datetime):
            if value.tzinfo is not None:
                value = value.astimezone(datetime.UTC).replace(tzinfo=None)
            return value.isoformat()
    except ValueError:
        pass
    raise ValueError("an ISO date and time in UTC, such as 2018-08-02T08:34:30")


UtcTime = Annotated[str, pydantic.BeforeValidator(_utc)]
"""A parameter that is an instant, kept as ISO text in UTC; TOML may write its own."""


@dataclass(frozen=True)
class Samples:
    """Samples fit for calibration.

    Attributes
    ----------
    time : (n,) datetime64[ns], UTC.
    raw : (n, 3) readings in the sensor's axes, nT.
    core : (n, 3) core field there and then, north, east, down, nT.
    attitude : (n, 4) unit quaternions w, x, y, z, body to north, east, down; NaN where the
        track has none.
    place : (n, 2) metres north and east of the first known place; NaN where unknown.
    """

    time: NDArray[np.datetime64]
    raw: Real
    core: Real
    attitude: Real
    place: Real

    def take(self, index: slice | NDArray[np.bool_]) -> Samples:
        """A part of the samples."""
        return Samples(
            self.time[index], self.raw[index], self.core[index], self.attitude[index],
            self.place[index],
        )  # fmt: skip

    @property
    def seconds(self) -> Real:
        """Time since the first sample, s."""
        return np.asarray((self.time - self.time[0]) / np.timedelta64(1, "s"))

    @property
    def core_total(self) -> Real:
        """Magnitude of the core field (n,), nT."""
        return np.asarray(np.linalg.norm(self.core, axis=1))

    @property
    def core_mean(self) -> Real:
        """Mean core field (3,), nT."""
        return np.asarray(self.core.mean(axis=0))


def select_samples(
    track: xr.Dataset,
    *,
    start: str | None,
    end: str | None,
    core_field_nt: tuple[float, float, float] | None,
    reference_field: str,
    allow_extrapolated: bool,
    model: Path | None,
) -> Samples:
    """The finite, unflagged samples of `field_body` between two times, with their core field.

    Raises ContractError for a track without a vector field, or with readings that cannot be
    nanotesla; CoverageError for too few samples, a dead axis, or no known place.
    """
    raw = body_field(track)
    time = track["time"].values
    wanted = _window(time, start, end) & _unflagged(track)
    _check_axes(raw[wanted])
    good = wanted & np.isfinite(raw).all(axis=1)
    if (count := int(good.sum())) < _FEWEST:
        raise CoverageError(
            f"{count} samples are fit for use of {len(time)} in the track",
            where="field_body",
            expected=f"at least {_FEWEST}: finite, in the window, without the flags "
            + ", ".join(str(f.name).lower() for f in UNFIT_FIELD),
            remedy="widen start and end, or record longer",
        )
    chosen = track.isel(time=np.flatnonzero(good))
    latitude, longitude = (chosen[n].values.astype(np.float64) for n in ("latitude", "longitude"))
    if core_field_nt is not None:
        core = np.broadcast_to(np.array(core_field_nt), (count, 3))
    else:
        source = Core(named_model(reference_field, model, role="model"), None, allow_extrapolated)
        core = _core_along(chosen, latitude, longitude, source)
    samples = Samples(
        time[good], raw[good], core, _attitude(chosen, count), _metres(latitude, longitude)
    )
    _check_unit(samples)
    return samples


def body_field(track: xr.Dataset) -> Real:
    """The vector readings (time, 3) of a track, nT. Raises ContractError where it has none."""
    if "field_body" not in track:
        raise ContractError(
            "'field_body' is missing",
            where=track.attrs.get("source"),
            expected="the three components of a vector magnetometer, nT",
            remedy="a total field alone is compensated by fit-tolles-lawson, not calibrated",
        )
    return np.asarray(track["field_body"].values, np.float64)


def magnitudes(raw: Real, core: Real) -> str:
    """What the field measures and what it should, for messages."""
    measured = float(np.median(np.linalg.norm(raw, axis=-1)))
    expected = float(np.mean(np.linalg.norm(core, axis=-1)))
    return (
        f"the field measures {measured:.0f} nT in the median, the core field is {expected:.0f} nT"
    )


def _window(time: NDArray[np.datetime64], start: str | None, end: str | None) -> NDArray[np.bool_]:
    inside = np.ones(len(time), dtype=np.bool_)
    if start is not None:
        inside &= time >= np.datetime64(start)
    if end is not None:
        inside &= time <= np.datetime64(end)
    if not inside.any():
        raise ParameterError(
            "no sample lies between start and end",
            where=f"start = {start}, end = {end}",
            expected=f"times from {time[0]} to {time[-1]} (UTC)",
        )
    return inside


def _unflagged(track: xr.Dataset) -> NDArray[np.bool_]:
    if "quality_flag" not in track:
        return np.ones(track.sizes["time"], dtype=np.bool_)
    return np.asarray((track["quality_flag"].values & int(UNFIT_FIELD)) == 0)


def _check_axes(raw: Real) -> None:
    for axis, values in zip(AXES, raw.T, strict=True):
        finite = values[np.isfinite(values)]
        if not finite.size:
            what, remedy = "has no finite value", "read the sensor's own column or topic"
        elif finite.size >= _FEWEST and np.ptp(finite) == 0.0:
            what, remedy = f"is {finite[0]:g} nT throughout", "the sensor is stuck: use another"
        else:
            continue
        raise CoverageError(
            f"axis {axis} {what}: its bias and scale factor are not observed",
            where="field_body", expected="readings that follow the motion", remedy=remedy,
        )  # fmt: skip


def _check_unit(samples: Samples) -> None:
    measured = float(np.median(np.linalg.norm(samples.raw, axis=1)))
    expected = float(samples.core_total.mean())
    if not expected / _UNIT_FACTOR <= measured <= expected * _UNIT_FACTOR:
        raise ContractError(
            magnitudes(samples.raw, samples.core),
            where="field_body",
            expected="readings in nT",
            remedy="correct the unit in the log's TOML and ingest it again",
        )


def _core_along(track: xr.Dataset, latitude: Real, longitude: Real, core: Core) -> Real:
    """Core field (n, 3) at the samples of a track; where the place is unknown, of the nearest."""
    height = np.broadcast_to(ellipsoidal_height(track), latitude.shape)
    known = np.flatnonzero(np.isfinite(latitude) & np.isfinite(longitude) & np.isfinite(height))
    if not known.size:
        raise CoverageError(
            "no sample has a place and height, so the core field there is not known",
            where=track.attrs.get("source"),
            expected="latitude, longitude and height",
            remedy="give core_field_nt = [north, east, down] of the place and date",
        )
    nodes = known[np.unique(np.linspace(0, known.size - 1, _CORE_NODES).astype(np.int64))]
    at_nodes = Core(core.model, track["time"].values[nodes], core.allow_extrapolated).vector(
        latitude[nodes], longitude[nodes], height[nodes]
    )
    index = np.arange(len(latitude))
    return np.column_stack([np.interp(index, nodes, component) for component in at_nodes.T])


def _attitude(track: xr.Dataset, count: int) -> Real:
    if "attitude" not in track:
        return np.full((count, 4), np.nan)
    quaternion = track["attitude"].values.astype(np.float64)
    length = np.linalg.norm(quaternion, axis=1, keepdims=True)
    return np.asarray(np.where(np.abs(length - 1.0) < 0.01, quaternion, np.nan) / length)


def _metres(latitude: Real, longitude: Real) -> Real:
    known = np.flatnonzero(np.isfinite(latitude) & np.isfinite(longitude))
    if not known.size:
        return np.full((len(latitude), 2), np.nan)
    metres = 111_195.0  # for directions: a sphere is close enough
    origin = latitude[known[0]], longitude[known[0]]
    east = (longitude - origin[1] + 180.0) % 360.0 - 180.0
    return metres * np.column_stack([latitude - origin[0], east * np.cos(np.radians(origin[0]))])
