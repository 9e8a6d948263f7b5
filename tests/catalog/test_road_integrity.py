"""A road's file that is not what the manifest or the contract says must be refused."""

from __future__ import annotations

import contextlib
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from contract_tables import assert_tabulated
from road_maps import Road, road_map
from synthetic_release import World
from tampering import (
    Bomb,
    Edit,
    Seal,
    assert_whole_or_refused,
    attribute,
    flipped_bits,
    forge,
    put,
    reseal,
    unwritten,
)

from magtiles.catalog import open_release
from magtiles.catalog.releases.road_file import read_road
from magtiles.catalog.releases.road_table import ALWAYS, FEATURES, NANOSECONDS, ROAD_VARIABLES
from magtiles.schemas import contracts
from magtiles.schemas.errors import ContractError, IntegrityError
from magtiles.stages.release.road_file import write_road

PATH = "roads/loop.nc"


def small() -> xr.Dataset:
    return road_map(Road("loop", 300.0, 30))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole") / "loop.nc"
    write_road(small(), path)
    return path


@pytest.fixture(scope="module")
def folder(whole: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    store = tmp_path_factory.mktemp("store")
    return World(heights=(0.0, 1000.0)).publish(store, extra_files={PATH: whole}).path


def record(document: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = next(f for f in document["files"] if f["role"] == "road")
    return found


def test_no_flipped_bit_is_accepted(copy: Path) -> None:
    path = copy / PATH
    data = path.read_bytes()
    accepted = 0
    for flipped in flipped_bits(data, 200):
        path.write_bytes(flipped)
        with contextlib.suppress(IntegrityError):
            _ = open_release(copy).roads["loop"]
            accepted += 1
    assert accepted == 0
    path.write_bytes(data)
    assert open_release(copy).roads["loop"].length_m == 300.0


def test_damaged_bytes_that_the_manifest_lists_are_an_error_or_whole(whole: Path) -> None:
    """Whatever a forged digest lets through is parsed or refused, never a crash."""
    data = whole.read_bytes()
    read = partial(read_road, where="loop.nc")
    assert assert_whole_or_refused(read, data, 200) > 50


SEALS = [
    Seal(lambda d: record(d).update(path="roads/a/b.nc"), "road map elsewhere", "deeper"),
    Seal(lambda d: record(d).update(path="loop.nc"), "road map elsewhere", "another folder"),
    Seal(lambda d: record(d).pop("array_digest"), "array_digest is missing", "no array digest"),
    Seal(lambda d: record(d).update(row=1), "row is unknown", "a tile's key"),
    Seal(lambda d: record(d).update(length_m=-1.0), "length_m", "length"),
    Seal(lambda d: record(d).update(spacing_m=0.0), "spacing_m", "spacing"),
    Seal(lambda d: d["files"].append(dict(record(d))), "name a path twice", "twice"),
    Seal(lambda d: record(d).update(size=5 << 30), "size is 5368709120", "oversize"),
]


@pytest.mark.parametrize("case", SEALS, ids=lambda c: c.id)
def test_a_manifest_that_misplaces_it_is_refused(copy: Path, case: Seal) -> None:
    reseal(copy, case.change)
    with pytest.raises(IntegrityError, match=case.message):
        open_release(copy)


EDITS = [
    Edit(attribute("contract", "anomaly-tile/1.0.0"), "attribute contract", "other contract"),
    Edit(lambda f: f.createVariable("payload", "f4", ("point",)), "holds payload", "foreign"),
    Edit(lambda f: f.createGroup("hidden"), "holds hidden", "a group"),
    Edit(lambda f: f.renameVariable("passes", "speed"), "no variable passes", "part"),
    Edit(lambda f: f.renameDimension("pass", "drive"), "dimension drive is 1", "dimension"),
    Edit(lambda f: f["field_body"].setncattr("units", "gauss"), "units 'gauss'", "units"),
    Edit(attribute("direction", "up"), "attribute direction is 'up'", "direction"),
    Edit(attribute("spacing_m", "1 m"), "attribute spacing_m is '1 m'", "spacing as text"),
    Edit(attribute("spacing_m", 2.0), "distance is uneven", "other spacing"),
    Edit(attribute("matchability", 2.0), "attribute matchability", "matchability"),
    Edit(attribute("frame", "body: forward, left, up"), "attribute frame", "another frame"),
    Edit(attribute("road", "lane"), "is road lane", "another road"),
    Edit(attribute("direction", "backward"), "is road loop-backward", "the other direction"),
    Edit(put("distance", 0.3), "distance is uneven", "distance"),
    Edit(put("latitude", 91.0), "latitude holds 91", "latitude"),
    Edit(put("longitude", np.nan), "longitude holds nan", "no longitude"),
    Edit(put("field_body", np.inf, (3, 1)), "field_body holds inf", "infinite field"),
    Edit(put("field_body_uncertainty", 0.0, (3, 1)), "uncertainty holds 0", "no uncertainty"),
    Edit(put("passes", 0), "passes holds 0", "no pass"),
    Edit(put("pass_digest", "../x"), "pass_digest holds", "no digest"),
]


@pytest.mark.parametrize("case", EDITS, ids=lambda c: c.id)
def test_a_listed_file_that_breaks_the_contract_is_refused(copy: Path, case: Edit) -> None:
    told = forge(copy / PATH, case.edit)
    reseal(copy, lambda d: record(d).update(told))
    with pytest.raises(IntegrityError, match=case.message) as caught:
        _ = open_release(copy).roads["loop"]
    assert "loop.nc" in str(caught.value)


def rebuilt(tmp_path: Path, sizes: dict[str, int], **options: Any) -> bytes:
    """A file of the right names with dimensions of other sizes, nothing written in it."""
    sizes = {"point": 2, "axis": 3, "vehicle": 1, "pass": 1, **sizes}
    rules = {name: ROAD_VARIABLES[name] for name in ALWAYS}
    return unwritten(tmp_path / "bomb.nc", "road-map/1.0.0", sizes, rules, **options)


BOMBS = [
    Bomb({"point": 9_000_000}, {"zlib": True}, "declares .* bytes of arrays", "never written"),
    Bomb({"point": 2_000_000_000}, {"zlib": True}, "dimension point", "too many"),
    Bomb({"point": 1}, {"zlib": True}, "dimension point is 1", "one point"),
    Bomb({"axis": 2}, {"zlib": True}, "dimension axis is 2", "two axes"),
    Bomb({}, {"contiguous": True}, "stored contiguously", "data that may lie elsewhere"),
]


@pytest.mark.parametrize("case", BOMBS, ids=lambda c: c.id)
def test_sizes_and_storage_are_checked_before_anything_is_read(tmp_path: Path, case: Bomb) -> None:
    with pytest.raises(IntegrityError, match=case.message):
        read_road(rebuilt(tmp_path, case.sizes, **case.options), "bomb.nc")


def test_a_variable_without_a_place_is_not_published(tmp_path: Path) -> None:
    road = small()
    road["lane"] = ("point", np.ones(road.sizes["point"]))
    with pytest.raises(ContractError, match="variable lane has no place"):
        write_road(road, tmp_path / "t.nc")
    assert not list(tmp_path.iterdir())


def test_a_road_under_another_name_is_not_published(whole: Path, tmp_path: Path) -> None:
    with pytest.raises(IntegrityError, match="is road loop"):
        World(heights=(0.0,)).publish(tmp_path, extra_files={"roads/lane.nc": whole})
    assert not list(tmp_path.glob("demo/*"))


def test_the_same_dataset_gives_the_same_bytes(whole: Path, tmp_path: Path) -> None:
    write_road(small(), tmp_path / "again.nc")
    assert (tmp_path / "again.nc").read_bytes() == whole.read_bytes()


def test_what_is_written_is_what_was_given(whole: Path) -> None:
    given = small()
    with xr.open_dataset(whole, engine="netcdf4") as found:
        contracts.check(found.load(), "road-map/1")
        for name, array in given.variables.items():
            assert (found[name].values == array.values).all(), name


def test_the_table_is_the_contract() -> None:
    """Dimensions, dtypes and units of the reader's table are those of road-map/1."""
    schema = assert_tabulated("road-map/1", ROAD_VARIABLES, [NANOSECONDS])
    assert set(ROAD_VARIABLES) - {"axis"} == set(schema["properties"])
    assert set(schema["required"]) == set(ALWAYS)
    assert {n for n in ROAD_VARIABLES if n.startswith("feature_")} == set(FEATURES)
