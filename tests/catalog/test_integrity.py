"""A release that is not what its manifest says must be refused, whatever was done to it."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import netCDF4
import numpy as np
import pytest
from tampering import reseal

from magtiles.catalog import Release, open_release
from magtiles.catalog.releases.digest import (
    array_digest,
    sha256,
)
from magtiles.catalog.releases.fields import Fields, parse_json
from magtiles.schemas.errors import IntegrityError

TILE = "tiles/r001c001.nc"
POSITION = (44.2, 10.3, 500.0)  # in that tile


def replace_tile(folder: Path, edit: Callable[[Any], Any]) -> None:
    """Edit a tile with netCDF4 and list its new bytes in the manifest."""
    path = folder / TILE
    with netCDF4.Dataset(path, "a") as file:
        file.set_auto_maskandscale(False)
        edit(file)
    data = path.read_bytes()

    def relist(document: dict[str, Any]) -> None:
        record = next(f for f in document["files"] if f["path"] == TILE)
        record |= {"size": len(data), "sha256": sha256(data)}

    reseal(folder, relist)


def flip_bit(folder: Path) -> None:
    data = bytearray((folder / TILE).read_bytes())
    data[len(data) // 2] ^= 1
    (folder / TILE).write_bytes(data)


def test_one_flipped_bit_in_a_tile_is_found_at_first_touch(copy: Path) -> None:
    flip_bit(copy)
    release = open_release(copy)
    assert np.isfinite(release.anomaly.total(44.01, 10.01, 500.0))  # another tile
    with pytest.raises(IntegrityError, match=r"r001c001\.nc: its content changed: sha256"):
        release.anomaly.total(*POSITION)
    with pytest.raises(IntegrityError, match=r"r001c001\.nc"):
        list(release.tiles())


class Damage(NamedTuple):
    do: Callable[[Path], Any]
    message: str
    id: str


def link(folder: Path) -> None:
    target = folder.parent / "elsewhere.nc"
    (folder / TILE).rename(target)
    (folder / TILE).symlink_to(target)


def edit_text(folder: Path, old: str, new: str) -> None:
    path = folder / "manifest.json"
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")


DAMAGES = [
    Damage(lambda f: (f / TILE).unlink(), r"r001c001\.nc: is missing", "missing tile"),
    Damage(lambda f: (f / TILE).write_bytes(b"CDF"), "is 3 bytes; expected", "truncated tile"),
    Damage(lambda f: (f / "notes.txt").touch(), r"notes\.txt: is a foreign file", "foreign file"),
    Damage(lambda f: (f / "tiles/x.nc").touch(), r"x\.nc: is a foreign file", "foreign tile"),
    Damage(lambda f: (f / "extra").mkdir(), "extra: is a foreign folder", "foreign folder"),
    Damage(link, "is a link or special file", "link"),
    Damage(lambda f: os.mkfifo(f / "pipe"), "is a link or special file", "pipe"),
    Damage(lambda f: (f / "manifest.json").unlink(), "is no release", "no manifest"),
    Damage(lambda f: (f / "manifest.json").write_bytes(b""), "not a JSON document", "empty"),
    Damage(lambda f: (f / "manifest.json").write_bytes(b"\xff"), "not a JSON", "not UTF-8"),
    Damage(lambda f: (f / "manifest.json").write_bytes(b"[" * 100_000), "not a JSON", "deep"),
    Damage(
        lambda f: edit_text(f, '"rows":46', '"rows":47'),
        "its digest is not that of its contents", "edited manifest",
    ),
]  # fmt: skip


@pytest.mark.parametrize("case", DAMAGES, ids=lambda case: case.id)
def test_a_damaged_release_does_not_open(copy: Path, case: Damage) -> None:
    case.do(copy)
    with pytest.raises(IntegrityError, match=case.message) as caught:
        open_release(copy)
    assert str(copy) in str(caught.value)
    assert caught.value.remedy


class Lie(NamedTuple):
    change: Callable[[dict[str, Any]], Any]
    message: str


def in_tile(**entries: Any) -> Callable[[dict[str, Any]], Any]:
    def change(document: dict[str, Any]) -> None:
        document["files"][0] |= entries

    return change


LIES = [
    Lie(in_tile(path="../outside.nc"), r"files\[0\]\.path is '\.\./outside\.nc'"),
    Lie(in_tile(path="/etc/passwd"), r"files\[0\]\.path"),
    Lie(in_tile(path="tiles/../../x.nc"), r"files\[0\]\.path"),
    Lie(in_tile(path="tiles\\x.nc"), r"files\[0\]\.path"),
    Lie(in_tile(path="manifest.json"), "unsafe path"),
    Lie(in_tile(path=7), r"files\[0\]\.path is 7; expected a string"),
    Lie(in_tile(path="tiles/r000c001.nc"), "name a path twice"),
    Lie(in_tile(size=-1), r"files\[0\]\.size is -1"),
    Lie(in_tile(size=1 << 40), r"files\[0\]\.size is"),
    Lie(in_tile(size=True), r"files\[0\]\.size is True; expected an integer"),
    Lie(in_tile(sha256="0" * 63), r"files\[0\]\.sha256"),
    Lie(in_tile(role="script"), r"files\[0\]\.role is 'script'"),
    Lie(in_tile(row=1), "one tile for each of 3 x 3 places"),
    Lie(in_tile(row=3), r"files\[0\]\.row is 3; expected an integer from 0 to 2"),
    Lie(in_tile(run="rm"), r"files\[0\]\.run is unknown"),
    Lie(lambda d: d.pop("lattice"), "lattice is missing"),
    Lie(lambda d: d["lattice"].update(rows=10**9), "lattice.rows is 1000000000"),
    Lie(lambda d: d["lattice"].update(rows=46.0), "lattice.rows is 46.0; expected an integer"),
    Lie(lambda d: d["lattice"].update(tile_rows=10**6), "makes tiles of"),
    Lie(lambda d: d["lattice"].update(south=89.9), "reaches beyond the globe"),
    Lie(lambda d: d["lattice"].update(latitude_spacing=0), "lattice.latitude_spacing is 0"),
    Lie(lambda d: d["lattice"].update(south=10**400), "lattice.south is 1000"),
    Lie(lambda d: d.update(heights_m=[0, 0]), "heights_m do not ascend"),
    Lie(lambda d: d.update(heights_m=[]), "heights_m has 0 items"),
    Lie(lambda d: d.update(heights_m=["0"]), "heights_m holds a string"),
    Lie(lambda d: d.update(height_reference="moon"), "height_reference is 'moon'"),
    Lie(lambda d: d.update(contract="release-manifest/2.0.0"), "contract is"),
    Lie(lambda d: d.update(version="1.0"), "version is '1.0'"),
    Lie(lambda d: d.update(files={}), "files is an object; expected a list"),
    Lie(lambda d: d["identity"].update(datum="NAD27"), "identity.datum is 'NAD27'"),
    Lie(lambda d: d.update(surprise=1), "surprise is unknown"),
]


@pytest.mark.parametrize("case", LIES, ids=lambda c: c.message)
def test_a_manifest_is_not_trusted(copy: Path, case: Lie) -> None:
    reseal(copy, case.change)
    with pytest.raises(IntegrityError, match=case.message) as caught:
        open_release(copy)
    assert "manifest.json" in str(caught.value)


@pytest.mark.parametrize("text", ['{"a": NaN}', '{"a": 1, "a": 2}', "[]", "{", "1e999x"])
def test_json_that_is_no_plain_object_is_refused(text: str) -> None:
    with pytest.raises(IntegrityError, match=r"m\.json"):
        parse_json(text.encode(), "m.json")


def test_infinite_numbers_of_json_are_refused() -> None:
    with pytest.raises(IntegrityError, match="a is inf; expected a number"):
        Fields({"a": float("inf")}, "m.json", "").number("a", 0, 1)


TILE_LIES = [
    Lie(lambda f: f.setncattr("tile_row", 2), "attribute tile_row is"),
    Lie(lambda f: f.setncattr("height_reference", "terrain"), "attribute height_reference"),
    Lie(lambda f: f.delncattr("contract"), "attribute contract is None"),
    Lie(lambda f: f["anomaly_north"].setncattr("units", "T"), "anomaly_north has units 'T'"),
    Lie(lambda f: f.renameVariable("gradient_nn", "gradient"), "has no variable gradient_nn"),
    Lie(lambda f: f.createVariable("extra", "f4", ("height",)), "extra"),
    Lie(lambda f: f["latitude"].__setitem__(5, 44.123), r"latitude is [\d.]+ cells off"),
    Lie(lambda f: f["height"].__setitem__(1, 1001.0), "height is"),
    Lie(lambda f: f["gradient_nd"].__setitem__((0, 20, 20), np.nan), "gradient_nd holds values"),
]


@pytest.mark.parametrize("case", TILE_LIES, ids=lambda case: case.message)
def test_a_tile_must_keep_the_contract_even_with_the_right_digest(copy: Path, case: Lie) -> None:
    replace_tile(copy, case.change)
    with pytest.raises(IntegrityError, match=case.message) as caught:
        open_release(copy).anomaly.total(*POSITION)
    assert TILE in str(caught.value)


def test_a_tile_of_another_format_is_refused(copy: Path) -> None:
    junk = b"not a netCDF file" * 100
    (copy / TILE).write_bytes(junk)

    def relist(document: dict[str, Any]) -> None:
        record = next(f for f in document["files"] if f["path"] == TILE)
        record |= {"size": len(junk), "sha256": sha256(junk)}

    reseal(copy, relist)
    with pytest.raises(IntegrityError, match="is no readable tile"):
        open_release(copy).anomaly.total(*POSITION)


def test_tiles_and_files_come_verified(release: Release) -> None:
    tiles = list(release.tiles())
    assert [(t.record.row, t.record.column) for t in tiles] == sorted(release.manifest.tiles)
    for tile in tiles:
        assert array_digest(tile.variables) == tile.record.array_digest
        assert tile.attributes["contract"] == "anomaly-tile/1.0.0"
    assert json.loads(release.file("provenance.json"))["_type"].startswith("https://in-toto.io/")
    with pytest.raises(IntegrityError, match="is not part of the release"):
        release.file("../latest.json")


def test_the_array_digest_ignores_the_container_and_sees_everything_else() -> None:
    values = np.arange(6, dtype="<f4").reshape(2, 3)
    digest = array_digest({"b": values, "a": np.int32(1)})
    assert array_digest({"a": np.int32(1), "b": np.asfortranarray(values.astype(">f4"))}) == digest
    for other in (
        {"b": values.T, "a": np.int32(1)},
        {"b": values.astype("f8"), "a": np.int32(1)},
        {"c": values, "a": np.int32(1)},
        {"b": values + np.float32(1e-6), "a": np.int32(1)},
        {"b": values},
    ):
        assert array_digest(other) != digest
