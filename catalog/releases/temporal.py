"""Time variations of a release: what a quiet day adds at a place and time, and what is left of it.

Everything comes from a few observatories. An observatory counts by how near it is in dip
latitude, which orders the quiet-day currents, and less by how far it is along the parallel:

    w ~ 1 / (s^2 + d_dip^2 + (d_east / 8)^2)        s = 0.1 degrees

with d_dip the difference of dip latitudes and d_east the arc along the mean parallel, degrees.
Eight real observatories, each told from the others over the year 2013, are told better so than by
distance (docs/accuracy.md). The sun is at the same place for all: curves are read at the local
mean solar time of the query.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtiles.catalog.kernels import activity_classes
from magtiles.catalog.kernels.activity_classes import ANY
from magtiles.catalog.kernels.local_time import (
    baseline_at,
    mid_month,
    solar_minute,
    standard_error_at,
)
from magtiles.catalog.releases.arguments import broadcast, check_positions, refuse
from magtiles.catalog.releases.temporal_file import TemporalData
from magtiles.schemas.errors import QueryError

if TYPE_CHECKING:
    from magtiles.catalog.models import FieldModel
    from magtiles.catalog.models.dates import Date

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

POLAR_DIP_LATITUDE = 60.0
"""Degrees beyond which auroral currents rule, and a quiet-day curve says little."""
LEAST_SEGMENTS = 30
"""Segments that a class needs to be preferred to a coarser one."""

_SCALE = 0.1
_EAST = 8.0
_NOTICED = 0.1
"""Least weight of an observatory whose own doubts are those of the answer."""

_DAY = np.timedelta64(1, "D")


@dataclass(frozen=True)
class Observatory:
    """An observatory of the release: IAGA code, degrees, metres above the sea."""

    code: str
    latitude: float
    longitude: float
    elevation: float
    dip_latitude: float


@dataclass(frozen=True)
class ActivityClass:
    """Segments that were pooled; None where it does not tell apart.

    `kp` is "quiet" or "stormy" (Kp >= 3), `season` that of the hemisphere, `local_time` a
    quarter of the day.
    """

    kp: str | None
    season: str | None
    local_time: str | None


@dataclass(frozen=True)
class QuietDayBaseline:
    """The quiet-day variation at places and times of shape (...).

    Attributes
    ----------
    values, standard_error : (..., 4) nT: north, east, down, total, from local midnight. The
        error is that of the observatories' curves together with how much they disagree.
    observatories, weights : codes, and (..., observatory) how much each counts; adds up to 1.
    dip_distance : (...) degrees of dip latitude from the place to the observatories, by weight.
        Beyond some 20, or over the equator, the answer may be worse than none.
    polar : (...) whether the answer is from polar latitudes, where it is little worth.
    days_outside : (...) days by which the date, moved by whole years, still lies outside the
        release's months; 0 within.
    """

    values: Floats
    standard_error: Floats
    observatories: tuple[str, ...]
    weights: Floats
    dip_distance: Floats
    polar: Bools
    days_outside: Floats


@dataclass(frozen=True)
class FogmStatistics:
    """First-order Gauss-Markov statistics of what the baseline leaves, at shape (...).

    Attributes
    ----------
    sigma : (..., 4) nT: north, east, down, total.
    tau : (..., 4) s, inf where it is longer than the segments can say.
    tau_unidentified : (..., 4) whether the segments did not bound tau.
    observatories, weights : as in `QuietDayBaseline`.
    classes : (..., observatory) index into `TemporalModel.classes` of what each was asked for;
        -1 where it does not count.
    dip_distance, polar : (...) as in `QuietDayBaseline`.
    """

    sigma: Floats
    tau: Floats
    tau_unidentified: Bools
    observatories: tuple[str, ...]
    weights: Floats
    classes: NDArray[np.intp]
    dip_distance: Floats
    polar: Bools


class TemporalModel:
    """The temporal part of a release, from `Release.temporal`; safe to share between threads.

    Queries take degrees and a `time` in UTC (ISO text, datetime, datetime64 or decimal year);
    arguments broadcast to the shape ``...`` of the answer, which is NaN where a position is.

    Raises
    ------
    ContractError : the release has no core field to tell dip latitude and total by.
    QueryError : arguments that are none, a time outside the core field's span, or the part
        asked for is not in this release.

    Attributes
    ----------
    observatories, months, classes : what it holds; months are datetime64[M].
    variables : every array of the file by name, read-only.
    """

    def __init__(
        self,
        data: TemporalData,
        core: Callable[[], FieldModel],
        where: str,
        *,
        allow_extrapolated: bool = False,
    ) -> None:
        self.variables = data.variables
        self._data, self._load_core, self._where = data, core, where
        self._extrapolate = allow_extrapolated
        v = data.variables
        self.observatories = tuple(
            Observatory(str(code), *map(float, place))
            for code, *place in zip(
                v["iaga_code"], v["latitude"], v["longitude"], v["elevation"], v["dip_latitude"],
                strict=True,
            )
        )  # fmt: skip
        seconds = v["month"] if data.has_baseline else np.empty(0, np.int64)
        self.months = seconds.astype("datetime64[s]").astype("datetime64[M]")
        self.classes = _activity_classes(v) if data.has_fogm else ()

    def baseline(self, latitude: ArrayLike, longitude: ArrayLike, time: Date) -> QuietDayBaseline:
        """The quiet-day variation: curves in local mean solar time, between mid-months.

        The total is that of the vector along the local core field (the first order of |B|).
        A date outside the months is moved by whole years into them, or next to them, and then
        answered with the nearest month.
        """
        self._require(self._data.has_baseline, "quiet-day baselines")
        shape, (lat, lon), when = self._arguments(latitude, longitude, time)
        direction, dip = self._direction(lat, lon, when)
        moved, outside = _into_span(self.months, when)
        curves, errors = self._curves(lon, moved)
        weights = self._weights(lat, lon, dip, np.asarray(np.isfinite(curves[:3]).all(axis=0)))
        curves[3] = np.einsum("na,aon->on", direction, curves[:3])
        values = _weighted(weights, curves)
        spread = _weighted(weights, (curves - values.T[:, None, :]) ** 2)
        variance = _weighted(weights**2, errors**2) + spread
        return QuietDayBaseline(
            values=values.reshape(*shape, 4),
            standard_error=np.sqrt(variance).reshape(*shape, 4),
            observatories=self._codes,
            weights=weights.T.reshape(*shape, len(self._codes)),
            dip_distance=self._dip_distance(dip, weights).reshape(shape),
            polar=self._polar(dip, weights).reshape(shape),
            days_outside=outside.reshape(shape),
        )

    def fogm(
        self,
        latitude: ArrayLike,
        longitude: ArrayLike,
        time: Date,
        kp: ArrayLike | None = None,
    ) -> FogmStatistics:
        """FOGM sigma and tau of the residual, pooled over the segments of the most telling class.

        At each observatory that is the class of the activity (with `kp`), season and local
        time asked for, or else of fewer of them, first that had `LEAST_SEGMENTS` segments;
        season is given up before local time, and that before activity. Observatories combine
        by variance and by its integral over lag: sigma^2 = sum w s^2, tau sigma^2 = sum w s^2 t.
        """
        self._require(self._data.has_fogm, "Gauss-Markov statistics")
        shape, (lat, lon, activity), when = self._arguments(
            latitude, longitude, time, kp=np.nan if kp is None else kp
        )
        refuse(~(np.isnan(activity) | ((activity >= 0) & (activity <= 9))), shape, "kp", activity,
               "0 to 9")  # fmt: skip
        _, dip = self._direction(lat, lon, when)
        wanted = (
            activity_classes.kp_class(activity),
            activity_classes.season(when, lat),
            activity_classes.local_time(np.nan_to_num(solar_minute(when, lon))),
        )
        classes = self._chosen[:, wanted[0] + 1, wanted[1], wanted[2]]
        weights = self._weights(lat, lon, dip, classes >= 0)
        v, stations = self.variables, np.arange(len(self._codes))[:, None]
        picked = (stations, slice(None), classes)
        variance = np.moveaxis(v["class_sigma"][picked].astype(np.float64) ** 2, -1, 0)
        tau = np.moveaxis(v["class_tau"][picked].astype(np.float64), -1, 0)
        doubt = np.moveaxis(self._doubtful[picked], -1, 0) & (weights >= _NOTICED)
        total = _weighted(weights, variance)
        with np.errstate(invalid="ignore"):
            memory = _weighted(weights, variance * tau) / total
        return FogmStatistics(
            sigma=np.sqrt(total).reshape(*shape, 4),
            tau=memory.reshape(*shape, 4),
            tau_unidentified=doubt.any(axis=1).T.reshape(*shape, 4),
            observatories=self._codes,
            weights=weights.T.reshape(*shape, len(self._codes)),
            classes=np.where(weights > 0, classes, ANY).T.reshape(*shape, len(self._codes)),
            dip_distance=self._dip_distance(dip, weights).reshape(shape),
            polar=self._polar(dip, weights).reshape(shape),
        )

    def __repr__(self) -> str:
        return f"<TemporalModel of {', '.join(self._codes)} in {self._where}>"

    @cached_property
    def _core(self) -> FieldModel:
        return self._load_core()

    @cached_property
    def _codes(self) -> tuple[str, ...]:
        return tuple(o.code for o in self.observatories)

    @cached_property
    def _doubtful(self) -> Bools:
        """(observatory, element, class) whether tau is unidentified."""
        v = self.variables
        stated = v.get("class_tau_unidentified", np.zeros(v["class_tau"].shape, np.uint8))
        return np.asarray((stated != 0) | ~np.isfinite(v["class_tau"]))

    @cached_property
    def _chosen(self) -> NDArray[np.intp]:
        """(observatory, kp + 1, season, local time) the class to use, -1 for none."""
        v = self.variables
        codes = np.stack([v[f"class_{k}"] for k in ("kp", "season", "local_time")], axis=1)
        known = (np.isfinite(v["class_sigma"]) & ~np.isnan(v["class_tau"])).all(axis=1)
        counts = np.where(known, v["class_segments"].min(axis=1), 0)
        shape = (3, len(activity_classes.SEASONS), len(activity_classes.LOCAL_TIMES))
        chosen = np.full((len(counts), *shape), -1, np.intp)
        for k, s, t in np.ndindex(shape):
            for row, count in enumerate(counts):
                chosen[row, k, s, t] = _most_telling(codes, count, (k - 1, s, t))
        return chosen

    def _require(self, present: bool, what: str) -> None:
        if not present:
            raise QueryError(f"its temporal model has no {what}", where=self._where)

    def _arguments(
        self, latitude: ArrayLike, longitude: ArrayLike, time: Date, **more: ArrayLike
    ) -> tuple[tuple[int, ...], list[Floats], NDArray[np.datetime64]]:
        """The answer's shape, latitude, longitude and `more` flat, and flat instants."""
        from magtiles.catalog.models.dates import instant

        when = instant(time)
        self._core.years(when, allow_extrapolated=self._extrapolate)
        order = np.arange(when.size).reshape(when.shape)
        shape, flat = broadcast(latitude=latitude, longitude=longitude, **more, time=order)
        check_positions(shape, flat[0], flat[1])
        return shape, flat[:-1], when.ravel()[flat[-1].astype(np.intp)]

    def _direction(
        self, lat: Floats, lon: Floats, when: NDArray[np.datetime64]
    ) -> tuple[Floats, Floats]:
        """Unit vector of the core field on the ellipsoid, (n, 3), and dip latitude, (n,)."""
        from magtiles.catalog.models import evaluate

        known = np.isfinite(lat) & np.isfinite(lon)
        field = np.full((lat.size, 3), np.nan)
        field[known] = evaluate(
            self._core, lat[known], lon[known], 0.0, when[known], allow_extrapolated=True
        )
        horizontal = np.hypot(field[:, 0], field[:, 1])
        dip = np.degrees(np.arctan2(field[:, 2], 2.0 * horizontal))
        return field / np.linalg.norm(field, axis=1, keepdims=True), dip

    def _curves(self, lon: Floats, when: NDArray[np.datetime64]) -> tuple[Floats, Floats]:
        """Each observatory's curves and their standard errors, (element, observatory, n)."""
        months = self.months.astype("datetime64[ns]")
        at: list[Floats] = []
        for read, name in (
            (baseline_at, "baseline"),
            (standard_error_at, "baseline_standard_error"),
        ):
            found = read(months, self.variables[name], when, lon)
            at.append(np.moveaxis(found, 0, 1))
        return at[0], at[1]

    def _weights(self, lat: Floats, lon: Floats, dip: Floats, usable: Bools) -> Floats:
        """(observatory, n), adding up to 1 over the `usable` ones; NaN where there are none."""
        places = np.array([(o.latitude, o.longitude, o.dip_latitude) for o in self.observatories])
        north, east, theirs = (column[:, None] for column in places.T)
        arc = (lon - east + 180.0) % 360.0 - 180.0
        along = arc * np.cos(np.radians(0.5 * (lat + north)))
        square = _SCALE**2 + (dip - theirs) ** 2 + (along / _EAST) ** 2
        raw = np.where(usable, 1.0 / square, 0.0)
        with np.errstate(invalid="ignore"):
            return np.asarray(raw / raw.sum(axis=0))

    def _dip_distance(self, dip: Floats, weights: Floats) -> Floats:
        theirs = np.array([[o.dip_latitude] for o in self.observatories])
        return np.asarray((weights * np.abs(dip - theirs)).sum(axis=0))

    def _polar(self, dip: Floats, weights: Floats) -> Bools:
        theirs = np.abs([o.dip_latitude for o in self.observatories]) > POLAR_DIP_LATITUDE
        used = (theirs[:, None] & (weights >= _NOTICED)).any(axis=0)
        return np.asarray(used | (np.abs(dip) > POLAR_DIP_LATITUDE))


def _weighted(weights: Floats, values: Floats) -> Floats:
    """Sum over observatories, (n, element); what has no weight may be NaN."""
    with np.errstate(invalid="ignore"):
        terms = np.where(weights == 0.0, 0.0, weights * values)
    return np.asarray(terms.sum(axis=1).T)


def _into_span(
    months: NDArray[np.datetime64], time: NDArray[np.datetime64]
) -> tuple[NDArray[np.datetime64], Floats]:
    """Times moved by whole years as near to the mid-months as can be, and days still outside."""
    middles = mid_month(months)
    first, last = middles[0], middles[-1]
    year = time.astype("datetime64[Y]")
    since = time - year.astype("datetime64[ns]")
    best, least = time, _outside(first, last, time)
    for moved in np.arange(first.astype("datetime64[Y]") - 1, last.astype("datetime64[Y]") + 2):
        there = np.datetime64(moved, "ns") + since
        days = _outside(first, last, there)
        nearer = (days < least) | ((days == least) & (np.abs(there - time) < np.abs(best - time)))
        best, least = np.where(nearer, there, best), np.where(nearer, days, least)
    return best, least


def _outside(first: Any, last: Any, time: NDArray[np.datetime64]) -> Floats:
    """Days by which times lie before `first` or after `last`."""
    none = np.timedelta64(0, "ns")
    return np.asarray(np.maximum(np.maximum(first - time, time - last), none) / _DAY)


def _activity_classes(variables: Any) -> tuple[ActivityClass, ...]:
    names = (activity_classes.KP_CLASSES, activity_classes.SEASONS, activity_classes.LOCAL_TIMES)
    columns = [variables[f"class_{k}"].tolist() for k in ("kp", "season", "local_time")]
    return tuple(
        ActivityClass(*(None if c == ANY else n[c] for n, c in zip(names, codes, strict=True)))
        for codes in zip(*columns, strict=True)
    )


_GIVE_UP: tuple[tuple[Literal[0, 1], ...], ...] = (
    (1, 1, 1), (1, 0, 1), (1, 1, 0), (1, 0, 0), (0, 1, 1), (0, 0, 1), (0, 1, 0), (0, 0, 0),
)  # fmt: skip
"""Which of activity, season and local time a class must tell apart, most wanted first."""


def _most_telling(
    codes: NDArray[np.int8], counts: NDArray[Any], wanted: tuple[int, int, int]
) -> int:
    """Index of the class to use for activity, season and local time; -1 where none is known."""
    fitting = []
    for kept in _GIVE_UP:
        code = [w if keep else ANY for w, keep in zip(wanted, kept, strict=True)]
        fitting += np.flatnonzero((codes == code).all(axis=1) & (counts > 0)).tolist()
    enough = [c for c in fitting if counts[c] >= LEAST_SEGMENTS]
    if enough:
        return int(enough[0])
    return max(fitting, key=lambda c: int(counts[c]), default=-1)
