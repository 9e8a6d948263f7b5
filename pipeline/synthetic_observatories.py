"""Synthetic observatories: quiet-day curves, Gauss-Markov noise by activity, a storm, all known.

The record of an element is level + Sq(local time) * growth(date) + noise + storm. The noise is
first-order Gauss-Markov with the sigma and tau of its three-hour interval's activity class, so
that each segment of three hours is exactly what is fitted to it.
"""

from __future__ import annotations

import datetime
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import ppigrf
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy.signal import lfilter

from magtiles.catalog.kernels.activity_classes import kp_class
from magtiles.catalog.kernels.local_time import mid_month, solar_minute
from magtiles.stages.temporal.quiet_days import kp_quiet_days

Floats = NDArray[np.float64]
Times = NDArray[np.datetime64]

_HOUR, _MINUTE = np.timedelta64(1, "h"), np.timedelta64(1, "m")
_SLOT_H = 3

Wave = tuple[float, float, float]
"""A bell of the day: nT, local hour of its crest, width (1 sigma) in hours."""


@dataclass(frozen=True)
class StationSpec:
    """An observatory: where it is, what is reported, and what happens there.

    Attributes
    ----------
    crust_nt : what the station has above the core field, north, east, down.
    sq : bells of north, east, down on a quiet day.
    storm : shares of the storm in north, east, down.
    sigma_nt, tau_s : (quiet, stormy) and north, east, down.
    gaps : first minute of the record and how many are missing.
    """

    code: str
    name: str
    latitude: float
    longitude: float
    elevation_m: float
    reported: str
    crust_nt: tuple[float, float, float]
    sq: tuple[tuple[Wave, ...], tuple[Wave, ...], tuple[Wave, ...]]
    storm: tuple[float, float, float]
    sigma_nt: tuple[tuple[float, float, float], tuple[float, float, float]]
    tau_s: tuple[tuple[float, float, float], tuple[float, float, float]]
    gaps: tuple[tuple[int, int], ...]


MIDDLE = StationSpec(
    code="XMD",
    name="Synthetic middle latitude",
    latitude=45.6,
    longitude=-120.9,
    elevation_m=420.0,
    reported="XYZF",
    crust_nt=(60.0, -35.0, 110.0),
    sq=(((-24.0, 11.0, 2.1),), ((17.0, 8.4, 1.7), (-21.0, 13.4, 1.9)), ((-9.0, 11.8, 2.2),)),
    storm=(0.75, 0.1, -0.12),
    sigma_nt=((1.5, 1.3, 1.0), (9.0, 8.0, 5.0)),
    tau_s=((1500.0, 1200.0, 2000.0), (2400.0, 1800.0, 3000.0)),
    gaps=((9_000, 47), (21_500, 260), (48_111, 1), (70_002, 3)),
)
EQUATOR = StationSpec(
    code="XEQ",
    name="Synthetic dip equator",
    latitude=-11.9,
    longitude=-75.2,
    elevation_m=3300.0,
    reported="HDZF",
    crust_nt=(-40.0, 20.0, 75.0),
    sq=(((95.0, 11.2, 2.2),), ((9.0, 8.8, 1.7), (-7.0, 14.6, 2.0)), ((-14.0, 10.9, 2.1),)),
    storm=(1.0, 0.05, 0.1),
    sigma_nt=((1.5, 1.2, 1.0), (10.0, 6.0, 5.0)),
    tau_s=((1800.0, 1400.0, 1600.0), (2700.0, 2000.0, 2200.0)),
    gaps=((30_333, 12), (55_000, 400)),
)


@dataclass(frozen=True)
class TemporalSpec:
    """Stations, months and activity; the same spec gives the same minutes.

    Attributes
    ----------
    growth_per_month : by which the quiet-day curves grow, from 1 at the first mid-month.
    storm_start : hours after the start of the record; the sudden commencement.
    storm_nt, storm_hours : depth of the main phase, and how long it takes to be over.
    """

    stations: tuple[StationSpec, ...] = (MIDDLE, EQUATOR)
    months: tuple[str, ...] = ("2024-02", "2024-03")
    growth_per_month: float = 0.08
    storm_start: int = 16 * 24 + 5
    storm_nt: float = 140.0
    storm_hours: int = 61
    seed: int = 15


DEMO_TEMPORAL = TemporalSpec()


@dataclass(frozen=True)
class Station:
    """A station's record, (minute, 3) nT north, east, down with NaN gaps, and its truth."""

    spec: StationSpec
    level: Floats
    record: Floats


class TemporalSample:
    """Records, Kp and the truth of a spec."""

    def __init__(self, spec: TemporalSpec = DEMO_TEMPORAL) -> None:
        self.spec = spec
        self.months = np.array(spec.months, "datetime64[M]")
        start, end = self.months[0], self.months[-1] + 1
        self.time: Times = np.arange(start, end, _MINUTE, dtype="datetime64[m]")
        self.slots: Times = np.arange(start, end, _SLOT_H * _HOUR, dtype="datetime64[h]")

    @cached_property
    def kp(self) -> Floats:
        """Kp of every three hours, in thirds: calm and restless days, and the storm's."""
        rng = np.random.default_rng(self.spec.seed)
        days = np.arange(len(self.slots) // 8 + 2)
        restless = rng.gamma(1.6, 0.75, days.size)
        raw = np.interp(np.arange(len(self.slots)) / 8.0, days, restless)
        raw += rng.normal(0.3, 0.55, raw.size)
        hours = (self.slots - self.slots[0]) / _HOUR - self.spec.storm_start
        of_storm = np.interp(hours, (-3, 0, 9, 24, self.spec.storm_hours), (0, 6.0, 8.0, 5.0, 3.2))
        stormy = (hours > -_SLOT_H) & (hours < self.spec.storm_hours)
        raw = np.where(stormy, np.maximum(of_storm, 3.0), np.minimum(raw, 5.0))
        thirds: Floats = np.round(np.clip(raw, 0.0, 9.0) * 3.0) / 3.0
        return thirds

    def ranked_days(self, month: np.datetime64) -> tuple[list[int], list[int]]:
        """Days of a month: the ten quietest and the five most disturbed, first ones first."""
        index = xr.Dataset(
            {"kp": ("time", self.kp)}, coords={"time": self.slots.astype("datetime64[ns]")}
        )
        quiet = kp_quiet_days(index, month)
        inside = self.slots.astype("datetime64[M]") == month
        sums = self.kp[inside].reshape(-1, 8).sum(axis=1)
        disturbed = np.argsort(-sums, kind="stable")[:5] + 1
        first = month.astype("datetime64[D]")
        return ((quiet - first).astype(int) + 1).tolist(), disturbed.tolist()

    def growth(self, time: Times) -> Floats:
        """Factor of the quiet-day curves at instants, linear in time."""
        middle = mid_month(self.months[:1])[0]
        elapsed = (time.astype("datetime64[s]") - middle.astype("datetime64[s]")) / _HOUR
        grown: Floats = 1.0 + self.spec.growth_per_month * elapsed / (30.0 * 24.0)
        return grown

    def sq(self, station: StationSpec, time: Times) -> Floats:
        """The quiet-day variation at instants (...), (..., 3) nT north, east, down."""
        curve = quiet_curve(station, solar_minute(time, station.longitude))
        return np.asarray(self.growth(time)[..., None] * curve)

    def storm(self, time: Times) -> Floats:
        """The storm at instants, nT along its direction: sudden rise, fall, slow recovery."""
        hours = (time.astype("datetime64[m]") - self.time[0]) / _HOUR - self.spec.storm_start
        rise = 30.0 * np.interp(hours, (0.0, 0.05, 2.5, 4.0), (0.0, 1.0, 1.0, 0.0))
        fall = np.interp(hours, (3.0, 10.0), (0.0, 1.0)) * np.exp(-np.maximum(hours - 10.0, 0) / 18)
        over = np.clip((self.spec.storm_hours - hours) / 12.0, 0.0, 1.0)
        field: Floats = np.where(hours < 0.0, 0.0, rise - self.spec.storm_nt * fall * over)
        return field

    def in_storm(self, time: Times) -> NDArray[np.bool_]:
        """Whether instants lie within the storm."""
        hours = (time.astype("datetime64[m]") - self.time[0]) / _HOUR - self.spec.storm_start
        return np.asarray((hours >= 0) & (hours < self.spec.storm_hours))

    def station(self, number: int) -> Station:
        """One station's minutes."""
        spec = self.spec.stations[number]
        level = core_field(spec, self.time[len(self.time) // 2]) + np.array(spec.crust_nt)
        record = level + self.sq(spec, self.time) + self._noise(spec, number)
        record += self.storm(self.time)[:, None] * np.array(spec.storm)
        for first, count in spec.gaps:
            record[first : first + count] = np.nan
        return Station(spec, level, record)

    def _noise(self, spec: StationSpec, number: int) -> Floats:
        """Gauss-Markov noise (minute, 3), stationary within every three hours."""
        rng = np.random.default_rng([self.spec.seed, number])
        classes = kp_class(self.kp)
        minutes = _SLOT_H * 60
        noise = np.empty((len(self.slots), minutes, 3))
        last = rng.normal(size=3)
        for slot, stormy in enumerate(classes.tolist()):
            for axis in range(3):
                keep = np.exp(-60.0 / spec.tau_s[stormy][axis])
                steps = np.sqrt(1.0 - keep**2) * rng.normal(size=minutes)
                unit, _ = lfilter([1.0], [1.0, -keep], steps, zi=[keep * last[axis]])
                last[axis] = unit[-1]
                noise[slot, :, axis] = spec.sigma_nt[stormy][axis] * unit
        return noise.reshape(-1, 3)[: len(self.time)]


def quiet_curve(station: StationSpec, minute: ArrayLike) -> Floats:
    """The station's curve of growth 1 at minutes (...) of local solar time, (..., 3) nT."""
    hour = np.asarray(minute, np.float64) / 60.0
    elements = []
    for waves in station.sq:
        # A bell reaches midnight from its own day, and from the days before and after.
        bells = [
            height * np.exp(-0.5 * ((hour + day - crest) / width) ** 2)
            for height, crest, width in waves
            for day in (-24.0, 0.0, 24.0)
        ]
        elements.append(np.sum(bells, axis=0))
    return np.stack(elements, axis=-1)


def core_field(station: StationSpec, time: np.datetime64) -> Floats:
    """IGRF at the station, (3,) nT north, east, down."""
    date = time.astype("datetime64[s]").astype(datetime.datetime)
    field: Any = ppigrf.igrf(station.longitude, station.latitude, station.elevation_m / 1e3, date)
    east, north, up = (float(np.squeeze(component)) for component in field)
    return np.array([north, east, -up])


def truth_dataset(sample: TemporalSample) -> xr.Dataset:
    """What the estimates should find: curves at mid-months, sigma and tau by class, the storm."""
    stations, minute = sample.spec.stations, np.arange(1440.0)
    growth = sample.growth(mid_month(sample.months))
    curves = np.stack([quiet_curve(s, minute).T for s in stations])
    of_class = ("observatory", "element", "kp_class")
    return xr.Dataset(
        {
            "baseline": (
                ("observatory", "element", "month", "minute"),
                curves[:, :, None, :] * growth[:, None],
                {"units": "nT", "long_name": "quiet-day variation at mid-month"},
            ),
            "level": (
                ("observatory", "element"),
                np.stack([sample.station(i).level for i in range(len(stations))]),
                {"units": "nT"},
            ),
            "sigma": (
                of_class,
                np.moveaxis(np.array([s.sigma_nt for s in stations]), 1, 2),
                {"units": "nT"},
            ),
            "tau": (
                of_class,
                np.moveaxis(np.array([s.tau_s for s in stations]), 1, 2),
                {"units": "s"},
            ),
            "storm": ("time", sample.storm(sample.time), {"units": "nT"}),
            "storm_share": (("observatory", "element"), np.array([s.storm for s in stations])),
            "kp": ("slot", sample.kp, {"units": "1"}),
        },
        coords={
            "iaga_code": ("observatory", np.array([s.code for s in stations])),
            "element": ("element", np.array(["north", "east", "down"])),
            "kp_class": ("kp_class", np.array(["quiet", "stormy"])),
            "month": ("month", sample.months.astype("datetime64[ns]")),
            "minute": ("minute", minute, {"units": "min", "long_name": "local mean solar time"}),
            "time": ("time", sample.time.astype("datetime64[ns]")),
            "slot": ("slot", sample.slots.astype("datetime64[ns]")),
        },
        attrs={"Conventions": "CF-1.11", "title": "exact content of the synthetic records"},
    )
