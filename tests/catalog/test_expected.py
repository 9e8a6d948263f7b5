"""The whole field a release expects: against ppigrf and exact dipoles, and by differences."""

from __future__ import annotations

import datetime
import subprocess
import sys
from pathlib import Path

import numpy as np
import ppigrf
import pytest
from synthetic_release import World, ambient, small_lattice

from magtiles.catalog import Release, open_release
from magtiles.catalog.kernels.geodesy import metres_per_degree
from magtiles.schemas.errors import ContractError, MagtilesError, QueryError

COEFFICIENTS = Path(ppigrf.__file__).with_name("IGRF14.shc")
CORE = {"core_field.shc": COEFFICIENTS}
LAT, LON = np.linspace(44.05, 44.35, 7), np.linspace(10.1, 10.5, 7)


@pytest.fixture(scope="module")
def world() -> World:
    # A small one: one level a kilometre above the other.
    return World(
        lattice=small_lattice(), heights=(0.0, 1000.0), beyond=(np.s_[52:60], np.s_[50:58])
    )


@pytest.fixture(scope="module")
def folder(world: World, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return world.publish(tmp_path_factory.mktemp("store"), extra_files=CORE).path


@pytest.fixture
def release(folder: Path) -> Release:
    return open_release(folder)


def igrf(lat, lon, height, date: datetime.datetime) -> np.ndarray:
    """Core field north, east, down, nT, by ppigrf."""
    east, north, up = (a[0] for a in ppigrf.igrf(lon, lat, np.asarray(height) / 1e3, date))
    return np.stack([north, east, -up], axis=-1)


def test_total_and_vector_are_core_and_anomaly(world: World, release: Release) -> None:
    height = np.linspace(0.0, 1000.0, 7)
    core = igrf(LAT, LON, height, datetime.datetime(2020, 1, 1))  # noqa: DTZ001
    total, vector, _ = world.truth(LAT, LON, height)
    found = release.anomaly.expected_total_field(LAT, LON, height, "2020-01-01")
    # Measured: 0.0013 and 0.0015 nT, the map's own error.
    assert np.abs(found - (np.linalg.norm(core, axis=-1) + total)).max() < 0.01
    assert np.abs(found - release.anomaly.total(LAT, LON, height) - np.linalg.norm(core, axis=-1)
                  ).max() < 1e-6  # fmt: skip
    found = release.anomaly.expected_vector(LAT, LON, height, "2020-01-01")
    assert np.abs(found - core - vector).max() < 0.01
    # ppigrf turns from geocentric to geodetic axes with less care: 2.6e-4 nT.
    assert np.abs(found - release.anomaly.vector(LAT, LON, height) - core).max() < 1e-3


def test_the_field_of_another_date_differs_by_the_core_alone(release: Release) -> None:
    place = 44.2, 10.3, 500.0
    dates = [datetime.datetime(year, 1, 1) for year in (1990, 2025)]  # noqa: DTZ001
    found = np.diff(release.anomaly.expected_total_field(*place, np.array(dates, "M8[s]")))
    core = [np.linalg.norm(igrf(*place, date)) for date in dates]
    # 1188 nT in these 35 years.
    assert found[0] == pytest.approx(core[1] - core[0], abs=1e-6)
    assert abs(found[0]) > 1000.0


@pytest.mark.parametrize(
    "time",
    [
        pytest.param("2020-07-02", id="date"),
        pytest.param("2020-07-02T00:00:00Z", id="UTC"),
        pytest.param("2020-07-02T05:00+05:00", id="another zone"),
        pytest.param(datetime.datetime(2020, 7, 2), id="naive datetime"),  # noqa: DTZ001
        pytest.param(datetime.datetime(2020, 7, 2, tzinfo=datetime.UTC), id="datetime"),
        pytest.param(np.datetime64("2020-07-02", "ns"), id="datetime64"),
        pytest.param(2020.5, id="decimal year"),
    ],
)
def test_ways_to_write_a_time(release: Release, time: object) -> None:
    found = release.anomaly.expected_total_field(44.2, 10.3, 500.0, time)
    same = release.anomaly.expected_total_field(44.2, 10.3, 500.0, np.datetime64("2020-07-02"))
    assert found == same
    assert np.shape(found) == ()


def test_arguments_broadcast(release: Release) -> None:
    times = np.array(["1990-01-01", "2010-01-01", "2025-01-01"], "M8[ns]")
    an = release.anomaly
    place = LAT, LON, 500.0
    total, gradient = an.expected_total_with_gradient(*place, times[:, None])
    vector, jacobian = an.expected_vector_with_gradient(*place, times[:, None])
    assert (total.shape, gradient.shape) == ((3, 7), (3, 7, 3))
    assert (vector.shape, jacobian.shape) == ((3, 7, 3), (3, 7, 3, 3))
    for i, time in enumerate(times):
        for j in range(7):
            alone = LAT[j], LON[j], 500.0, time
            assert total[i, j] == pytest.approx(an.expected_total_field(*alone), abs=1e-9)
            assert vector[i, j] == pytest.approx(an.expected_vector(*alone), abs=1e-9)


def steps(
    lat: np.ndarray, lon: np.ndarray, height: float, metres: float = 1.0
) -> list[tuple[np.ndarray, ...]]:
    """Places some metres south and north, west and east, above and below."""
    north, east = metres_per_degree(lat, height)
    zero = np.zeros_like(lat)
    moves = (metres / north, zero, zero), (zero, metres / east, zero), (zero, zero, zero - metres)
    return [
        tuple(
            np.stack([p - m, p + m]) for p, m in zip((lat, lon, height + zero), move, strict=True)
        )
        for move in moves
    ]


def test_gradients_are_the_derivatives_of_the_values(release: Release) -> None:
    an, when = release.anomaly, "2024-03-01T06:00"
    _, gradient = an.expected_total_with_gradient(LAT, LON, 400.0, when)
    _, jacobian = an.expected_vector_with_gradient(LAT, LON, 400.0, when)
    for axis, (lat, lon, height) in enumerate(steps(LAT, LON, 400.0)):
        total = np.diff(an.expected_total_field(lat, lon, height, when), axis=0)[0] / 2e-3
        # Measured: 3e-7 and 4e-7 nT/km, the cancellation of 50,000 nT.
        assert np.abs(gradient[:, axis] - total).max() < 3e-6
        vector = np.diff(an.expected_vector(lat, lon, height, when), axis=0)[0] / 2e-3
        assert np.abs(jacobian[..., axis] - vector).max() < 3e-6


def test_the_core_gradient_is_that_of_the_earth(release: Release) -> None:
    an, date = release.anomaly, datetime.datetime(2020, 1, 1)  # noqa: DTZ001
    _, whole = an.expected_total_with_gradient(LAT, LON, 400.0, "2020-01-01")
    _, anomaly = an.total_with_gradient(LAT, LON, 400.0)
    core = whole - anomaly
    for axis, place in enumerate(steps(LAT, LON, 400.0, metres=1000.0)):
        truth = np.diff(np.linalg.norm(igrf(*place, date), axis=-1), axis=0)[0] / 2.0
        assert core[:, axis] == pytest.approx(truth, abs=1e-4)
    # The total grows northward, eastward and downward; 3 F / r would be 22.2 nT/km.
    assert core.mean(axis=0) == pytest.approx([2.94, 0.89, 22.75], abs=0.01)


def test_the_core_gradient_of_colorado(tmp_path: Path) -> None:
    world = World(lattice=small_lattice(40.0, -105.5), heights=(0.0, 1000.0))
    an = open_release(world.publish(tmp_path, extra_files=CORE).path).anomaly
    place = 40.2, -105.2, 500.0
    _, whole = an.expected_total_with_gradient(*place, "2016-01-15")
    _, anomaly = an.total_with_gradient(*place)
    north, _, down = whole - anomaly
    # 4 to 5 nT/km northward, and some 27 less for each kilometre upward.
    truth = np.diff(
        [
            np.linalg.norm(igrf(40.2, -105.2, h, datetime.datetime(2016, 1, 15)))  # noqa: DTZ001
            for h in (0.0, 1000.0)
        ]
    )
    assert -down == pytest.approx(truth[0], abs=1e-3)
    assert (north, -down) == (pytest.approx(4.74, abs=0.01), pytest.approx(-26.52, abs=0.01))


def test_nan_where_the_anomaly_is(release: Release) -> None:
    lat = np.array([44.2, np.nan, 10.0, 44.2, 44.37])
    height = np.array([500.0, 500.0, 500.0, 5000.0, 500.0])  # above the highest level; beyond
    lon = np.array([10.3, 10.3, 10.3, 10.3, 10.51])
    unknown = [False, True, True, True, True]
    an = release.anomaly
    for ask in (an.expected_total_with_gradient, an.expected_vector_with_gradient):
        for answer in ask(lat, lon, height, "2020-01-01"):
            assert np.isnan(answer.reshape(5, -1)).all(axis=1).tolist() == unknown
            assert np.isnan(answer.reshape(5, -1)).any(axis=1).tolist() == unknown
    assert np.isnan(an.expected_total_field(lat, lon, height, "2020-01-01")).tolist() == unknown


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        pytest.param((91.0, 10.3, 0.0, "2020-01-01"), "latitude: is 91", id="latitude"),
        pytest.param((44.2, 10.3, -5.0, "2020-01-01"), "lowest level", id="height"),
        pytest.param((44.2, 10.3, 0.0, "soon"), "'soon'", id="no date"),
        pytest.param((44.2, 10.3, 0.0, np.datetime64("NaT")), "missing", id="no time"),
        pytest.param((44.2, 10.3, 0.0, "2035-01-01"), "outside the validity of none", id="2035"),
        pytest.param((44.2, 10.3, 0.0, 1.7e9), "outside the validity", id="Unix seconds"),
        pytest.param((LAT, 10.3, 0.0, np.full(3, 2020.0)), r"time \(3,\)", id="shapes"),
    ],
)
def test_bad_arguments_say_what_and_where(release: Release, arguments, message: str) -> None:
    with pytest.raises(QueryError, match=message):
        release.anomaly.expected_total_field(*arguments)


def test_dates_beyond_the_model_when_allowed(folder: Path) -> None:
    an = open_release(folder, allow_extrapolated=True).anomaly
    years = an.expected_total_field(44.2, 10.3, 500.0, np.array([2029.0, 2030.0, 2031.0]))
    # On the same straight line of coefficients; the magnitude bends by hundredths of a nT.
    assert np.diff(years, 2) == pytest.approx(0.0, abs=0.05)


def test_heights_above_a_known_surface_are_ellipsoidal(
    terrain_world: World, tmp_path: Path
) -> None:
    path = terrain_world.publish(tmp_path, extra_files=CORE).path
    an, place = open_release(path).anomaly, (44.2, 10.3, 1300.0)
    core = igrf(*place, datetime.datetime(2020, 1, 1))  # noqa: DTZ001
    found = an.expected_total_field(*place, "2020-01-01") - an.total(*place)
    assert found == pytest.approx(np.linalg.norm(core), abs=1e-6)


def test_no_expected_field_above_an_unknown_surface(blind_terrain_folder: Path) -> None:
    with pytest.raises(ContractError, match="terrain, whose own height it does not know"):
        open_release(blind_terrain_folder).anomaly.expected_total_field(44, 10, 0, "2020-01-01")


def test_a_release_without_core_field_says_so(world: World, tmp_path: Path) -> None:
    an = open_release(world.publish(tmp_path).path).anomaly
    for ask in (an.expected_vector, an.expected_total_with_gradient):
        with pytest.raises(ContractError, match=r"release demo 1\.0\.0: has no core_field\.shc"):
            ask(44.2, 10.3, 500.0, "2020-01-01")


@pytest.mark.parametrize("text", ["", "1 2 3\n", COEFFICIENTS.read_text()[:20000]])
def test_a_core_field_that_is_none_is_named(world: World, tmp_path: Path, text: str) -> None:
    coefficients = tmp_path / "model.shc"
    coefficients.write_text(text)
    path = world.publish(tmp_path / "s", extra_files={"core_field.shc": coefficients}).path
    with pytest.raises(MagtilesError, match=r"release demo 1\.0\.0: core_field\.shc"):
        open_release(path).anomaly.expected_total_field(44.2, 10.3, 500.0, "2020-01-01")


def test_the_reader_imports_models_only_when_asked() -> None:
    code = (
        "import sys, magtiles.catalog\n"
        "heavy = {'numba', 'magtiles.catalog.models', 'xarray', 'pandas'} & set(sys.modules)\n"
        "sys.exit(', '.join(heavy) or None)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_the_ambient_direction_of_the_world_is_no_part_of_it() -> None:
    """The worlds above lie under a direction of their own, some degrees from the IGRF's."""
    core = igrf(44.2, 10.3, 0.0, datetime.datetime(2020, 1, 1))  # noqa: DTZ001
    cosine = float(core @ ambient(44.2, 10.3) / np.linalg.norm(core))
    assert 0.9 < cosine < 0.9999
