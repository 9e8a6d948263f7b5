"""Road maps of a release, asked: against the truth they were made of, and SciPy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import xarray as xr
from road_maps import Pass, road_map
from road_maps import Road as TrueRoad
from scipy.stats import norm
from synthetic_release import World

from magtiles.catalog import Release, open_release
from magtiles.catalog.releases.manifest import read_manifest
from magtiles.catalog.releases.road import Road
from magtiles.catalog.releases.versions import required_bump
from magtiles.schemas.errors import QueryError
from magtiles.stages.release.road_file import road_path, write_road

LOOP = TrueRoad("loop", 500.0, 60)


def backward(road: xr.Dataset) -> xr.Dataset:
    """The same points, as though driven against the distance."""
    return road.assign_attrs(direction="backward")


def with_features(road: xr.Dataset) -> xr.Dataset:
    """Two features, and a matchability."""
    places = {"start": [40.0, 300.0], "end": [52.0, 311.0], "peak": [45.0, 306.0]}
    for name, values in places.items():
        road[f"feature_{name}"] = ("feature", np.array(values), {"units": "m"})
    road["feature_axis"] = ("feature", np.array([0, 2], np.int8))
    road["feature_amplitude"] = ("feature", np.array([900.0, -500.0]), {"units": "nT"})
    return road.assign_attrs(matchability=0.75)


def publish(folder: Path, roads: list[xr.Dataset], version: str = "1.0.0") -> Path:
    files = {}
    for number, road in enumerate(roads):
        path = folder / f"{version}-{number}.nc"
        write_road(road, path)
        files[road_path(road)] = path
    return (
        World(heights=(0.0, 1000.0)).publish(folder / "s", version=version, extra_files=files).path
    )


@pytest.fixture(scope="module")
def truth() -> xr.Dataset:
    return with_features(road_map(LOOP))


@pytest.fixture(scope="module")
def release(truth: xr.Dataset, tmp_path_factory: pytest.TempPathFactory) -> Release:
    roads = [truth, backward(road_map(LOOP)), road_map(replace(LOOP, name="b"), spacing_m=3.0)]
    return open_release(publish(tmp_path_factory.mktemp("roads"), roads))


@pytest.fixture(scope="module")
def road(release: Release) -> Road:
    return release.roads["loop"]


def test_roads_are_a_mapping_of_names(release: Release) -> None:
    roads = release.roads
    assert list(roads) == ["b", "loop", "loop-backward"]
    assert len(roads) == 3
    assert "loop" in roads
    assert "lane" not in roads
    assert roads["loop"] is roads["loop"]
    assert roads.get("lane") is None
    with pytest.raises(QueryError, match=r"has no road 'lane'.*loop-backward"):
        roads["lane"]


def test_a_release_without_roads_says_so(folder: Path) -> None:
    with pytest.raises(QueryError, match="has no road maps"):
        _ = open_release(folder).roads


def test_what_a_road_is(road: Road, truth: xr.Dataset) -> None:
    assert (road.name, road.direction, road.calibrated) == ("loop", "forward", True)
    assert (road.spacing_m, road.length_m, road.vehicles) == (1.0, 500.0, ("perfect",))
    assert road.matchability == 0.75
    assert [f.peak for f in road.features] == [45.0, 306.0]
    assert road.features[1].axis == 2
    assert (road.variables["field_body"] == truth["field_body"].values).all()
    with pytest.raises(ValueError, match="read-only"):
        road.variables["field_body"][0] = 0.0


def test_field_along_the_road(road: Road, truth: xr.Dataset) -> None:
    """At points the map itself; between them 18 nT rms off, where it changes by 212."""
    at = road.distance
    assert (road.field(at) == truth["field_body"].values).all()
    between = at[:-1] + 0.5
    parts = (np.arange(4) - 1.5) / 4
    exact = np.mean([LOOP.body_field(between + p) for p in parts], axis=0)
    rms = np.sqrt(np.mean((road.field(between) - exact) ** 2))
    assert rms < 0.1 * np.diff(truth["field_body"].values, axis=0).std()
    assert road.field(12.25).shape == (3,)
    assert road.uncertainty(np.zeros((2, 4))).shape == (2, 4, 3)
    assert (road.uncertainty(at) == 266.0).all()
    outside = road.field([-0.1, 0.0, 500.0, 500.1, np.nan])
    assert np.isnan(outside).all(axis=1).tolist() == [True, False, False, True, True]


def test_positions_and_nearest_places_agree(road: Road) -> None:
    distance = np.random.default_rng(0).uniform(0.0, 500.0, (20, 5))
    latitude, longitude = road.position(distance)
    found = road.nearest(latitude, longitude + 360.0)
    assert np.abs(found.distance - distance).max() < 1e-5
    assert found.offset_m.max() < 1e-5
    alone = road.nearest(float(latitude[0, 0]), float(longitude[0, 0]))
    assert np.isscalar(alone.distance)
    assert np.isnan(road.nearest(np.nan, 0.0).offset_m)


@pytest.mark.parametrize("name", ["loop", "loop-backward"])
def test_sections_are_in_the_order_of_driving(release: Release, name: str) -> None:
    one = release.roads[name]
    sign = 1.0 if name == "loop" else -1.0
    section = one.section(200.0, 5)
    assert np.allclose(section, one.field(200.0 - sign * np.arange(4.0, -1.0, -1.0)))
    likely = one.log_likelihood(section)
    assert (np.diff(likely.distance) > 0).all()
    assert len(likely.distance) == 497
    assert likely.distance[likely.log_likelihood.argmax()] == 200.0
    assert one.match(section).distance == 200.0
    part = one.log_likelihood(section, within=(150.0, 250.0))
    assert (part.distance[[0, -1]] == [150.0, 250.0]).all()
    whole = likely.log_likelihood[np.isin(likely.distance, part.distance)]
    assert np.abs(part.log_likelihood - whole).max() < 1e-9
    place = one.position(200.0)
    there = one.log_likelihood_at(*place, section)
    assert there == pytest.approx(likely.log_likelihood.max(), abs=1e-4)
    with pytest.raises(QueryError, match="are not all on the road"):
        one.section(1.0 if name == "loop" else 499.0, 4)


def test_likelihood_is_gaussian(road: Road) -> None:
    section = road.section(100.0, 4) + 150.0
    found = road.log_likelihood(section, noise_nt=80.0)
    k = int(np.searchsorted(found.distance, 57.0))
    spread = np.hypot(266.0, 80.0)
    wanted = norm.logpdf(section, road.section(57.0, 4), spread).sum()
    assert found.log_likelihood[k] == pytest.approx(wanted, abs=1e-9)


def test_particles_are_told_the_same(road: Road) -> None:
    """500 particles about the road: Gaussian at the foot of each, and aside."""
    rng = np.random.default_rng(7)
    latitude, longitude = road.position(rng.uniform(5.0, 495.0, 500))
    latitude, longitude = latitude + rng.normal(0, 6e-5, 500), longitude + rng.normal(0, 6e-5, 500)
    sample = LOOP.body_field(np.array([250.0]))[0]
    nearest = road.nearest(latitude, longitude)
    wanted = norm.logpdf(sample, road.field(nearest.distance), np.hypot(266.0, 100.0)).sum(axis=1)
    found = road.log_likelihood_at(latitude, longitude, sample, noise_nt=100.0)
    assert np.abs(found - wanted).max() < 1e-6
    aside = road.log_likelihood_at(latitude, longitude, sample, noise_nt=100.0, lateral_sigma_m=6.0)
    assert np.abs(aside - wanted + 0.5 * (nearest.offset_m / 6.0) ** 2).max() < 1e-6
    start = road.position(1.0)
    assert np.isnan(road.log_likelihood_at(*start, np.zeros((3, 3))))
    assert np.isnan(road.log_likelihood_at([np.nan], [0.0], sample)).all()


def test_another_pass_is_found(road: Road) -> None:
    """Ten-metre sections: 91 of 99 within 3 m."""
    values = road_map(LOOP, None, Pass(seed=3))["field_body"].values
    ends = np.arange(10, 501, 5)
    told = [road.match(values[e - 10 : e + 1], noise_nt=200.0) for e in ends]
    miss = np.abs(np.array([m.distance for m in told]) - ends)
    assert np.mean(miss <= 3.0) > 0.85
    strict = [road.match(values[e - 10 : e + 1], method="mlr", least_ratio=1e3) for e in ends]
    given = np.array([np.isfinite(m.distance) for m in strict])
    assert 0 < given.sum() < len(ends)
    assert all(np.isnan(m.latitude) == np.isnan(m.distance) for m in strict)


class Refused(NamedTuple):
    ask: Callable[[Road], Any]
    message: str
    id: str


ONE = np.zeros((1, 3))
REFUSED = [
    Refused(lambda r: r.log_likelihood(np.zeros((4, 2))), r"shape \(4, 2\)", "two axes"),
    Refused(lambda r: r.log_likelihood(ONE, form="demeaned"), "2 or more demeaned", "one sample"),
    Refused(lambda r: r.log_likelihood(ONE, form="whitened"), "form: is 'whitened'", "form"),
    Refused(lambda r: r.log_likelihood(ONE * np.nan), r"section\[0, 0\]", "NaN in a section"),
    Refused(lambda r: r.log_likelihood(np.zeros((502, 3))), "no place for 502", "too long"),
    Refused(lambda r: r.log_likelihood(ONE, within=(600.0, 700.0)), "no place", "window off"),
    Refused(lambda r: r.log_likelihood(ONE, within=(0.0, np.inf)), "two finite", "window endless"),
    Refused(lambda r: r.log_likelihood(ONE, noise_nt=-1.0), "noise_nt", "noise"),
    Refused(lambda r: r.match(ONE, method="map"), "one of ml, mlr, abl", "method"),
    Refused(lambda r: r.nearest(91.0, 0.0), "latitude: is 91", "latitude"),
    Refused(lambda r: r.nearest([0.0, 1.0], [0.0, 1.0, 2.0]), "do not broadcast", "shapes"),
    Refused(lambda r: r.log_likelihood_at([0.0], [np.inf], ONE), "longitude", "longitude"),
    Refused(lambda r: r.log_likelihood_at(0.0, 0.0, ONE, lateral_sigma_m=0.0), "lateral", "sigma"),
    Refused(lambda r: r.field("far"), "distance: has dtype", "text"),
    Refused(lambda r: r.field(np.inf), "distance: is inf", "infinite distance"),
]


@pytest.mark.parametrize("case", REFUSED, ids=lambda c: c.id)
def test_refused(road: Road, case: Refused) -> None:
    with pytest.raises(QueryError, match=case.message):
        case.ask(road)


class Bump(NamedTuple):
    change: Callable[[xr.Dataset], list[xr.Dataset]]
    bump: str | None
    reason: str
    id: str


BUMPS = [
    Bump(lambda d: [d], None, "nothing changed", "the same"),
    Bump(lambda d: [d.assign_attrs(source="reworded")], "patch", "its arrays did not", "words"),
    Bump(lambda d: [d.assign(height=d["height"] + 1.0)], "minor", "arrays changed", "values"),
    Bump(lambda d: [d, backward(d)], "minor", "road loop-backward came or went", "another road"),
    Bump(lambda d: [], "minor", "road loop came or went", "gone"),
]


@pytest.mark.parametrize("case", BUMPS, ids=lambda c: c.id)
def test_versions(truth: xr.Dataset, tmp_path: Path, case: Bump) -> None:
    old = read_manifest(publish(tmp_path / "a", [truth]))
    with xr.set_options(keep_attrs=True):
        changed = case.change(truth)
    change = required_bump(old, read_manifest(publish(tmp_path / "b", changed)))
    assert change.bump == case.bump
    assert case.reason in change.reason
