"""STAC export: valid offline, checksums of the very files, areas across the date line."""

from __future__ import annotations

import hashlib
import itertools
import json
from pathlib import Path
from typing import Any, NamedTuple

import pystac
import pytest
from pystac.validation.stac_validator import JsonSchemaSTACValidator
from synthetic_release import World, small_lattice

from magtiles.catalog import open_release
from magtiles.pipeline import stac
from magtiles.pipeline.main import main
from magtiles.pipeline.stac import export_stac, footprint
from magtiles.schemas.errors import ContractError, UsageError


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Nine tiles at Fiji, the last column of them beyond the date line."""
    world = World(lattice=small_lattice(south=-18.0, west=179.6), heights=(0.0, 1000.0))
    return world.publish(tmp_path_factory.mktemp("fiji") / "store").path


@pytest.fixture(autouse=True)
def offline(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever pystac would fetch is an error."""
    read = pystac.stac_io.DefaultStacIO.read_text_from_href

    def local(self: Any, href: str) -> str:
        assert "://" not in href
        return str(read(self, href))

    monkeypatch.setattr(pystac.stac_io.DefaultStacIO, "read_text_from_href", local)


@pytest.fixture
def collection(folder: Path, tmp_path: Path) -> pystac.Collection:
    path, count = export_stac(folder, tmp_path / "stac")
    found = pystac.Collection.from_file(str(path))
    assert len(list(found.get_items())) == count == 9
    return found


def test_every_object_keeps_the_core_schemas(collection: pystac.Collection) -> None:
    validator = JsonSchemaSTACValidator()
    for item in collection.get_items():
        kept = validator.validate_core(item.to_dict(), pystac.STACObjectType.ITEM, "1.1.0")
        assert kept is not None
        assert item.get_collection() is collection
        assert item.datetime is not None
        assert item.datetime.isoformat() == "2020-01-01T00:00:00+00:00"
    kept = validator.validate_core(collection.to_dict(), pystac.STACObjectType.COLLECTION, "1.1.0")
    assert kept is not None


def test_assets_are_the_files_of_the_release(collection: pystac.Collection, folder: Path) -> None:
    hrefs = set()
    for owner in (collection, *collection.get_items()):
        for asset in owner.assets.values():
            path = Path(str(asset.get_absolute_href())).resolve()
            hrefs.add(path)
            data = path.read_bytes()
            assert asset.extra_fields["file:size"] == len(data)
            # Multihash: 0x12 is SHA-256, 0x20 its 32 bytes.
            digest = hashlib.sha256(data).hexdigest()
            assert asset.extra_fields["file:checksum"] == f"1220{digest}"
    assert hrefs == {p.resolve() for p in folder.rglob("*") if p.is_file()}


def test_items_say_where_and_what_they_are(collection: pystac.Collection, folder: Path) -> None:
    tiles = {(t.record.row, t.record.column): t for t in open_release(folder).tiles()}
    item = collection.get_item("r001c002")
    assert item is not None
    asset = item.assets["data"].extra_fields
    arrays = tiles[1, 2].variables
    assert asset["proj:code"] == item.properties["proj:code"] == "EPSG:4326"
    assert asset["proj:shape"] == list(arrays["quality_flag"].shape[1:])
    a, _, west, _, e, south = asset["proj:transform"]
    for axis, start, step in (("longitude", west, a), ("latitude", south, e)):
        nodes = arrays[axis]
        middles = [start + step / 2, start + step * (len(nodes) - 0.5)]
        assert middles == pytest.approx([nodes[0], nodes[-1]], abs=1e-9)
    cube = item.properties["cube:dimensions"]
    assert cube["height"]["values"] == [0.0, 1000.0]
    variables = item.properties["cube:variables"]
    assert set(variables) == set(arrays) - {"height", "latitude", "longitude", "crs"}
    assert variables["gradient_nd"]["unit"] == "nT km-1"


def test_an_area_across_the_date_line_has_two_parts(collection: pystac.Collection) -> None:
    kinds = {i.id: (i.geometry or {})["type"] for i in collection.get_items()}
    assert [kinds[f"r000c00{c}"] for c in range(3)] == ["Polygon", "MultiPolygon", "Polygon"]
    west, _, east, _ = collection.extent.spatial.bboxes[0]
    assert west == pytest.approx(179.6)
    assert east == pytest.approx(179.6 + 53 * 0.0125 - 360.0)
    beyond = collection.get_item("r000c002")
    assert beyond is not None
    assert beyond.bbox is not None
    assert -180.0 < beyond.bbox[0] < beyond.bbox[2] < -179.0


class Expect(NamedTuple):
    input: tuple[float, float]
    bbox: tuple[float, float]
    parts: list[tuple[float, float]]


AREAS = [
    Expect((10.0, 12.0), (10.0, 12.0), [(10.0, 12.0)]),
    Expect((-180.0, 180.0), (-180.0, 180.0), [(-180.0, 180.0)]),
    Expect((0.0, 360.0), (-180.0, 180.0), [(-180.0, 180.0)]),
    Expect((170.0, 180.0), (170.0, 180.0), [(170.0, 180.0)]),
    Expect((170.0, 200.0), (170.0, -160.0), [(170.0, 180.0), (-180.0, -160.0)]),
    Expect((350.0, 355.0), (-10.0, -5.0), [(-10.0, -5.0)]),
    Expect((180.0, 181.0), (-180.0, -179.0), [(-180.0, -179.0)]),
]


@pytest.mark.parametrize("case", AREAS, ids=lambda c: str(c.input))
def test_footprints(case: Expect) -> None:
    bbox, geometry = footprint(1.0, 2.0, *case.input)
    assert bbox == [case.bbox[0], 1.0, case.bbox[1], 2.0]
    rings = geometry["coordinates"]
    rings = rings if geometry["type"] == "Polygon" else [part[0] for part in rings]
    assert [(r[0][0], r[1][0]) for r in rings] == case.parts
    for ring in rings:  # closed, and counter-clockwise as RFC 7946 wants it
        assert ring[0] == ring[-1]
        area = sum(p[0] * q[1] - q[0] * p[1] for p, q in itertools.pairwise(ring))
        assert area > 0


def test_links_may_lead_to_where_the_release_is_published(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "stac"
    assert main(
        ["export", "stac", str(folder), "--out", str(out), "--base-url", "https://a.example/fiji/"]
    ) == 0  # fmt: skip
    item = json.loads((out / "r000c000/r000c000.json").read_bytes())
    assert item["assets"]["data"]["href"] == "https://a.example/fiji/tiles/r000c000.nc"


def test_nothing_is_overwritten_and_nothing_invalid_written(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "stac"
    out.mkdir()
    with pytest.raises(UsageError, match="stac: exists already"):
        export_stac(folder, out)
    monkeypatch.setattr(stac, "footprint", lambda *_: ([1.0], {"type": "Nowhere"}))
    with pytest.raises(ContractError, match="is no valid STAC"):
        export_stac(folder, tmp_path / "other")
    assert [p.name for p in tmp_path.iterdir()] == ["stac"]
