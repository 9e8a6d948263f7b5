"""The dipole kernel against another library, finite differences, potential theory and PROJ."""

from __future__ import annotations

import choclo
import numpy as np
import pyproj
import pytest

from magtiles.catalog.kernels import dipole

_SOURCES = 40


@pytest.fixture(scope="module")
def scene() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, positions and moments in local NED, 1.5-20 km apart over 80 x 60 km."""
    rng = np.random.default_rng(7)
    points = rng.uniform((-4e4, -3e4, -8e3), (4e4, 3e4, 0.0), (200, 3))
    positions = rng.uniform((-5e4, -4e4, 1.5e3), (5e4, 4e4, 1.2e4), (_SOURCES, 3))
    return points, positions, rng.normal(0.0, 1e11, (_SOURCES, 3))


def test_field_equals_that_of_another_library(scene):
    points, positions, moments = scene
    field, _ = dipole.dipole_field(points, positions, moments)
    # choclo works in easting, northing, upward and tesla.
    enu = np.array([1, 0, 2]), np.array([1.0, 1.0, -1.0])
    expected = np.zeros_like(field)
    for i, point in enumerate(points[:, enu[0]] * enu[1]):
        for source, moment in zip(
            positions[:, enu[0]] * enu[1], moments[:, enu[0]] * enu[1], strict=True
        ):
            expected[i] += choclo.dipole.magnetic_field(*point, *source, *moment)
    expected = 1e9 * expected[:, enu[0]] * enu[1]
    # 8e-10 measured: choclo takes mu0 as measured since 2019, 5e-10 from 4 pi 1e-7.
    np.testing.assert_allclose(field, expected, rtol=2e-9, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_array_equal(dipole.dipole_vector(points, positions, moments), field)


def test_tensor_is_the_derivative_of_the_field(scene):
    points, positions, moments = scene
    _, tensor = dipole.dipole_field(points, positions, moments)
    step = 1.0
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        ahead, _ = dipole.dipole_field(points + shift, positions, moments)
        behind, _ = dipole.dipole_field(points - shift, positions, moments)
        difference = (ahead - behind) / (2.0 * step) * 1e3
        # Central differences err by step^2 B'''/6, up to 2e-6 of the tensor 1.5 km away.
        np.testing.assert_allclose(
            tensor[:, :, axis], difference, rtol=0, atol=2e-6 * np.abs(tensor).max()
        )


def test_tensor_is_symmetric_and_traceless(scene):
    _, tensor = dipole.dipole_field(*scene)
    largest = np.abs(tensor).max(axis=(1, 2))
    assert np.all(np.abs(np.trace(tensor, axis1=1, axis2=2)) < 1e-9 * largest)
    assert np.all(np.abs(tensor - tensor.transpose(0, 2, 1)).max(axis=(1, 2)) < 1e-12 * largest)


def test_field_is_the_same_in_one_chunk_and_in_many(scene, monkeypatch):
    points, positions, moments = scene
    whole = dipole.dipole_field(points, positions, moments)
    monkeypatch.setattr(dipole, "_PAIRS", 7 * _SOURCES)
    parts = dipole.dipole_field(points, positions, moments)
    for one, many in zip(whole, parts, strict=True):
        np.testing.assert_allclose(many, one, rtol=0, atol=1e-10 * np.abs(one).max())


def test_field_on_the_axis_and_equator_of_a_dipole():
    moment = np.array([[0.0, 0.0, 1e10]])
    field, _ = dipole.dipole_field(
        np.array([[0.0, 0.0, 2e3], [2e3, 0.0, 0.0]]), np.zeros((1, 3)), moment
    )
    # 2 mu0/4pi m/r^3 along the moment on its axis, half that against it at its equator.
    np.testing.assert_allclose(field, [[0, 0, 250.0], [0, 0, -125.0]], atol=1e-9)


def test_geodetic_frame_follows_the_local_vertical():
    place = (-33.0, 151.0)
    # A dipole 5 km below, pointing down: the field there points down, 2 mu0/4pi m/r^3.
    position = dipole.geodetic_to_ecef(*place, -4000.0)[None]
    moment = 1e11 * dipole.ned_axes(*place)[2][None]
    vector, tensor = dipole.dipole_field_geodetic(*place, 1000.0, position, moment)
    peak = 2 * 100.0 * 1e11 / 5000.0**3
    np.testing.assert_allclose(vector, [0.0, 0.0, peak], atol=1e-9 * peak)
    # On the axis dB_d/dd = -3 B/r upward, so nn = ee = -dd/2 and the rest vanish.
    down_down = 3 * peak / 5.0
    expected = [-down_down / 2, 0.0, 0.0, -down_down / 2, 0.0]
    np.testing.assert_allclose(tensor, expected, atol=1e-9 * peak)


def test_earth_centred_positions_equal_projs():
    rng = np.random.default_rng(3)
    latitude, longitude = rng.uniform(-90, 90, 100), rng.uniform(-180, 180, 100)
    height = rng.uniform(-2e4, 2e4, 100)
    proj = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    expected = np.stack(proj.transform(longitude, latitude, height), axis=-1)
    found = dipole.geodetic_to_ecef(latitude, longitude, height)
    np.testing.assert_allclose(found, expected, rtol=0, atol=5e-9)
    axes = dipole.ned_axes(latitude, longitude)
    np.testing.assert_allclose(np.linalg.det(axes), 1.0, atol=1e-14)
    raised = dipole.geodetic_to_ecef(latitude, longitude, height + 1.0) - found
    np.testing.assert_allclose(-axes[:, 2], raised, atol=2e-9)
