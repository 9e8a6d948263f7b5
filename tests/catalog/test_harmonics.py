"""Fields of harmonics against closed forms, the textbook, finite differences and each other."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest
from gauss import RADIUS_KM, dipole_gauss, random_crust, static, textbook_field

from magtiles.catalog.kernels import harmonics
from magtiles.catalog.kernels.dipole import dipole_field, geodetic_to_ecef, ned_axes
from magtiles.catalog.kernels.geodesy import FLATTENING, SEMI_MAJOR_AXIS_M
from magtiles.catalog.models import FieldModel, evaluate, evaluate_grid, load_igrf
from magtiles.schemas.errors import QueryError

# Poles, beside them, both sides of the date line, the equator; and any place.
LATITUDE = np.array([90.0, -90.0, 89.99, -89.99, 12.0, 12.0, 0.0, 47.3, -61.2])
LONGITUDE = np.array([0.0, 77.0, -120.0, 30.0, 180.0, -180.0, 0.0, 11.5, 359.0])
HEIGHTS = np.array([0.0, 600e3])


@pytest.fixture(scope="module")
def high() -> FieldModel:
    """The IGRF's core and 200 nT of crust to degree 790."""
    crust = random_crust(14, 790, 200.0)
    core = load_igrf().at(2020.0)
    crust[: len(core)] += core
    return static(crust)


@pytest.mark.parametrize(
    ("colatitude", "longitude"),
    [(1.0, 40.0), (179.5, -100.0), (60.0, 179.9), (90.0, 0.0)],
    ids=["north-pole", "south-pole", "date-line", "equator"],
)
def test_dipole_expanded_to_degree_790(colatitude: float, longitude: float) -> None:
    # At 0.95 of the radius, degrees above 790 hold less than 1e-15 of the peak.
    r, theta, lam = 0.95 * RADIUS_KM * 1e3, np.radians(colatitude), np.radians(longitude)
    at = r * np.array([np.sin(theta) * np.cos(lam), np.sin(theta) * np.sin(lam), np.cos(theta)])
    moment = np.array([2e16, -3e16, 5e16])
    model = static(dipole_gauss(790, at, moment))
    lat = np.append(LATITUDE, 90.0 - colatitude + np.array([0.0, 0.3, -0.4]))
    lon = np.append(LONGITUDE, longitude + np.array([0.0, 1.0, -2.0]))
    lat, lon, h = np.broadcast_arrays(lat[:, None], lon[:, None], HEIGHTS)
    vector, tensor = evaluate(model, lat, lon, h, 2020.0, gradient=True)
    points = geodetic_to_ecef(lat, lon, h).reshape(-1, 3)
    field, slopes = dipole_field(points, at[None], moment[None])
    axes = ned_axes(lat, lon).reshape(-1, 3, 3)
    field = np.einsum("pia,pa->pi", axes, field).reshape(vector.shape)
    slopes = (axes @ slopes @ axes.transpose(0, 2, 1)).reshape(tensor.shape)
    assert np.abs(field).max() > 100.0
    # Measured: 5e-13 of the largest vector and of the largest tensor.
    assert np.abs(vector - field).max() < 2e-12 * np.abs(field).max()
    assert np.abs(tensor - slopes).max() < 2e-12 * np.abs(slopes).max()


def test_textbook_sums() -> None:
    gauss = random_crust(1, 13, 50_000.0)
    functions = harmonics.field_harmonics(gauss, RADIUS_KM, gradient=False)
    assert functions is not None
    rng = np.random.default_rng(2)
    lat, lon = rng.uniform(-89.0, 89.0, 40), rng.uniform(-180.0, 360.0, 40)
    radius = rng.uniform(6.35e6, 7.0e6, 40)
    sphere = np.array([radius * np.cos(np.radians(lat)), radius * np.sin(np.radians(lat))])
    lam = np.radians(lon)
    places = np.stack([sphere[0] * np.cos(lam), sphere[0] * np.sin(lam), sphere[1]], axis=-1)
    ours = np.einsum("pia,pa->pi", ned_axes(lat, lon), harmonics.at_points(functions, places))
    truth = [textbook_field(gauss, *place) for place in zip(lat, lon, radius, strict=True)]
    np.testing.assert_allclose(ours, truth, rtol=0, atol=1e-9)  # measured 2e-10 of 200,000 nT


def test_points_and_grid_agree(high: FieldModel) -> None:
    latitudes = np.array([-90.0, -89.99, -45.0, -44.9, 0.0, 44.9, 89.99, 90.0])
    longitudes = np.arange(-180.0, 180.0, 0.2)
    field, tensor = evaluate_grid(high, latitudes, longitudes, HEIGHTS, 2020.0, gradient=True)
    some = np.array([0, 1, 899, 1000, 1799])
    h = HEIGHTS[:, None, None]
    at = (latitudes[:, None], longitudes[some])
    vector, slopes = evaluate(high, *at, h, 2020.0, gradient=True)
    # Measured 3e-8 nT and 3e-9 nT/km; asked 1e-5 nT.
    assert np.abs(field[:, :, some] - vector).max() < 1e-7
    assert np.abs(tensor[:, :, some] - slopes).max() < 1e-8


@pytest.mark.parametrize(
    "longitudes",
    [
        np.array([-3.0, 10.0, 10.5, 200.0]),
        np.array([5.0]),
        np.linspace(-10.0, -9.0, 11),
        np.arange(0.0, 361.0, 1.0),
        np.linspace(180.0, -180.0, 40),
    ],
    ids=["uneven", "one", "regional", "round-and-beyond", "descending"],
)
def test_any_longitudes_of_a_grid(longitudes: np.ndarray) -> None:
    model = static(random_crust(1, 40, 1000.0))
    latitudes = np.array([60.0, -60.0, 10.0, 60.0])  # in no order, and one of them twice
    field = evaluate_grid(model, latitudes, longitudes, 100.0, 2020.0)
    points = evaluate(model, latitudes[:, None], longitudes, 100.0, 2020.0)
    np.testing.assert_allclose(field[0], points, rtol=0, atol=1e-9)


def test_tensor_is_the_derivative_in_fixed_axes(high: FieldModel) -> None:
    lat, lon, h = LATITUDE, LONGITUDE, np.full(len(LATITUDE), 300.0)
    _, tensor = evaluate(high, lat, lon, h, 2020.0, gradient=True)
    geodetic = pyproj.Transformer.from_crs(
        {"proj": "geocent", "a": SEMI_MAJOR_AXIS_M, "f": FLATTENING},
        {"proj": "longlat", "a": SEMI_MAJOR_AXIS_M, "f": FLATTENING},
    )
    places, axes = geodetic_to_ecef(lat, lon, h), ned_axes(lat, lon)
    step = 150.0
    slopes = np.empty_like(tensor)
    for j in range(3):
        slopes[..., j] = 0.0
        for weight, steps in ((8.0, 1), (-8.0, -1), (-1.0, 2), (1.0, -2)):  # fourth order
            lon_there, lat_there, h_there = geodetic.transform(
                *(places + steps * step * axes[:, j]).T
            )
            there = evaluate(high, lat_there, lon_there, h_there, 2020.0)
            fixed = np.einsum("pia,pi->pa", ned_axes(lat_there, lon_there), there)
            ned = np.einsum("pia,pa->pi", axes, fixed)
            slopes[..., j] += weight * ned / (12.0 * step / 1000.0)
    assert np.abs(slopes - tensor).max() < 1e-6 * np.abs(tensor).max()  # measured 3e-9
    np.testing.assert_array_equal(tensor, tensor.swapaxes(1, 2))
    trace = np.trace(tensor, axis1=1, axis2=2)
    assert np.abs(trace).max() < 1e-15 * np.abs(tensor).max()


def test_poles_do_not_depend_on_the_longitude_they_are_reached_by(high: FieldModel) -> None:
    lon = np.arange(0.0, 360.0, 30.0)
    for lat in (90.0, -90.0):
        field = evaluate(high, lat, lon, 0.0, 2020.0)
        fixed = np.einsum("pia,pi->pa", ned_axes(np.full_like(lon, lat), lon), field)
        assert np.ptp(fixed, axis=0).max() < 1e-9
        beside = evaluate(high, np.sign(lat) * (90.0 - 1e-7), lon, 0.0, 2020.0)
        assert np.abs(beside - field).max() < 1e-3  # 1 cm away; measured 3e-4


def test_order_and_number_of_points_do_not_matter() -> None:
    model = static(random_crust(1, 60, 1000.0))
    rng = np.random.default_rng(3)
    lat, lon = rng.uniform(-90.0, 90.0, 3000), rng.uniform(-180.0, 180.0, 3000)
    h = rng.uniform(0.0, 6e5, 3000)
    all_at_once = evaluate(model, lat, lon, h, 2020.0)
    some = rng.integers(0, 3000, 50)
    alone = [evaluate(model, lat[i], lon[i], h[i], 2020.0) for i in some]
    np.testing.assert_allclose(all_at_once[some], alone, rtol=0, atol=1e-9)
    assert evaluate(model, np.empty(0), 1.0, 1.0, 2020.0).shape == (0, 3)


@pytest.mark.parametrize("degree", [1400, harmonics.MAX_DEGREE])
def test_legendre_functions_stay_in_range(degree: int) -> None:
    """The last degree alone, zonal and of a middle order, from the pole to the equator."""
    order = degree // 3
    gauss = np.zeros(degree * (degree + 2))
    gauss[harmonics.position(degree, 0)] = gauss[harmonics.position(degree, order)] = 1.0
    lat = np.array([89.999999, 89.99, 80.0, 71.0, 45.0, 0.0])
    functions = harmonics.field_harmonics(gauss, RADIUS_KM, gradient=False)
    assert functions is not None
    u, t = np.cos(np.radians(lat)), np.sin(np.radians(lat))
    places = RADIUS_KM * 1e3 * np.stack([u, np.zeros_like(u), t], axis=-1)
    found = harmonics.at_points(functions, places)
    radial = (found * places).sum(axis=1) / (RADIUS_KM * 1e3)
    truth = [schmidt_alone(degree, 0, x) + schmidt_alone(degree, order, x) for x in t]
    np.testing.assert_allclose(radial / (degree + 1), truth, rtol=0, atol=2e-9)


def schmidt_alone(n_max: int, m: int, t: float) -> float:
    """S_nm(t) down one column, the size kept apart in a logarithm."""
    ratios = [(2 * k - 1) / (2 * k) for k in range(2, m + 1)]
    size = 0.5 * (np.log(ratios).sum() + m * np.log1p(-t * t)) if m else 0.0
    before, now = 0.0, 1.0
    for n in range(m + 1, n_max + 1):
        last = np.sqrt((n - 1) ** 2 - m * m) * before
        before, now = now, ((2 * n - 1) * t * now - last) / np.sqrt(n * n - m * m)
        if abs(now) > 1e200:
            before, now, size = before * 1e-200, now * 1e-200, size + np.log(1e200)
    return float(now * np.exp(size))


def test_degree_790_against_pyshtools(high: FieldModel) -> None:
    pyshtools = pytest.importorskip("pyshtools")
    n_max, gauss = high.n_max, high.coefficients[0]
    c = np.zeros((2, n_max + 1, n_max + 1))
    for n in range(1, n_max + 1):
        row = gauss[n * n - 1 : n * n + 2 * n]
        c[0, n, 0], c[0, n, 1 : n + 1], c[1, n, 1 : n + 1] = row[0], row[1::2], row[2::2]
    theirs = pyshtools.SHMagCoeffs.from_array(
        c, r0=RADIUS_KM * 1e3, normalization="schmidt", csphase=1
    )
    rng = np.random.default_rng(4)
    lat, lon = rng.uniform(-89.9, 89.9, 300), rng.uniform(0.0, 360.0, 300)
    radius = rng.uniform(6.36e6, 6.9e6, 300)
    functions = harmonics.field_harmonics(gauss, RADIUS_KM, gradient=False)
    assert functions is not None
    phi, lam = np.radians(lat), np.radians(lon)
    up = np.stack([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)], axis=-1)
    ours = harmonics.at_points(functions, radius[:, None] * up)
    ours = np.einsum("pia,pa->pi", ned_axes(lat, lon), ours)
    radial, south, east = np.array(
        [
            theirs.expand(lat=[a], lon=[b], r=[r])[0]
            for a, b, r in zip(lat, lon, radius, strict=True)
        ]
    ).T
    assert np.abs(ours - np.stack([-south, east, -radial], axis=-1)).max() < 1e-8  # measured 3e-9


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ((91.0, 0.0, 0.0), r"latitude: latitude 91; expected -90 to 90"),
        (([1.0, np.nan], 0.0, 0.0), r"latitude\[1\]: latitude nan"),
        ((0.0, [0.0, np.inf], 0.0), r"longitude\[1\]: longitude inf"),
        ((0.0, 0.0, -50e3), r"height: height -50000 is inside the Earth; expected -12000 m"),
        ((0.0, 0.0, np.nan), r"height: height nan"),
        (([1.0, 2.0], [1.0, 2.0, 3.0], 0.0), r"shapes \(2,\), \(3,\), \(\), \(\)"),
    ],
    ids=["latitude-91", "nan", "longitude-inf", "inside", "height-nan", "shapes"],
)
def test_places_that_are_none(place: tuple[object, ...], message: str) -> None:
    model = static(random_crust(1, 3, 1.0))
    with pytest.raises(QueryError, match=message):
        evaluate(model, *place, 2020.0)  # type: ignore[arg-type]
