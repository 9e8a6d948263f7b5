"""Surveys above terrain and sea level: their surface in the release, ellipsoidal heights served."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from draped import CLEARANCE, GAINS, Floats, geoid, survey, terrain, write_draped, write_heights
from known import relative
from planar import grid_convergence, planar_fft

from magtiles.catalog import Release, open_release
from magtiles.catalog.releases.anomaly import Anomaly
from magtiles.pipeline.build import build_product
from magtiles.pipeline.product import load_product
from magtiles.pipeline.sample import Sample
from magtiles.pipeline.validate import validate_release
from magtiles.schemas.errors import (
    ContractError,
    CoverageError,
    QueryError,
    SourceError,
    VersionError,
)

_EAST = np.arange(-122.4, -120.6, 0.004)
_NORTH = np.arange(45.4, 46.6, 0.003)
_ELLIPSOIDAL = {"surface": "terrain", "height_reference": "ellipsoid"}
_ABOVE_SEA = {"surface": "terrain", "height_reference": "mean_sea_level"}
_GEOID = {"surface": "mean_sea_level", "height_reference": "ellipsoid"}
_COARSE = np.arange(-123.0, -119.9, 0.25), np.arange(45.0, 47.1, 0.25)
_INSIDE = np.s_[22:-22, 22:-22]


class Draped(NamedTuple):
    """A survey above terrain, its release with the terrain's height, and the one without."""

    sample: Sample
    known: Release
    unknown: Release
    folder: Path

    @property
    def places(self) -> tuple[Floats, Floats]:
        """Survey nodes well inside, (n,)."""
        return self.sample.latitude[_INSIDE].ravel(), self.sample.longitude[_INSIDE].ravel()


def one_relative(found: Floats, truth: Floats) -> float:
    return float(relative(found[:, None], truth[:, None])[0])


@pytest.fixture(scope="module")
def draped(tmp_path_factory: pytest.TempPathFactory) -> Draped:
    folder, sample = tmp_path_factory.mktemp("draped"), survey()
    write_heights(folder / "dem.toml", terrain, (_EAST, _NORTH), **_ELLIPSOIDAL)
    releases = []
    for keys in ('surface = "dem.toml"\n', ""):
        product = write_draped(folder, sample, anomaly=f"tile_deg = 0.25\n{keys}")
        store = folder / f"store{len(releases)}"
        releases.append(open_release(build_product(product, store=store, work=folder / "w").path))
    return Draped(sample, releases[0], releases[1], folder)


def test_the_release_is_valid_seams_and_all(draped: Draped) -> None:
    release = draped.known
    assert len(release.manifest.tiles) > 4
    assert [c.name for c in validate_release(release.path) if not c.passed] == []
    assert [i.role for i in release.manifest.inputs] == ["survey", "surface"]


def test_the_surface_is_the_terrain(draped: Draped) -> None:
    found = draped.known.anomaly.reference_surface(*draped.places)
    # Measured: 0.36 m, what the mean over a cell of 1 km takes of hills 595 m high.
    assert np.abs(found - terrain(*draped.places)).max() < 0.5


@pytest.mark.parametrize("gain", GAINS)
def test_ellipsoidal_heights_give_the_exact_field_there(draped: Draped, gain: float) -> None:
    """Every level is the drape and a gain, transformed as a plane (docs/method.md)."""
    lat, lon = draped.places
    height = terrain(lat, lon) + CLEARANCE + gain - 1.0
    truth = draped.sample.truth(lat, lon, height)[0]
    error = one_relative(draped.known.anomaly.total(lat, lon, height), truth)
    # Measured: 0.44 % 1 km up and 0.74 % 2 km up; 0.07 % and 0.16 % over flat ground.
    assert error < {1000.0: 0.0055, 2000.0: 0.009}[gain]
    flat = draped.sample.truth(lat, lon, np.full_like(height, height.mean()))[0]
    assert one_relative(flat, truth) > 0.02


@pytest.mark.parametrize("gain", GAINS)
def test_levels_are_the_planar_transform_of_the_drape(draped: Draped, gain: float) -> None:
    sample, (lat, lon) = draped.sample, draped.places
    north, east, down = sample.ambient(sample.latitude, sample.longitude, 1500.0).mean(axis=(0, 1))
    plain = planar_fft(
        sample.exact,
        sample.spec.spacing_m,
        gain,
        inclination=float(np.degrees(np.arctan2(down, np.hypot(north, east)))),
        declination=float(np.degrees(np.arctan2(east, north))),
        convergence=grid_convergence(sample.spec.crs, sample.x, sample.y),
    )[0][_INSIDE].ravel()
    surface = draped.known.anomaly.reference_surface(lat, lon)
    found = draped.known.anomaly.total(lat, lon, surface + CLEARANCE + gain - 1e-3)
    # Measured: 0.02 %.
    assert one_relative(found, plain) < 4e-4


def test_heights_above_the_surface_are_the_same_query(draped: Draped) -> None:
    lat, lon = draped.places
    above = CLEARANCE + np.random.default_rng(0).uniform(1.0, GAINS[-1] - 1.0, lat.size)
    height = draped.known.anomaly.reference_surface(lat, lon) + above
    for name in ("total", "vector", "tensor", "uncertainty"):
        known = getattr(draped.known.anomaly, name)(lat, lon, height)
        unknown = getattr(draped.unknown.anomaly, name)(lat, lon, height_above_reference=above)
        # The metres of a cell are those at the surface, not at the ellipsoid: 1.6e-4.
        np.testing.assert_allclose(known, unknown, rtol=0, atol=2e-4 * np.abs(unknown).max())


def test_gradient_at_constant_ellipsoidal_height_is_the_derivative(draped: Draped) -> None:
    lat, lon = (values[::37] for values in draped.places)
    height, step = 2300.0, 1e-5
    ask = draped.known.anomaly
    _, gradient = ask.total_with_gradient(lat, lon, height)
    metres = 111_170.0 * step  # a step north at 46 degrees, 2.3 km up
    ends = [ask.total(lat + s * step, lon, height) for s in (-1.0, 1.0)]
    np.testing.assert_allclose(
        gradient[:, 0], 1e3 * (ends[1] - ends[0]) / (2 * metres), rtol=1e-3, atol=1e-2
    )


def test_the_expected_field_needs_the_surface(draped: Draped) -> None:
    lat, lon, date = 46.0, -121.5, "1990-01-01"
    ask, height = draped.known.anomaly, float(terrain(46.0, -121.5)) + 900.0
    core = np.linalg.norm(draped.sample.ambient(lat, lon, height))
    expected = ask.expected_total_field(lat, lon, height, date)
    assert expected == pytest.approx(core + ask.total(lat, lon, height), abs=0.1)
    assert np.isfinite(ask.expected_vector(lat, lon, height, date)).all()
    with pytest.raises(ContractError, match="terrain"):
        draped.unknown.anomaly.expected_total_field(lat, lon, height, date)
    with pytest.raises(QueryError, match="height_above_reference"):
        draped.unknown.anomaly.total(lat, lon, height)


def test_a_surface_that_comes_is_a_major_change(draped: Draped) -> None:
    product = draped.folder / "draped.toml"  # the one without a surface, over that with it
    text = product.read_text().replace('"1.0.0"', '"1.1.0"')
    product.write_text(text + 'surface = "dem.toml"\n')
    with pytest.raises(VersionError, match=r"2\.0\.0"):
        build_product(product, store=draped.folder / "store1", work=draped.folder / "w")


@pytest.fixture(scope="module")
def at_sea(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Anomaly]:
    """One survey above sea level, with the geoid as a number, a constant grid and a true one."""
    folder, sample = tmp_path_factory.mktemp("sea"), survey()
    write_heights(folder / "flat.toml", lambda lat, _: 0 * lat - 21.37, _COARSE, **_GEOID)
    write_heights(folder / "geoid.toml", geoid, _COARSE, **_GEOID)
    keys = {
        "number": ("", "undulation_m = -21.37\n"),
        "flat": ('geoid = "flat.toml"\n', ""),
        "geoid": ('geoid = "geoid.toml"\n', ""),
    }
    found = {}
    for name, (anomaly, grid) in keys.items():
        product = write_draped(folder, sample, anomaly=anomaly, grid=grid)
        for path in (product, folder / "draped-survey.toml"):
            path.write_text(path.read_text().replace('"terrain"', '"mean_sea_level"'))
        release = build_product(product, store=folder / name, work=folder / "w").path
        assert [c.name for c in validate_release(release) if not c.passed] == []
        found[name] = open_release(release).anomaly
    return found


def test_a_number_is_a_constant_geoid(at_sea: dict[str, Anomaly]) -> None:
    rng = np.random.default_rng(0)
    place = rng.uniform(45.8, 46.2, 50), rng.uniform(-121.8, -121.2, 50), 1200.0
    for name in ("total", "vector", "tensor"):
        ask = [getattr(at_sea[which], name) for which in ("number", "flat")]
        np.testing.assert_array_equal(ask[0](*place), ask[1](*place))


def test_a_geoid_is_interpolated(at_sea: dict[str, Anomaly]) -> None:
    rng = np.random.default_rng(0)
    place = rng.uniform(45.8, 46.2, 50), rng.uniform(-121.8, -121.2, 50)
    # Bilinear between nodes 0.25 degrees apart: 2 m/deg^2 (0.25 deg)^2 / 4 = 0.03 m.
    assert np.abs(at_sea["geoid"].reference_surface(*place) - geoid(*place)).max() < 0.035


def test_a_dem_above_sea_level_and_its_geoid(draped: Draped, tmp_path: Path) -> None:
    def above_sea(lat: Floats, lon: Floats) -> Floats:
        return terrain(lat, lon) - geoid(lat, lon)

    write_heights(tmp_path / "dem.toml", above_sea, (_EAST, _NORTH), **_ABOVE_SEA)
    write_heights(tmp_path / "geoid.toml", geoid, _COARSE, **_GEOID)
    keys = 'surface = "dem.toml"\ngeoid = "geoid.toml"\n'
    product = write_draped(tmp_path, draped.sample, anomaly=keys)
    release = open_release(build_product(product, store=tmp_path / "s", work=tmp_path / "w").path)
    found = release.anomaly.reference_surface(*draped.places)
    assert np.abs(found - terrain(*draped.places)).max() < 0.55
    assert [i.role for i in release.manifest.inputs] == ["survey", "surface", "geoid"]


def test_a_dem_that_ends_short_is_named_with_its_bounds(draped: Draped, tmp_path: Path) -> None:
    short = _NORTH[_NORTH < 46.1]
    write_heights(tmp_path / "dem.toml", terrain, (_EAST, short), **_ELLIPSOIDAL)
    product = write_draped(tmp_path, draped.sample, anomaly='surface = "dem.toml"\n')
    with pytest.raises(CoverageError) as caught:
        build_product(product, store=tmp_path / "s", work=tmp_path / "w")
    assert re.search(r"latitude 46\.1\d* to 46\.3\d*, longitude -122\.\d+", str(caught.value))
    assert "draped.toml surface dem" in str(caught.value)
    assert not (tmp_path / "s").exists()


@dataclass(frozen=True)
class Refuse:
    """Keys of [anomaly], what heights count from, keys of the surface, and what is said."""

    anomaly: str
    counts_from: str
    surface: dict[str, str | float]
    says: str
    id: str


_DEM, _BOTH = 'surface = "dem.toml"\n', 'surface = "dem.toml"\ngeoid = "dem.toml"\n'
REFUSED = [
    Refuse(_DEM, "ellipsoid", _ELLIPSOIDAL, "neither surface nor geoid", "ellipsoid"),
    Refuse(_DEM, "mean_sea_level", _ELLIPSOIDAL, "geoid alone", "dem-at-sea"),
    Refuse('geoid = "dem.toml"\n', "terrain", _GEOID, "there is geoid with", "geoid-alone"),
    Refuse(_DEM, "terrain", _GEOID, "surface is 'mean_sea_level'", "geoid-for-dem"),
    Refuse(_BOTH, "terrain", _ELLIPSOIDAL, "surface is 'terrain'", "dem-for-geoid"),
    Refuse(_DEM, "terrain", _ABOVE_SEA, "no geoid", "no-geoid"),
    Refuse(
        _DEM, "terrain", {**_ELLIPSOIDAL, "undulation_m": 1.0}, "'undulation_m'", "needless-number"
    ),
    Refuse(
        'geoid = "dem.toml"\n', "mean_sea_level",
        {"surface": "mean_sea_level", "height_reference": "mean_sea_level"},
        "sea level's own heights", "geoid-above-sea",
    ),
    Refuse('surface = "none.toml"\n', "terrain", _ELLIPSOIDAL, "anomaly.surface", "no-file"),
]  # fmt: skip


@pytest.mark.parametrize("refuse", REFUSED, ids=lambda refuse: refuse.id)
def test_what_does_not_fit_is_refused_before_the_work(
    draped: Draped, refuse: Refuse, tmp_path: Path
) -> None:
    product = write_draped(tmp_path, draped.sample, anomaly=refuse.anomaly)
    write_heights(tmp_path / "dem.toml", terrain, (_EAST[:3], _NORTH[:3]), **refuse.surface)
    for path in (product, tmp_path / "draped-survey.toml"):
        path.write_text(path.read_text().replace('"terrain"', f'"{refuse.counts_from}"'))
    with pytest.raises(SourceError, match=re.escape(refuse.says)):
        load_product(product)


def test_a_number_and_a_geoid_are_one_too_many(draped: Draped, tmp_path: Path) -> None:
    write_heights(tmp_path / "geoid.toml", geoid, _COARSE, **_GEOID)
    product = write_draped(
        tmp_path, draped.sample, anomaly='geoid = "geoid.toml"\n', grid="undulation_m = 1.0\n"
    )
    for path in (product, tmp_path / "draped-survey.toml"):
        path.write_text(path.read_text().replace('"terrain"', '"mean_sea_level"'))
    with pytest.raises(SourceError, match="undulation_m in the source"):
        load_product(product)
