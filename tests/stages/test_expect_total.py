"""What a release lets a track expect: against ppigrf and exact dipoles, and what is refused."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Any

import numpy as np
import ppigrf
import pytest
import xarray as xr
from synthetic_release import World, small_lattice

from magtiles.schemas import contracts
from magtiles.schemas.errors import ContractError, IntegrityError, MagtilesError, UsageError
from magtiles.stages.release.expect_total import ExpectTotalFieldParams, expect_total_field

CORE = {"core_field.shc": Path(ppigrf.__file__).with_name("IGRF14.shc")}


@pytest.fixture(scope="module")
def world() -> World:
    return World(
        lattice=small_lattice(), heights=(0.0, 1000.0), beyond=(np.s_[52:60], np.s_[50:58])
    )


@pytest.fixture(scope="module")
def manifest(world: World, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = world.publish(tmp_path_factory.mktemp("store"), extra_files=CORE).path
    return folder / "manifest.json"


def track(**changes: Any) -> xr.Dataset:
    n = 9
    made = xr.Dataset(
        {
            "latitude": ("time", np.linspace(44.05, 44.35, n), {"units": "degrees_north"}),
            "longitude": ("time", np.linspace(10.1, 10.5, n), {"units": "degrees_east"}),
            "height": ("time", np.linspace(0.0, 1000.0, n), {"units": "m"}),
            "field_total": ("time", np.full(n, 47e3), {"units": "nT"}),
        },
        coords={"time": np.datetime64("2020-01-01", "ns") + np.arange(n)},
        attrs={"height_reference": "ellipsoid", "source": "a flight"},
    )
    return made.assign_attrs(changes)


def expect(given: xr.Dataset, *release: Path) -> xr.Dataset:
    return expect_total_field(given, list(release), params=ExpectTotalFieldParams())


def test_core_field_and_anomaly_are_expected(world: World, manifest: Path):
    given = track()
    found = expect(given, manifest)
    contracts.check(found, "track/1")
    place = [given[name].values for name in ("latitude", "longitude", "height")]
    date = datetime.datetime(2020, 1, 1)  # noqa: DTZ001
    core = ppigrf.igrf(place[1], place[0], place[2] / 1e3, date)
    exact = np.linalg.norm([a[0] for a in core], axis=0) + world.truth(*place)[0]
    # Measured: 0.0015 nT, the map's interpolation.
    np.testing.assert_allclose(found["expected_total"], exact, atol=0.01)


def test_unknown_and_uncovered_places_are_missing(manifest: Path):
    given = track()
    given["latitude"][2] = np.nan
    given["height"][4] = np.nan
    given["longitude"][6] = 11.5
    missing = np.isnan(expect(given, manifest)["expected_total"].values)
    np.testing.assert_array_equal(np.flatnonzero(missing), [2, 4, 6])


REFUSED = {
    "the folder": (lambda m: (track(), m.parent), UsageError, "the manifest.json of one release"),
    "two releases": (lambda m: (track(), m, m), UsageError, "the manifest.json of one release"),
    "no release": (lambda m: (track(), Path("manifest.json")), IntegrityError, "is no release"),
    "sea level": (
        lambda m: (track(height_reference="mean_sea_level"), m), ContractError, "undulation_m",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_expected_is_refused(case: str, manifest: Path):
    make, kind, message = REFUSED[case]
    with pytest.raises(kind, match=message) as caught:
        expect(*make(manifest))
    assert isinstance(caught.value, MagtilesError)
