"""Baselines and Gauss-Markov statistics of a release, against analytic curves and ppigrf."""

from __future__ import annotations

import datetime
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import ppigrf
import pytest
import xarray as xr
from synthetic_release import World
from temporal import MIDDLE, SOUTH, Station, bump, temporal_dataset

from magtiles.catalog.models import read_model
from magtiles.catalog.releases.temporal import ActivityClass, TemporalModel
from magtiles.catalog.releases.temporal_file import read_temporal
from magtiles.schemas.errors import ContractError, QueryError
from magtiles.stages.release.temporal_file import write_temporal

COEFFICIENTS = Path(ppigrf.__file__).with_name("IGRF14.shc")
MID_FEBRUARY, MID_MARCH = "2024-02-15T12:00", "2024-03-16T12:00"
TENTH_NOON_UTC = 12.0 - 10.0 / 15.0  # hours, where it is local noon at 10 E

Make = Callable[[xr.Dataset], TemporalModel]


@pytest.fixture(scope="module")
def make(tmp_path_factory: pytest.TempPathFactory) -> Make:
    core = read_model(COEFFICIENTS)
    path = tmp_path_factory.mktemp("temporal") / "temporal.nc"

    def build(dataset: xr.Dataset) -> TemporalModel:
        write_temporal(dataset, path)
        return TemporalModel(read_temporal(path.read_bytes(), path), lambda: core, "release x")

    return build


@pytest.fixture(scope="module")
def model(make: Make) -> TemporalModel:
    return make(temporal_dataset())


def direction(lat: float, lon: float, date: datetime.datetime) -> Any:
    """Unit vector of the core field by ppigrf."""
    east, north, up = (float(a.squeeze()) for a in ppigrf.igrf(lon, lat, 0.0, date))
    return np.array([north, east, -up]) / np.linalg.norm([north, east, up])


def dip_latitude(lat: float, lon: float, date: datetime.datetime) -> float:
    north, east, down = direction(lat, lon, date)
    return float(np.degrees(np.arctan(down / np.hypot(north, east) / 2.0)))


MARCH = datetime.datetime(2024, 3, 1)  # noqa: DTZ001


def test_at_an_observatory_the_curve_is_its_own_and_the_total_lies_along_the_core(
    make: Make,
) -> None:
    alone = make(temporal_dataset([MIDDLE]))
    hours = np.arange(0.0, 24.0, 0.37)
    time = np.datetime64("2024-02-15", "ns") + (hours * 3.6e12).astype("timedelta64[ns]")
    found = alone.baseline(MIDDLE[1], MIDDLE[2], time)
    weight = (hours / 24.0 - 0.5) / 30.0  # from mid-February to mid-March
    scale = np.where(weight < 0, 1.0, 1.0 + 0.5 * weight)
    shape = bump((60.0 * hours + 4.0 * MIDDLE[2]) % 1440.0) * scale
    vector = shape[:, None] * np.array(MIDDLE[4][:3])
    # Linear between minutes: 20 nT * (2 pi / 1440)^2 / 16 = 2.4e-5 nT.
    assert np.abs(found.values[:, :3] - vector).max() < 5e-5
    along = vector @ direction(MIDDLE[1], MIDDLE[2], datetime.datetime(2024, 2, 15))  # noqa: DTZ001
    assert np.abs(found.values[:, 3] - along).max() < 1e-3  # ppigrf's geodetic turn
    assert found.observatories == ("MID",)
    assert np.array_equal(found.weights, np.ones((hours.size, 1)))


def test_curves_go_by_the_suns_time_of_the_place(make: Make) -> None:
    alone = make(temporal_dataset([MIDDLE]))
    # Local noon travels west with the sun, 15 degrees an hour.
    longitude = np.array([10.0, -5.0, -80.0, 130.0, 490.0])
    hours = (12.0 - longitude / 15.0) % 24.0
    time = np.datetime64("2024-02-15", "ns") + (hours * 3.6e12).astype("timedelta64[ns]")
    north = alone.baseline(30.0, longitude, time).values[:, 0]
    # Noons after mid-February are a little on the way to March, whose curve is 1.5 times.
    growth = 1.0 + 0.5 * np.maximum(hours / 24.0 - 0.5, 0.0) / 30.0
    assert north == pytest.approx(-20.0 * growth, abs=1e-6)


def test_months_join_at_their_middles(make: Make) -> None:
    alone = make(temporal_dataset([MIDDLE]))
    middles = np.array([MID_FEBRUARY, MID_MARCH], "datetime64[ns]")
    between = middles[0] + (middles[1] - middles[0]) * 2 // 5
    noon = between.astype("datetime64[D]") + np.timedelta64(int(TENTH_NOON_UTC * 3.6e12), "ns")
    weight = (noon - middles[0]) / (middles[1] - middles[0])
    found = alone.baseline(44.0, 10.0, noon)
    assert found.values[0] == pytest.approx(-20.0 * (1.0 + 0.5 * weight), abs=1e-4)
    assert found.standard_error[0] == pytest.approx(0.5 * np.hypot(1 - weight, weight), rel=1e-9)


@pytest.mark.parametrize(
    ("lat", "lon"), [(44.0, 10.0), (33.0, 11.0), (31.0, 60.0), (-5.0, -170.0), (25.0, 371.0)]
)
def test_observatories_count_by_dip_latitude_and_then_by_longitude(
    model: TemporalModel, lat: float, lon: float
) -> None:
    dip = dip_latitude(lat, lon, MARCH)
    raw = []
    for _, north, east, theirs, _ in (MIDDLE, SOUTH):
        arc = np.angle(np.exp(1j * np.radians(lon - east)), deg=True)
        arc *= np.cos(np.radians((lat + north) / 2.0))
        raw.append(1.0 / (0.01 + (dip - theirs) ** 2 + (arc / 8.0) ** 2))
    expected = np.array(raw) / np.sum(raw)
    found = model.baseline(lat, lon, "2024-03-01T05:00")
    assert found.weights == pytest.approx(expected, abs=1e-4)  # ppigrf's dip: 1e-5 degrees
    minute = (5 * 60 + 4.0 * lon) % 1440.0
    weight = 14.7083333333 / 30.0
    curves = np.array([MIDDLE[4][:3], SOUTH[4][:3]]) * bump(minute) * (1.0 + 0.5 * weight)
    assert found.values[:3] == pytest.approx(expected @ curves, abs=0.01)
    assert found.values[3] == pytest.approx(found.values[:3] @ direction(lat, lon, MARCH), abs=1e-3)
    away = abs(dip - np.array([MIDDLE[3], SOUTH[3]]))
    assert found.dip_distance == pytest.approx(expected @ away, abs=0.01)


def test_disagreement_of_observatories_widens_the_error(model: TemporalModel) -> None:
    near, between = (model.baseline(lat, 10.0, "2024-02-15T11:20") for lat in (44.0, 34.0))
    assert near.weights[0] > 0.9999
    spread = np.sqrt(near.weights[1]) * 80.0  # 0.27 nT, for 0.02 degrees of dip latitude away
    assert near.standard_error[0] == pytest.approx(np.hypot(0.5, spread), rel=1e-4)
    w = between.weights
    spread = np.sqrt(w[0] * w[1]) * 80.0  # of two values 80 nT apart
    assert between.standard_error[0] == pytest.approx(
        np.hypot(spread, 0.5 * np.hypot(*w)), rel=1e-3
    )


class Moved(NamedTuple):
    date: str
    same_as: str
    days: float
    id: str


MOVES = [
    Moved("2024-03-01T10:00", "2024-03-01T10:00", 0.0, "inside"),
    Moved("2019-03-01T10:00", "2024-02-29T10:00", 0.0, "another year, by its days"),
    Moved("2024-04-01T10:00", "2024-03-17T10:00", 15.0 + 22.0 / 24.0, "after"),
    Moved("2023-02-01T10:00", "2024-02-01T10:00", 14.0 + 2.0 / 24.0, "before, and another year"),
    Moved("2025-12-15T10:00", "2024-02-01T10:00", 62.0 + 2.0 / 24.0, "nearer from before"),
]


@pytest.mark.parametrize("case", MOVES, ids=lambda c: c.id)
def test_dates_outside_are_moved_by_whole_years(model: TemporalModel, case: Moved) -> None:
    found = model.baseline(44.0, 10.0, case.date)
    assert found.days_outside == pytest.approx(case.days, abs=0.1)
    same = model.baseline(44.0, 10.0, case.same_as)
    assert found.values[:3] == pytest.approx(same.values[:3], abs=0.02)


def test_what_an_observatory_lacks_is_left_to_others_and_to_other_months(make: Make) -> None:
    dataset = temporal_dataset()
    dataset["baseline"][0, 1] = np.nan  # east of the first
    found = make(dataset).baseline(44.0, 10.0, MID_MARCH)
    assert found.weights.tolist() == [0.0, 1.0]
    assert np.isfinite(found.values).all()
    dataset = temporal_dataset([MIDDLE])
    dataset["baseline"][0, :, 0] = np.nan
    model = make(dataset)
    noon = np.datetime64("2024-02-15", "ns") + np.timedelta64(int(TENTH_NOON_UTC * 3.6e12), "ns")
    assert model.baseline(44.0, 10.0, noon).values[0] == pytest.approx(-30.0, abs=1e-4)


class Chosen(NamedTuple):
    kp: float | None
    date: str
    classes: int
    sigma: float
    id: str


CHOICES = [
    Chosen(None, "2024-03-01T11:20", 0, 1.0, "no Kp: all segments"),
    Chosen(2.667, "2024-03-01T11:20", 1, 1.0, "quiet"),
    Chosen(3.0, "2024-03-01T11:20", 2, 11.0, "stormy"),
    Chosen(9.0, "2024-03-01T02:20", 2, 11.0, "stormy nights are too few"),
    Chosen(np.nan, "2024-03-01T02:20", 0, 1.0, "unknown Kp"),
]


@pytest.mark.parametrize("case", CHOICES, ids=lambda c: c.id)
def test_fogm_takes_the_most_telling_class_with_enough_segments(make: Make, case: Chosen) -> None:
    model = make(temporal_dataset([MIDDLE]))
    found = model.fogm(44.0, 10.0, case.date, kp=case.kp)
    assert found.classes.tolist() == [case.classes]
    assert found.sigma == pytest.approx(case.sigma + 0.1 * np.arange(4))
    assert found.tau == pytest.approx([600.0] * 4)


def test_few_segments_are_better_than_none(make: Make) -> None:
    dataset = temporal_dataset([MIDDLE])
    dataset["class_segments"] = dataset["class_segments"].copy(
        data=np.broadcast_to(np.array([9, 5, 4, 1], np.int32), (1, 4, 4))
    )
    model = make(dataset)
    assert model.classes[0] == ActivityClass(None, None, None)
    assert model.classes[3] == ActivityClass("stormy", None, "00-06")
    assert model.fogm(44.0, 10.0, "2024-03-01T02:20", kp=9.0).classes.tolist() == [0]


def test_fogm_between_observatories_keeps_variance_and_memory(model: TemporalModel) -> None:
    found = model.fogm(33.0, 11.0, "2024-03-01T11:20", kp=5.0)
    w = found.weights
    sigma = np.array([11.0, 12.0])[:, None] + 0.1 * np.arange(4)
    variance = w @ sigma**2
    assert found.sigma == pytest.approx(np.sqrt(variance), rel=1e-12)
    assert found.tau == pytest.approx(w @ (sigma**2 * [[600.0], [1200.0]]) / variance, rel=1e-12)
    assert found.tau_unidentified.all()  # the second observatory's, which counts there
    assert not model.fogm(44.0, 10.0, MARCH, kp=5.0).tau_unidentified.any()
    assert found.classes.tolist() == [2, 2]


def test_seasons_and_quarters_of_the_day_are_told_apart(make: Make) -> None:
    station: Station = ("SIX", -33.0, 18.0, -45.0, (1.0, 1.0, 1.0, 1.0))
    dataset = temporal_dataset([station])
    dataset["class_kp"][:] = -1
    dataset["class_season"][:] = [-1, 2, 1, 2]
    dataset["class_local_time"][:] = [-1, -1, -1, 2]
    dataset["class_segments"] = dataset["class_segments"].copy(
        data=np.full((1, 4, 4), 100, np.int32)
    )
    model = make(dataset)
    january, march = "2024-01-10T", "2024-03-10T"
    classes = [
        int(model.fogm(-33.0, 18.0, day + hour, kp=1.0).classes[0])
        for day, hour in ((january, "13:00"), (january, "20:00"), (march, "13:00"))
    ]
    assert classes == [3, 1, 2]  # southern summer, at 14:12 of the sun; its evening; equinox


def test_polar_latitudes_are_flagged(make: Make) -> None:
    auroral: Station = ("AUR", 69.0, 19.0, 66.0, (1.0, 1.0, 1.0, 1.0))
    model = make(temporal_dataset([MIDDLE, auroral]))
    latitude = np.array([44.0, 57.0, 75.0, -80.0])
    assert model.baseline(latitude, 12.0, MARCH).polar.tolist() == [False, True, True, True]
    assert model.fogm(latitude, 12.0, MARCH).polar.tolist() == [False, True, True, True]


def test_arguments_broadcast_and_missing_positions_are_nan(model: TemporalModel) -> None:
    latitude = np.array([[44.0], [np.nan], [20.0]])
    time = np.array(["2024-03-01", "2024-03-02"], "datetime64[s]")
    found = model.baseline(latitude, 11.0, time)
    assert found.values.shape == found.standard_error.shape == (3, 2, 4)
    assert found.weights.shape == (3, 2, 2)
    assert found.polar.shape == found.days_outside.shape == (3, 2)
    assert np.isnan(found.values[1]).all()
    assert np.isfinite(found.values[[0, 2]]).all()
    fogm = model.fogm(latitude, 11.0, time, kp=[1.0, 6.0])
    assert fogm.sigma.shape == (3, 2, 4)
    assert np.isnan(fogm.sigma[1]).all()
    alone = model.fogm(20.0, 11.0, time[1], kp=6.0)
    assert alone.sigma.shape == (4,)
    assert np.array_equal(fogm.sigma[2, 1], alone.sigma)


def test_an_unbounded_tau_is_infinite_and_flagged(make: Make) -> None:
    dataset = temporal_dataset()
    tau = np.array(dataset["class_tau"].values)
    tau[0] = np.inf
    dataset["class_tau"] = (dataset["class_tau"].dims, tau, {"units": "s"})
    found = make(dataset).fogm(44.0, 10.0, MARCH)
    assert np.isinf(found.tau).all()
    assert found.tau_unidentified.all()


def only(dataset: xr.Dataset, *prefixes: str) -> xr.Dataset:
    """Without the variables that begin so."""
    return dataset.drop_vars([str(n) for n in dataset.variables if str(n).startswith(prefixes)])


class Wrong(NamedTuple):
    ask: Callable[[TemporalModel], Any]
    message: str
    id: str


WRONGS = [
    Wrong(lambda m: m.fogm(44.0, 10.0, MARCH, kp=[1.0, 30.0]), r"kp\[1\]: is 30", "Kp in thirds"),
    Wrong(lambda m: m.baseline(95.0, 10.0, MARCH), "latitude: is 95", "latitude"),
    Wrong(lambda m: m.baseline(44.0, 10.0, "spring"), "spring", "no date"),
    Wrong(lambda m: m.baseline(44.0, 10.0, "1100-01-01"), "1700", "date of long ago"),
    Wrong(lambda m: m.baseline(44.0, 10.0, "2090-01-01"), "2090", "beyond the core field"),
    Wrong(lambda m: m.baseline([1.0, 2.0], [1.0, 2.0, 3.0], MARCH), "broadcast", "shapes"),
]


@pytest.mark.parametrize("case", WRONGS, ids=lambda c: c.id)
def test_what_cannot_be_asked(model: TemporalModel, case: Wrong) -> None:
    with pytest.raises(QueryError, match=case.message):
        case.ask(model)


def test_a_part_that_is_not_there_is_named(make: Make) -> None:
    dataset = temporal_dataset()
    curves = make(only(dataset, "class", "sigma", "tau", "segment", "kp"))
    assert np.isfinite(curves.baseline(44.0, 10.0, MARCH).values).all()
    with pytest.raises(QueryError, match="release x: its temporal model has no Gauss-Markov"):
        curves.fogm(44.0, 10.0, MARCH)
    statistics = make(only(dataset, "baseline", "month", "minute", "quiet"))
    assert np.isfinite(statistics.fogm(44.0, 10.0, MARCH).sigma).all()
    with pytest.raises(QueryError, match="no quiet-day baselines"):
        statistics.baseline(44.0, 10.0, MARCH)


def test_a_release_brings_it_with_its_core_field(tmp_path: Path) -> None:
    from magtiles.catalog import open_release

    write_temporal(temporal_dataset(), tmp_path / "t.nc")
    small = World(heights=(0.0, 1000.0))
    extra = {"temporal.nc": tmp_path / "t.nc"}
    with pytest.raises(ContractError, match="without a core field"):
        small.publish(tmp_path, extra_files=extra)
    path = small.publish(tmp_path, extra_files={**extra, "core_field.shc": COEFFICIENTS}).path
    release = open_release(path)
    assert release.manifest.temporal is not None
    found = release.temporal.baseline(44.2, 10.3, MARCH)
    assert np.isfinite(found.values).all()
    assert release.temporal is release.temporal
    assert [o.code for o in release.temporal.observatories] == ["MID", "SOU"]
    assert release.temporal.months.astype(str).tolist() == ["2024-02", "2024-03"]
    with pytest.raises(ValueError, match="read-only"):
        release.temporal.variables["baseline"][0] = 0.0


def test_a_release_without_one_says_so(folder: Path) -> None:
    from magtiles.catalog import open_release

    with pytest.raises(QueryError, match=r"demo 1\.0\.0: has no temporal model"):
        _ = open_release(folder).temporal
