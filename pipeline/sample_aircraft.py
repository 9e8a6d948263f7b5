"""The sample aircraft: a cloverleaf and survey lines, with an aircraft's own field that is known.

The aircraft flies over a synthetic survey in the exact field of its dipoles and the core field.
Its own field is P + M B + S dB/dt (see `magtiles.stages.vehicle.tolles_lawson.terms`); the scalar
magnetometer measures the length of the whole vector, so that nothing is linearised.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.interpolate
import scipy.signal
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magtiles.catalog.kernels.geodesy import metres_per_degree
from magtiles.pipeline.artifacts import write_artifact
from magtiles.pipeline.sample_observatories import write_record
from magtiles.pipeline.synthetic import Sample, core_field
from magtiles.pipeline.synthetic_observatories import StationSpec
from magtiles.stages.release.atomic import atomic_path
from magtiles.stages.vehicle.tolles_lawson.terms import AXES, EDDY, INDUCED, PERMANENT, term_units

Floats = NDArray[np.float64]

_GRAVITY = 9.80665  # m s-2, standard

_SOURCE_TOML = """\
# A synthetic aircraft: scalar and vector magnetometer, in body axes forward, right, down.
[source]
id = "{stem}"
kind = "track"
files = ["{stem}.csv"]
licence = "CC0-1.0"
title = "Synthetic flight with exact truth beside it"

[log]
units = "nT"
height_reference = "ellipsoid"
sensor_to_body = "forward,right,down"
column_units = {{speed_m_s = "m s-1"}}

[log.columns]
time = "time_utc"
field_total = "mag_total_nt"
field_x = "flux_x_nt"
field_y = "flux_y_nt"
field_z = "flux_z_nt"
latitude = "latitude_deg"
longitude = "longitude_deg"
height = "height_m"
speed = "speed_m_s"
line = "line"
"""

_BASE = StationSpec(
    code="XBS", name="Synthetic base station", latitude=46.0, longitude=-121.5,
    elevation_m=100.0, reported="XYZF", crust_nt=(0.0, 0.0, 0.0), sq=((), (), ()),
    storm=(0.0, 0.0, 0.0), sigma_nt=((0.0,) * 3, (0.0,) * 3), tau_s=((0.0,) * 3, (0.0,) * 3),
    gaps=(),
)  # fmt: skip
"""Of the flight's day; it reads the core field and the variation, by the minute."""


@dataclass(frozen=True)
class Aircraft:
    """An aircraft, its sensors and its flight. Metres, degrees, seconds, nT.

    Attributes
    ----------
    permanent, induced, eddy : P (3) nT, M (3, 3) symmetric, S (3, 3) s; forward, right, down.
    swing_deg : amplitudes of the roll, pitch and yaw of a calibration.
    gust_deg : rms of what the air does to each angle.
    scalar_noise_nt, vector_noise_nt : white, 1 sigma, of each sample and component.
    """

    latitude: float = 46.0
    longitude: float = -121.5
    height_m: float = 3000.0
    start: str = "1990-07-01T18:00:00"
    rate_hz: float = 10.0
    speed_m_s: float = 70.0
    turn_deg_s: float = 3.0
    swing_deg: tuple[float, float, float] = (10.0, 5.0, 5.0)
    swing_hz: float = 0.25
    swing_s: float = 20.0
    lines: int = 4
    line_s: float = 210.0
    gust_deg: float = 0.3
    permanent: tuple[float, float, float] = (42.0, -27.0, 61.0)
    induced: tuple[tuple[float, float, float], ...] = (
        (1.4e-3, -3.0e-4, 5.0e-4),
        (-3.0e-4, -9.0e-4, 2.0e-4),
        (5.0e-4, 2.0e-4, 8.0e-4),
    )
    eddy: tuple[tuple[float, float, float], ...] = (
        (1.2e-3, -4.0e-4, 9.0e-4),
        (3.0e-4, 2.1e-3, -6.0e-4),
        (-1.1e-3, 5.0e-4, 1.7e-3),
    )
    scalar_noise_nt: float = 0.02
    vector_noise_nt: float = 5.0
    seed: int = 20260102


AIRCRAFT = Aircraft()


@dataclass(frozen=True)
class Flight:
    """What a flight measured and the truth behind it, both along (time)."""

    track: xr.Dataset
    truth: xr.Dataset


def coefficients(aircraft: Aircraft) -> dict[str, float]:
    """The aircraft's 18 Tolles-Lawson coefficients by the name of their term."""
    m, s = np.array(aircraft.induced), np.array(aircraft.eddy)
    values = dict(zip(PERMANENT, aircraft.permanent, strict=True))
    for name in INDUCED:
        i, j = (AXES.index(axis) for axis in name[-2:])
        values[name] = float(m[i, j] if i == j else m[i, j] + m[j, i])
    values |= {name: float(s[AXES.index(name[-2]), AXES.index(name[-1])]) for name in EDDY}
    return values


def fly(sample: Sample, aircraft: Aircraft = AIRCRAFT) -> Flight:
    """Fly over a synthetic survey; the same for the same sample and aircraft.

    The core field is that of the day of the flight.
    """
    rng = np.random.default_rng(aircraft.seed)
    heading, angles, line = _plan(aircraft)
    place = _path(aircraft, heading)
    attitude = _attitude(aircraft, heading, angles, rng)
    core = core_field(replace(sample.spec, epoch=aircraft.start[:10]), *place)
    earth = core + sample.truth(*place)[1]
    body = attitude.apply(earth, inverse=True)
    own = _own_field(aircraft, body)
    scalar = np.linalg.norm(body + own, axis=1)
    step = np.timedelta64(round(1e9 / aircraft.rate_hz), "ns")
    time = np.datetime64(aircraft.start, "ns") + step * np.arange(heading.size)
    fields = {
        "field_total": scalar + rng.normal(0.0, aircraft.scalar_noise_nt, scalar.shape),
        "field_body": body + rng.normal(0.0, aircraft.vector_noise_nt, body.shape),
    }
    track = _track(aircraft, time, place, attitude, line, fields)
    return Flight(track, _truth(aircraft, time, core, earth, scalar, own))


def diurnal(time: NDArray[np.datetime64]) -> Floats:
    """What the flight's day adds to the total field (n,), nT: a quiet day's curve and a wave."""
    hours = (time - time.astype("datetime64[D]")) / np.timedelta64(1, "h")
    day = -16.0 * np.exp(-0.5 * ((hours - 20.0) / 2.5) ** 2)
    return np.asarray(day + 3.0 * np.sin(2.0 * np.pi * hours / 0.8))


def on_its_day(flight: Flight) -> Flight:
    """The flight with the variation of its day, which lies along the field wherever it is."""
    varied = diurnal(flight.track["time"].values)
    track, truth = flight.track.copy(), flight.truth.copy()
    total = truth["external_field_total"]
    track["field_total"] = track["field_total"].copy(data=track["field_total"].values + varied)
    larger = 1.0 + varied / total.values
    track["field_body"] = track["field_body"].copy(
        data=track["field_body"].values * larger[:, None]
    )
    truth["external_field_total"] = total.copy(data=total.values + varied)
    truth["diurnal"] = ("time", varied, {"units": "nT"})
    return Flight(track, truth)


def write_base_station(folder: Path, stem: str, sample: Sample, day: str) -> list[Path]:
    """The base station's day as IAGA-2002 and its source TOML, ``<stem>.toml``."""
    time = np.datetime64(day, "m") + np.arange(1440)
    place = _BASE.latitude, _BASE.longitude, _BASE.elevation_m
    core = core_field(replace(sample.spec, epoch=day), *place)
    total = float(np.linalg.norm(core))
    values = core * (1.0 + diurnal(time)[:, None] / total)
    columns = np.column_stack([values, np.linalg.norm(values, axis=1)])
    return write_record(folder, stem, _BASE, time, columns)


def write_flight(folder: Path, sample: Sample, aircraft: Aircraft = AIRCRAFT) -> list[Path]:
    """Write the flight over a sample, on its day, as track/1 and as CSV; the same bytes always.

    Returns ``<name>-flight.nc``, ``<name>-flight.csv``, the CSV's source TOML,
    ``<name>-flight-truth.nc`` and what `write_base_station` does. The CSV has a line of column
    names with units; attitude is w, x, y, z.
    """
    flight = on_its_day(fly(sample, aircraft))
    stem = f"{sample.spec.name}-flight"
    track, table, toml, truth = (
        folder / f"{stem}{end}" for end in (".nc", ".csv", ".toml", "-truth.nc")
    )
    write_artifact(flight.track, track, "track/1")
    with atomic_path(table) as temporary:
        _write_csv(flight.track, temporary)
    with atomic_path(toml) as temporary:
        temporary.write_text(_SOURCE_TOML.format(stem=stem), encoding="ascii")
    encoding: dict[Any, Any] = {name: {"_FillValue": None} for name in flight.truth.data_vars}
    with atomic_path(truth) as temporary:
        flight.truth.to_netcdf(temporary, engine="netcdf4", format="NETCDF4", encoding=encoding)
    base = write_base_station(folder, f"{sample.spec.name}-base", sample, aircraft.start[:10])
    return [track, table, toml, truth, *base]


def _write_csv(track: xr.Dataset, path: Path) -> None:
    numbers = {
        "latitude_deg": ("latitude", "%.8f"),
        "longitude_deg": ("longitude", "%.8f"),
        "height_m": ("height", "%.2f"),
        "mag_total_nt": ("field_total", "%.3f"),
        "flux_{}_nt": ("field_body", "%.1f"),
        "attitude_{}": ("attitude", "%.6f"),
        "speed_m_s": ("speed", "%.2f"),
        "line": ("line", "%d"),
    }
    utc = np.datetime_as_string(track["time"].values, unit="ms", timezone="UTC")
    columns: dict[str, Any] = {"time_utc": utc}
    for title, (name, form) in numbers.items():
        values = track[name].values.reshape(track.sizes["time"], -1)
        parts = "xyz" if values.shape[1] == 3 else "wxyz"
        for part, column in zip(parts, values.T, strict=False):
            columns[title.format(part)] = np.char.mod(form, column)
    lines = map(",".join, zip(*columns.values(), strict=True))
    path.write_text("\n".join([",".join(columns), *lines]) + "\n", encoding="ascii")


def _plan(aircraft: Aircraft) -> tuple[Floats, Floats, NDArray[np.int32]]:
    """Heading (n), swings in roll, pitch and yaw (n, 3), degrees, and line number (n), 0 = none."""
    step = 1.0 / aircraft.rate_hz
    rates, swings, lines = [], [], []
    for turn_deg, swing, line in _legs(aircraft):
        rates.append(_turn(turn_deg, aircraft.turn_deg_s, step) if turn_deg else 0.0 * swing[:, 0])
        swings.append(np.zeros((rates[-1].size, 3)) if turn_deg else swing)
        lines.append(np.full(rates[-1].size, line, np.int32))
    return np.cumsum(np.concatenate(rates)) * step, np.concatenate(swings), np.concatenate(lines)


def _legs(aircraft: Aircraft) -> Iterator[tuple[float, Floats, int]]:
    """Turn (degrees, 0 for a straight leg), swings (n, 3) and line number, in order.

    First a cloverleaf, its legs 101 to 104 on headings north, west, south, east; then parallel
    lines 201 and on, flown west and east.
    """
    calibration = _swings(aircraft)
    nothing = np.zeros((0, 3))
    yield 0.0, np.zeros((round(30.0 * aircraft.rate_hz), 3)), 0
    for leg in range(4):
        yield 0.0, calibration, 101 + leg
        yield (270.0 if leg < 3 else 180.0), nothing, 0
    straight = np.zeros((round(aircraft.line_s * aircraft.rate_hz), 3))
    for line in range(aircraft.lines):
        if line:
            yield (180.0 if line % 2 else -180.0), nothing, 0
        yield 0.0, straight, 201 + line


def _swings(aircraft: Aircraft) -> Floats:
    """A leg's rolls, pitches and yaws, one after the other, (n, 3) degrees."""
    rate = aircraft.rate_hz
    t = np.arange(round(aircraft.swing_s * rate)) / rate
    taper = np.minimum(1.0, np.minimum(t, aircraft.swing_s - t) * aircraft.swing_hz)
    wave = np.sin(0.5 * np.pi * taper) ** 2 * np.sin(2.0 * np.pi * aircraft.swing_hz * t)
    rest = np.zeros((round(6.0 * rate), 3))
    parts = [rest]
    for axis, amplitude in enumerate(aircraft.swing_deg):
        parts += [amplitude * np.outer(wave, np.eye(3)[axis]), rest]
    return np.concatenate(parts)


def _turn(angle_deg: float, rate_deg_s: float, step: float) -> Floats:
    """Rate of a turn through `angle_deg`, degrees per second, smooth where it begins and ends."""
    ramp = np.sin(np.linspace(0.0, 0.5 * np.pi, round(6.0 / step))) ** 2
    steady = abs(angle_deg) / (rate_deg_s * step) - ramp.sum() * 2.0
    shape = np.concatenate([ramp, np.ones(round(steady)), ramp[::-1]])
    rate: Floats = shape * angle_deg / (shape.sum() * step)
    return rate


def _path(aircraft: Aircraft, heading: Floats) -> tuple[Floats, Floats, Floats]:
    """Latitude, longitude (degrees) and height (m) along the headings, at constant speed."""
    metres = aircraft.speed_m_s / aircraft.rate_hz
    north, east = metres * np.cos(np.radians(heading)), metres * np.sin(np.radians(heading))
    height = np.full(heading.size, aircraft.height_m)
    per_latitude, _ = metres_per_degree(np.array(aircraft.latitude), aircraft.height_m)
    latitude = aircraft.latitude + np.cumsum(north) / per_latitude
    _, per_longitude = metres_per_degree(latitude, height)
    return latitude, aircraft.longitude + np.cumsum(east / per_longitude), height


def _attitude(
    aircraft: Aircraft, heading: Floats, swings: Floats, rng: np.random.Generator
) -> Rotation:
    """Rotations (n) that turn body into north, east, down: a coordinated turn, swings, gusts."""
    turning = np.radians(np.gradient(np.unwrap(heading, period=360.0)) * aircraft.rate_hz)
    bank = np.degrees(np.arctan(aircraft.speed_m_s * turning / _GRAVITY))
    low_pass = scipy.signal.butter(4, 0.3, fs=aircraft.rate_hz, output="sos")
    gust = scipy.signal.sosfiltfilt(low_pass, rng.normal(size=swings.shape), axis=0)
    roll, pitch, yaw = (swings + aircraft.gust_deg * gust / gust.std(axis=0)).T
    return Rotation.from_euler(
        "ZYX", np.stack([heading + yaw, 2.0 + pitch, bank + roll], axis=1), degrees=True
    )


def _own_field(aircraft: Aircraft, body: Floats) -> Floats:
    """The aircraft's own field, (n, 3) nT in body axes."""
    t = np.arange(len(body)) / aircraft.rate_hz
    rate = scipy.interpolate.make_interp_spline(t, body, k=5).derivative()(t)
    induced, eddy = np.array(aircraft.induced), np.array(aircraft.eddy)
    own: Floats = np.array(aircraft.permanent) + body @ induced.T + rate @ eddy.T
    return own


def _track(
    aircraft: Aircraft,
    time: Any,
    place: tuple[Floats, Floats, Floats],
    attitude: Rotation,
    line: NDArray[np.int32],
    fields: dict[str, Floats],
) -> xr.Dataset:
    latitude, longitude, height = place
    speed = np.full(time.size, aircraft.speed_m_s)
    about = "scalar first (w, x, y, z); turns body (forward, right, down) into north, east, down"
    quaternion = np.roll(attitude.as_quat(), 1, axis=1)
    return xr.Dataset(
        {
            "latitude": ("time", latitude, {"units": "degrees_north"}),
            "longitude": ("time", longitude, {"units": "degrees_east"}),
            "height": ("time", height, {"units": "m", "positive": "up"}),
            "field_total": ("time", fields["field_total"], {"units": "nT"}),
            "field_body": (("time", "axis"), fields["field_body"], {"units": "nT"}),
            "attitude": (("time", "quaternion"), quaternion, {"units": "1", "comment": about}),
            "speed": ("time", speed, {"units": "m s-1"}),
            "line": ("time", line, {"comment": "0 while turning"}),
        },
        coords={"time": time},
        attrs={"height_reference": "ellipsoid", "source": "synthetic aircraft"},
    )


def _truth(
    aircraft: Aircraft, time: Any, core: Floats, earth: Floats, scalar: Floats, own: Floats
) -> xr.Dataset:
    """What the flight's sensors would have measured without noise, and without the aircraft."""
    total, core_total = np.linalg.norm(earth, axis=1), np.linalg.norm(core, axis=1)
    known = coefficients(aircraft)
    nt = {"units": "nT"}
    return xr.Dataset(
        {
            "external_field_total": ("time", total, nt),
            "core_field_total": ("time", core_total, nt),
            "magnetic_anomaly": ("time", total - core_total, nt),
            "aircraft_field_total": ("time", scalar - total, nt),
            "aircraft_field_body": (("time", "axis"), own, nt),
            "coefficient": ("term", np.array(list(known.values()))),
            "coefficient_unit": ("term", term_units(list(known))),
        },
        coords={"time": time, "term": list(known)},
        attrs={"title": "exact fields along the flight of the synthetic aircraft"},
    )
