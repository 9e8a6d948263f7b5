"""Every grid format: the same grid, written by another program or by hand, is read the same."""

from __future__ import annotations

import gzip
import resource
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import harmonica
import numpy as np
import pytest
import xarray as xr
from grid_files import SMALL, Rows, Writer, gdal, geosoft, in_gzip, in_zip, old_gmt, text

from magtiles.schemas import contracts
from magtiles.schemas.errors import FormatError, MagtilesError, SourceError
from magtiles.stages.ingest import unpack, xyz
from magtiles.stages.ingest.grid import STAGE, ingest_grid
from magtiles.stages.ingest.source import IngestGridParams

_SAID: dict[str, Any] = {
    "height_m": 1500.0,
    "height_reference": "ellipsoid",
    "reference_field": "IGRF-14",
    "reference_epoch": "1990-01-01",
    "uncertainty_nt": 2.0,
}


@dataclass(frozen=True)
class Expect:
    write: Writer
    id: str
    keys: tuple[tuple[str, Any], ...] = ()


READ = [
    Expect(gdal("GSAG", 1.70141e38), "surfer-6-text"),
    Expect(gdal("GSBG", 1.70141e38), "surfer-6"),
    Expect(gdal("GS7BG", 1.70141e38), "surfer-7"),
    Expect(gdal("ERS", -9999.0), "er-mapper"),
    Expect(gdal("AAIGrid", -9999.0), "esri-ascii"),
    Expect(geosoft(), "geosoft"),
    Expect(geosoft(compressed=True), "geosoft-compressed"),
    Expect(geosoft(along_y=True, dtype="<f8"), "geosoft-by-columns"),
    Expect(old_gmt(), "old-gmt"),
    Expect(old_gmt(cells=True), "old-gmt-cells"),
    Expect(text(" "), "xyz"),
    Expect(text(",", "# made\nx,y,tmi\n"), "csv"),
    Expect(text(", ", tail="502500,5001500,99999\n"), "csv-void", (("no_data", 99999.0),)),
    Expect(in_gzip(text("\t")), "xyz-gzip"),
    Expect(in_zip(geosoft()), "geosoft-zip"),
    Expect(in_zip(gdal("ERS", -1.0)), "ers-zip", (("member", "grid.ers"),)),
    Expect(in_zip(text(" "), "a.txt"), "xyz-zip-of-two", (("member", "grid.xyz"),)),
]


@pytest.mark.parametrize("expect", READ, ids=lambda expect: expect.id)
def test_a_grid_is_the_same_in_every_format(expect: Expect, tmp_path: Path) -> None:
    params = IngestGridParams(crs="EPSG:32610", **(_SAID | dict(expect.keys)))
    grid = ingest_grid(expect.write(tmp_path), params=params)
    contracts.check(grid, STAGE.output)
    np.testing.assert_array_equal(grid.magnetic_anomaly, SMALL.values)
    np.testing.assert_allclose(grid.x, SMALL.x, rtol=0, atol=1e-6)
    np.testing.assert_allclose(grid.y, SMALL.y, rtol=0, atol=1e-6)


@pytest.mark.parametrize("compressed", [False, True])
def test_geosoft_values_are_harmonicas_own(tmp_path: Path, compressed: bool) -> None:
    (path,) = geosoft(compressed=compressed)(tmp_path)
    grid = ingest_grid([path], params=IngestGridParams(crs="EPSG:32610", **_SAID))
    own = harmonica.load_oasis_montaj_grid(str(path))
    np.testing.assert_array_equal(grid.magnetic_anomaly, own.values)
    np.testing.assert_array_equal(grid.x, own.easting.values)


def test_a_sidecar_changes_nothing(tmp_path: Path) -> None:
    """GDAL would take voids, places and CRS from files that receipts do not know."""
    (path,) = gdal("AAIGrid", -9999.0)(tmp_path)
    path.with_suffix(".prj").write_text("Projection UTM\nZone 11\n")
    said = IngestGridParams(**_SAID)
    with pytest.raises(SourceError, match="key 'crs' is missing"):
        ingest_grid([path], params=said)


def cut(write: Writer, share: float) -> Writer:
    def damage(folder: Path, rows: Rows = SMALL) -> list[Path]:
        files = write(folder, rows)
        whole = files[-1].read_bytes()
        files[-1].write_bytes(whole[: int(share * len(whole))])
        return files

    return damage


def edited(old: str, new: str) -> Writer:
    def change(folder: Path) -> list[Path]:
        (path,) = text(" ")(folder)
        path.write_text(path.read_text().replace(old, new))
        return [path]

    return change


@dataclass(frozen=True)
class Refuse:
    write: Writer
    error: type[MagtilesError]
    message: str
    id: str
    keys: tuple[tuple[str, Any], ...] = ()


_LAST = "500500.00 5000500.00 -5.25"
REFUSED = [
    Refuse(
        cut(gdal("GSAG", 1.70141e38), 0.6),
        FormatError,
        "not a whole Surfer 6 text",
        "surfer-6-text",
    ),
    Refuse(
        cut(gdal("GSBG", 1.70141e38), 0.9), FormatError, "not a whole Surfer 6 grid", "surfer-6"
    ),
    Refuse(
        cut(gdal("GS7BG", 1.70141e38), 0.9), FormatError, "not a whole Surfer 7 grid", "surfer-7"
    ),
    Refuse(
        cut(gdal("ERS", -9999.0), 0.9), FormatError, r"grid: holds 43 bytes; expected 48", "ers"
    ),
    Refuse(
        lambda f: gdal("ERS", -9999.0)(f)[:1], SourceError, "data file is not named", "ers-alone"
    ),
    Refuse(cut(gdal("AAIGrid", -9999.0), 0.8), FormatError, "not a whole ESRI ASCII", "esri-ascii"),
    Refuse(cut(geosoft(), 0.99), FormatError, r"expected 4 x 3 values of 4 bytes", "geosoft"),
    Refuse(cut(geosoft(compressed=True), 0.97), FormatError, "whole Geosoft", "geosoft-compressed"),
    Refuse(geosoft(rotation=30.0), FormatError, "rotated by 30 degrees", "geosoft-rotated"),
    Refuse(old_gmt(count=11), FormatError, r"z holds 11 values.*4 x 3 = 12", "old-gmt"),
    Refuse(cut(text(" "), 0.98), FormatError, "last line has 2 columns", "xyz"),
    Refuse(edited(_LAST, "500500 x -5"), FormatError, r"not numbers.*'x'", "xyz-word"),
    Refuse(
        edited("501500.00 5000500", "501700 5000500"),
        FormatError,
        r"line \d+: x = 501700 is no node",
        "xyz-off",
    ),
    Refuse(
        edited(_LAST, "501500 5000500 1"),
        FormatError,
        "line 11: the node was given before",
        "xyz-twice",
    ),
    Refuse(
        text(" "),
        SourceError,
        "column 4 is asked for, but line 1 has 3",
        "xyz-columns",
        (("columns", (1, 2, 4)),),
    ),
    Refuse(cut(in_gzip(text(" ")), 0.6), FormatError, r"grid.xyz.gz: is not a whole gzip", "gzip"),
    Refuse(
        in_zip(text(" "), "a.txt"),
        SourceError,
        r"holds 2 files: a.txt, inner/grid.xyz.*'member'",
        "zip-of-two",
    ),
    Refuse(
        in_zip(text(" ")),
        SourceError,
        "key 'member' is 'b'; expected one of inner/grid.xyz",
        "member",
        (("member", "b"),),
    ),
    Refuse(in_zip(cut(geosoft(), 0.99)), FormatError, r"zip \(grid.grd\): holds", "inside-zip"),
]


@pytest.mark.parametrize("refuse", REFUSED, ids=lambda refuse: refuse.id)
def test_damaged_files_are_refused(refuse: Refuse, tmp_path: Path) -> None:
    params = IngestGridParams(crs="EPSG:32610", **(_SAID | dict(refuse.keys)))
    with pytest.raises(refuse.error, match=refuse.message):
        ingest_grid(refuse.write(tmp_path), params=params)


@pytest.mark.parametrize("lines", [1, 5])
@pytest.mark.parametrize("separator", [" ", ","])
def test_rows_read_in_parts_are_the_same_grid(
    separator: str, lines: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(xyz, "_PART_LINES", lines)
    params = IngestGridParams(crs="EPSG:32610", **_SAID)
    grid = ingest_grid(text(separator)(tmp_path), params=params)
    np.testing.assert_array_equal(grid.magnetic_anomaly, SMALL.values)
    np.testing.assert_allclose(grid.x, SMALL.x, rtol=0, atol=1e-6)
    np.testing.assert_allclose(grid.y, SMALL.y, rtol=0, atol=1e-6)


@pytest.mark.parametrize("lines", [1, 5])
@pytest.mark.parametrize(
    ("new", "message"),
    [
        ("501500 5000500 1", "line 11: the node was given before"),
        ("500500 x -5", r"not numbers.*'x'"),
        ("500700 5000500 -5", "line 11: x = 500700 is no node"),
    ],
)
def test_a_line_is_named_whichever_part_it_is_in(
    new: str, message: str, lines: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(xyz, "_PART_LINES", lines)
    with pytest.raises(FormatError, match=message):
        ingest_grid(
            edited(_LAST, new)(tmp_path), params=IngestGridParams(crs="EPSG:32610", **_SAID)
        )


def test_scattered_points_are_told_before_they_are_all_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(xyz, "_PART_LINES", 10)
    monkeypatch.setattr(xyz, "_LONGEST", 20)
    path = tmp_path / "points.xyz"
    path.write_text("".join(f"{i**1.5:.3f} {i % 7} 1\n" for i in range(1000)))
    with pytest.raises(FormatError, match="the first 30 lines have more than 20 different x or y"):
        ingest_grid([path], params=IngestGridParams(crs="EPSG:32610", **_SAID))


def test_a_bomb_is_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unpack, "_LIMIT_BYTES", 1000)
    path = tmp_path / "bomb.xyz.gz"
    path.write_bytes(gzip.compress(bytes(10_000)))
    with pytest.raises(FormatError, match="unpacks to more than"):
        ingest_grid([path], params=IngestGridParams(**_SAID))


def test_a_full_disk_is_not_the_archives_fault(tmp_path: Path) -> None:
    files = in_gzip(text(" "))(tmp_path)
    least, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, most))
    try:
        with pytest.raises(MagtilesError, match=r"grid.xyz: cannot be written .*check free space"):
            ingest_grid(files, params=IngestGridParams(crs="EPSG:32610", **_SAID))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (least, most))


def test_a_column_of_uncertainty(tmp_path: Path) -> None:
    rows = [f"{i},{j},{x},{y},9,{v},{2 + i}" for j, y in enumerate((10.0, 10.5))
            for i, (x, v) in enumerate(((179.5, 1.0), (180.0, 99999.0), (180.5, 3.0)))]  # fmt: skip
    path = tmp_path / "emag2.csv"
    path.write_text("\n".join(rows))
    said = {k: v for k, v in _SAID.items() if k != "uncertainty_nt"}
    params = IngestGridParams(
        crs="EPSG:4326", columns=(3, 4, 6), uncertainty_column=7, no_data=99999.0, **said
    )
    grid = ingest_grid([path], params=params)
    np.testing.assert_array_equal(grid.magnetic_anomaly, [[1, np.nan, 3]] * 2)
    np.testing.assert_array_equal(grid.magnetic_anomaly_uncertainty, [[2, 3, 4]] * 2)
    np.testing.assert_array_equal(grid.longitude, [179.5, 180.0, 180.5])


class TestReal:
    def _grid(self, path: Path) -> xr.Dataset:
        said = {"crs": "EPSG:4326", "no_data": -99999.0, **_SAID}
        return ingest_grid([path], params=IngestGridParams(**said))

    def test_emag2_voids_must_be_stated(self, real_data: Path) -> None:
        params = IngestGridParams(crs="EPSG:4326", **_SAID)
        with pytest.raises(FormatError, match=r"6167 values are -99999.*no_data = -99999\.0"):
            ingest_grid([real_data / "grids" / "EMAG2_V2_1x1.grd"], params=params)

    def test_emag2_of_the_world(self, real_data: Path) -> None:
        """Old GMT layout: 361 x 181, the meridian at both ends dropped once."""
        grid = self._grid(real_data / "grids" / "EMAG2_V2_1x1.grd")
        assert dict(grid.sizes) == {"latitude": 181, "longitude": 360}
        assert float(grid.longitude[0]) == -180.0
        assert int(grid.magnetic_anomaly.isnull().sum()) == 6161  # 6167, six of them twice

    def test_two_editions_of_emag2_agree(self, real_data: Path) -> None:
        """The world's nodes are the patch's own, to the digits that the text was printed with."""
        world = self._grid(real_data / "grids" / "EMAG2_V2_1x1.grd").magnetic_anomaly
        patch = self._grid(real_data / "grids" / "emag2_v2_south_america.xyz").magnetic_anomaly
        assert dict(patch.sizes) == {"latitude": 71, "longitude": 101}
        whole = patch.isel(latitude=slice(10, None, 20), longitude=slice(0, None, 20))
        same = world.sel(latitude=whole.latitude, longitude=whole.longitude, method="nearest")
        assert float(abs(whole.values - same.values).max()) < 1e-3
