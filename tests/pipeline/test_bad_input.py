"""Bad input at the command line: one clear line, the right status, and nothing half written.

Each case spoils one thing in a folder where a small product has been built and published, and
says what the message must hold.
"""

from __future__ import annotations

import json
import re
import shutil
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import rasterio
import xarray as xr
from rasterio.errors import NotGeoreferencedWarning

from magtiles.catalog import open_release
from magtiles.pipeline.main import main
from magtiles.pipeline.product import AnomalyTable, ProductTable, ProductTables, RegionTable
from magtiles.pipeline.sample import DEMO, synthesize, write_survey
from magtiles.stages.ingest.source import IngestGridParams, SourceParams

_SPEC = replace(
    DEMO, name="small", width_m=40e3, length_m=30e3, dipoles=60, levels_m=(2500.0, 3500.0)
)
_NODE = ["--lat", "46.0", "--lon", "-121.5", "--height", "2000"]


@dataclass(frozen=True)
class Site:
    """A folder with a survey, its TOML files, a work folder and a store with its release."""

    folder: Path

    @property
    def survey(self) -> Path:
        return self.folder / "small-survey.tif"

    @property
    def source(self) -> Path:
        return self.folder / "small-survey.toml"

    @property
    def product(self) -> Path:
        return self.folder / "small.toml"

    @property
    def store(self) -> Path:
        return self.folder / "store"

    @property
    def work(self) -> Path:
        return self.folder / "work"

    @property
    def release(self) -> Path:
        return self.store / "small" / "1.0.0"

    def build(self, *more: str) -> list[str]:
        where = ["--store", str(self.store), "--work", str(self.work)]
        return ["build", str(self.product), *where, *more]

    def run(self, stage: str, role: str, file: Path, *params: str) -> list[str]:
        given = [word for p in params for word in ("--param", p)]
        out = str(self.folder / "out.nc")
        return ["run", stage, "--in", f"{role}={file}", "--out", out, *given]


Change = Callable[[Site], list[str]]


@pytest.fixture(scope="session")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Site:
    site = Site(tmp_path_factory.mktemp("pristine"))
    write_survey(site.folder, synthesize(_SPEC))
    assert main(site.build()) == 0
    return site


@pytest.fixture
def site(pristine: Site, tmp_path: Path) -> Site:
    return Site(Path(shutil.copytree(pristine.folder, tmp_path / "site")))


# How to spoil things. Each gives back the command that must notice.


def product(old: str, new: str) -> Change:
    return _edited("product", old, new)


def source(old: str, new: str) -> Change:
    return _edited("source", old, new)


def _edited(which: str, old: str, new: str) -> Change:
    def change(site: Site) -> list[str]:
        path: Path = getattr(site, which)
        text = path.read_text()
        assert re.search(old, text, flags=re.M), old
        path.write_text(re.sub(old, lambda _: new, text, count=1, flags=re.M))
        return site.build()

    return change


def anomaly(line: str) -> Change:
    """A line more in [anomaly], the last table of the product."""

    def change(site: Site) -> list[str]:
        with site.product.open("a") as file:
            file.write(line + "\n")
        return site.build()

    return change


def survey(content: bytes) -> Change:
    def change(site: Site) -> list[str]:
        site.survey.write_bytes(content)
        return site.build()

    return change


def cut_survey(site: Site) -> list[str]:
    content = site.survey.read_bytes()
    site.survey.write_bytes(content[: len(content) // 2])
    return site.build()


def raster(values: float | None = None, **profile: Any) -> Change:
    """The survey with another profile, or one value throughout."""

    def change(site: Site) -> list[str]:
        with rasterio.open(site.survey) as old:
            array, settings = old.read(1), old.profile | profile
        if values is not None:
            array[:] = values
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(site.survey, "w", **settings) as new:
                new.write(array, 1)
        return site.build()

    return change


def uneven(site: Site) -> list[str]:
    x = 5e5 + 1000.0 * np.arange(40)
    x[20:] += 300.0
    crs = pyproj.CRS.from_epsg(32610).to_cf()
    xr.Dataset(
        {
            "tmi": (("y", "x"), np.zeros((30, 40)), {"units": "nT", "grid_mapping": "utm"}),
            "utm": ((), np.int32(0), crs),
        },
        coords={"y": 5e6 + 1000.0 * np.arange(30), "x": x},
    ).to_netcdf(site.folder / "uneven.nc")
    return source("small-survey.tif", "uneven.nc")(site)


def without(name: str) -> Change:
    def change(site: Site) -> list[str]:
        getattr(site, name).unlink()
        return site.build()

    return change


def elsewhere(site: Site) -> list[str]:
    (site.folder / "elsewhere").mkdir()
    return site.build("--from", str(site.folder / "elsewhere"))


def store_is_a_file(site: Site) -> list[str]:
    (site.folder / "file").touch()
    return ["build", str(site.product), "--store", str(site.folder / "file" / "store")]


def command(*words: str) -> Change:
    return lambda site: list(words)


def ingest(*params: str) -> Change:
    return lambda site: site.run("ingest-grid", "files", site.source, *params)


def stage(name: str, *params: str) -> Change:
    return lambda site: site.run(name, "grid", site.work / "small" / "survey.nc", *params)


def stage_on(name: str, file: str, *params: str) -> Change:
    return lambda site: site.run(name, "grid", site.folder / file, *params)


def cut_artifact(site: Site) -> list[str]:
    content = (site.work / "small" / "survey.nc").read_bytes()
    (site.folder / "half.nc").write_bytes(content[: len(content) // 2])
    return stage_on("fill-voids", "half.nc")(site)


def artifact_of_another_contract(site: Site) -> list[str]:
    return site.run("fill-voids", "grid", site.work / "small" / "level-2500m.nc")


def query(*words: str) -> Change:
    return lambda site: ["query", str(site.release), *words]


def positions(text: str) -> Change:
    def change(site: Site) -> list[str]:
        (site.folder / "p.csv").write_text(text)
        return ["query", str(site.release), "--positions", str(site.folder / "p.csv")]

    return change


def new_version(version: str, *edits: Change) -> Change:
    def change(site: Site) -> list[str]:
        for edit in edits:
            edit(site)
        return product('"1.0.0"', f'"{version}"')(site)

    return change


@dataclass(frozen=True)
class Expect:
    """What to spoil, the exit status, and what the one line on stderr must hold."""

    change: Change
    status: int
    words: Sequence[str]
    id: str


def keys(kind: type[Any]) -> str:
    return "expected one of " + ", ".join(sorted(kind.model_fields))


_FILES = [
    Expect(cut_survey, 1, ["small-survey.tif", "is truncated: fetch it again"], "truncated"),
    Expect(survey(b""), 1, ["small-survey.tif", "is empty", "fetch it again"], "empty"),
    Expect(
        survey(b"<!DOCTYPE html><p>404"),
        1,
        ["small-survey.tif byte 0", "an HTML page", "expected GeoTIFF, GXF, netCDF"],
        "html",
    ),
    Expect(survey(b"12 34\n"), 1, ["small-survey.tif byte 0", "text of an unknown kind"], "text"),
    Expect(survey(b"PK\x03\x04"), 1, ["not a whole zip file", "fetch it again"], "zip"),
    Expect(raster(crs=None), 1, ["small-survey.toml [grid]", "'crs'", "add crs = "], "no-crs"),
    Expect(raster(transform=None), 1, ["small-survey.tif", "no position"], "no-position"),
    Expect(uneven, 1, ["uneven.nc axis x", "index 19 to 20", "1300"], "irregular"),
    Expect(raster(-999999.0), 1, ["small-survey.tif", "every value is void"], "all-void"),
    Expect(raster(np.inf), 1, ["small-survey.tif", "row 0, column 0 is infinite"], "infinite"),
    Expect(
        without("survey"),
        1,
        ["small-survey.toml: 1 of the 1 data files of", "no file", "small-survey.tif", "--from"],
        "no-data-file",
    ),
    Expect(elsewhere, 1, ["no file", "elsewhere/small-survey.tif"], "no-data-file-from"),
    Expect(cut_artifact, 1, ["half.nc", "truncated or damaged"], "truncated-artifact"),
    Expect(
        artifact_of_another_contract,
        1,
        ["level-2500m.nc (role grid)", "component-grid/1", "expected anomaly-grid/1"],
        "other-contract",
    ),
    Expect(
        stage_on("fill-voids", "small-survey.tif"),
        1,
        ["small-survey.tif", "expected a netCDF-4 file", "ingest-grid"],
        "foreign-artifact",
    ),
]

_PRODUCT = [
    Expect(without("product"), 1, ["small.toml: cannot be read: No such file"], "no-product"),
    Expect(product(r"\[product\]", "[product"), 1, ["small.toml: is not TOML", "line 1"], "toml"),
    Expect(product(r"\A", "name = 1\n"), 1, ["small.toml", "'name' stands outside"], "no-table"),
    Expect(product(r"\[product\]", "[produce]"), 1, ["'produce'", keys(ProductTables)], "table"),
    Expect(product("^name", "nmae"), 1, ["'product.nmae'", keys(ProductTable)], "key-product"),
    Expect(product("heights", "hights"), 1, ["'anomaly.hights_m'", keys(AnomalyTable)], "key"),
    Expect(
        anomaly("region = {latitude = [45.9, 46.1], longtude = [-121.6, -121.4]}"),
        1,
        ["small.toml", "'anomaly.region.longtude'", keys(RegionTable)],
        "key-region",
    ),
    Expect(product("^name.*", ""), 1, ["'product.name' is missing", "add product.name"], "no-name"),
    Expect(product('"small"', '"my map"'), 1, ["'product.name' is 'my map'", "lower case"], "name"),
    Expect(product("1.0.0", "1.0"), 1, ["'product.version' is '1.0'", "such as 1.0.0"], "version"),
    Expect(product('"1.0.0"', "1.0"), 1, ["'product.version' is 1.0", "string"], "version-float"),
    Expect(
        product(r"\[2500.0", "[nan"), 1, ["'anomaly.heights_m[0]' is nan", "a finite"], "height-nan"
    ),
    Expect(product("2500.0", "inf"), 1, ["'anomaly.heights_m[0]' is inf"], "height-inf"),
    Expect(product("2500.0", '"a"'), 1, ["'anomaly.heights_m[0]' is 'a'", "number"], "height-text"),
    Expect(product(r"\[2.*\]", "[]"), 1, ["heights_m' is []", "at least one"], "no-heights"),
    Expect(product(r"\[2.*\]", "2500"), 1, ["heights_m' is 2500; expected a list"], "height-only"),
    Expect(product("3500.0", "2500.0"), 1, ["heights_m", "each height once"], "height-twice"),
    Expect(product("3500.0", "1e9"), 1, ["heights_m", "metres, within"], "height-unit"),
    Expect(
        product("2500.0", "900.0"),
        1,
        [
            "small.toml anomaly",
            "heights_m holds 900, below the survey at 1500 m",
            "expected heights of 1500 m and more",
            "allow_downward_continuation = true",
        ],
        "below-survey",
    ),
    Expect(
        anomaly("region = {latitude = [5.0, 6.0], longitude = [-121.6, -121.4]}"),
        1,
        ["small.toml small-survey", "latitude 5 to 6", "has no data", "expected a region within"],
        "region-outside",
    ),
    Expect(
        anomaly("region = {latitude = [46.1, 45.9], longitude = [-121.6, -121.4]}"),
        1,
        ["'anomaly.region.latitude' is [46.1, 45.9]", "south, then north"],
        "latitude-swapped",
    ),
    Expect(
        anomaly("region = {latitude = [45.9, 96.0], longitude = [-121.6, -121.4]}"),
        1,
        ["'anomaly.region.latitude' is [45.9, 96.0]", "within -90 to 90"],
        "latitude-range",
    ),
    Expect(
        anomaly("region = {latitude = [45.9, 46.1], longitude = [-500.0, -121.4]}"),
        1,
        ["'anomaly.region.longitude' is [-500.0, -121.4]", "within -180 to 360"],
        "longitude-range",
    ),
    Expect(
        # West beyond east crosses the date line: all around the Earth but the survey.
        anomaly("region = {latitude = [45.9, 46.1], longitude = [-121.0, -122.0]}"),
        1,
        ["longitude -121 to -122 has no data"],
        "longitude-swapped",
    ),
    Expect(
        anomaly("region = {latitude = [45.9], longitude = [-121.6, -121.4]}"),
        1,
        ["'anomaly.region.latitude' is [45.9]", "another length (South and north limits.)"],
        "latitude-one",
    ),
    Expect(anomaly("region = 5"), 1, ["'anomaly.region' is 5; expected a table"], "region-number"),
    Expect(anomaly("spacing_m = 0"), 1, ["spacing_m' is 0; expected greater than 0"], "spacing"),
    Expect(anomaly("spacing_m = nan"), 1, ["spacing_m' is nan; expected a finite"], "spacing-nan"),
    Expect(
        anomaly("spacing_m = 0.5"),
        1,
        ["small.toml anomaly.spacing_m", "nodes 0.5 m apart", "raise spacing_m"],
        "spacing-unit",
    ),
    Expect(
        anomaly("tile_deg = 0.001"),
        1,
        ["small.toml anomaly.tile_deg", "expected more than 24 cells", "raise tile_deg"],
        "tile-tiny",
    ),
    Expect(
        anomaly("inclination_deg = 60"), 1, ["small.toml", "only one of", "give both"], "angle-one"
    ),
    Expect(anomaly("inclination_deg = 91"), 1, ["inclination_deg' is 91", "90"], "inclination"),
    Expect(anomaly("declination_deg = -inf"), 1, ["declination_deg' is -inf"], "declination"),
    Expect(product('"ellipsoid"', '"geoid"'), 1, ["'geoid'; expected 'ellipsoid', "], "reference"),
    Expect(
        product('"ellipsoid"', '"terrain"'),
        1,
        ["small.toml anomaly", "'terrain'; expected 'ellipsoid', which the source states"],
        "reference-contradicts",
    ),
    Expect(
        product("small-survey.toml", "other.toml"),
        1,
        ["small.toml anomaly.source", "'other.toml' does not exist"],
        "no-source",
    ),
    Expect(product("small-survey.toml", "x"), 1, ["the catalog has no source 'x'"], "no-entry"),
    Expect(store_is_a_file, 1, ["file/store", "is no folder", "choose another"], "store"),
]

_SOURCE = [
    Expect(source(r"\[grid\]", "[gird]"), 1, ["small-survey.toml: unknown table [gird]"], "table"),
    Expect(
        source("uncertainty_nt", "uncertainity_nt"),
        1,
        ["small-survey.toml [grid]", "'uncertainity_nt'", keys(IngestGridParams)],
        "key-grid",
    ),
    Expect(source("^id", "di"), 1, ["[source]: unknown key 'di'", keys(SourceParams)], "key"),
    Expect(source("^licence.*", ""), 1, ["'licence' is missing", "add licence"], "no-licence"),
    Expect(source("^height_m.*", ""), 1, ["'height_m' is missing", "add height_m"], "no-height"),
    Expect(source("anomaly-grid", "track"), 1, ["'kind' is 'track'; expected 'anomal"], "kind"),
    Expect(source("1500.0", "nan"), 1, ["'height_m' is nan; expected a finite"], "height-nan"),
    Expect(source("1500.0", "-inf"), 1, ["'height_m' is -inf"], "height-inf"),
    Expect(source("1990-01-01", "1990-02-30"), 1, ["'1990-02-30'", "an ISO date"], "no-date"),
    Expect(
        source("1990-01-01", "2090-01-01"),
        1,
        ["small.toml", "reference_epoch 2090-01-01", "expected 1900 to 2030"],
        "epoch",
    ),
    Expect(
        source(r"\[grid\]", '[grid]\ncrs = "EPSG:32611"'),
        1,
        ["small-survey.toml [grid]", "'EPSG:32611', but the file small-survey.tif says 'EPSG:326"],
        "crs-contradicts",
    ),
    Expect(
        source(r"\[grid\]", "[grid]\nno_data = -1.0"),
        1,
        ["'no_data' is -1.0, but the file small-survey.tif says -999999.0"],
        "no-data-contradicts",
    ),
    Expect(source(r"\[grid\]", '[grid]\ncrs = "utm"'), 1, ["'crs' is 'utm'", "EPSG code"], "crs"),
    Expect(
        source(r"\[grid\]", 'sha256 = {"small-survey.tif" = "00"}\n[grid]'),
        1,
        ["small-survey.tif: sha256 is", "expected 00"],
        "digest",
    ),
]

_STAGES = [
    Expect(ingest("height_m=nan"), 2, ["stage ingest-grid", "'height_m' is nan"], "nan"),
    Expect(ingest("height_m=99.0"), 1, ["small-survey.toml [grid]", "99.0", "once"], "contradicts"),
    Expect(ingest("hight_m=1.0"), 2, ["unknown key 'hight_m'", keys(IngestGridParams)], "key"),
    Expect(stage("upward-continue", "height_m=inf"), 2, ["'height_m' is inf; expected"], "inf"),
    Expect(stage("upward-continue"), 2, ["'height_m' is missing (Height gain"], "missing"),
    Expect(stage("upward-continue", "height_m=-5.0"), 2, ["'height_m' is -5.0"], "negative"),
    Expect(
        stage("crop-grid", "latitude=[nan, 46.1]", "longitude=[-122.0, -121.0]"),
        2,
        ["'latitude[0]' is nan"],
        "array-nan",
    ),
    Expect(
        stage("crop-grid", "latitude=[46.1, 45.9]", "longitude=[-122.0, -121.0]"),
        1,
        ["latitude = [46.1, 45.9]", "south < north"],
        "swapped",
    ),
    Expect(stage_on("fill-voids", "none.nc"), 1, ["none.nc (role grid)", "no such file"], "file"),
]

_VERSIONS = [
    Expect(
        product("3500.0", "4500.0"),
        1,
        ["small 1.0.0", "other content under the same version", 'set version = "1.1.0"'],
        "republish-level",
    ),
    Expect(
        source("1990-01-01", "1991-01-01"),
        1,
        ["small 1.0.0", "reference_epoch changed", "MAJOR bump", 'set version = "2.0.0"'],
        "republish-epoch",
    ),
    Expect(
        new_version("1.0.1", product("3500.0", "4500.0")),
        1,
        ["small 1.0.1", "1.1.0"],
        "bump-too-small",
    ),
]

_QUERIES = [
    Expect(
        query("--lat", "46", "46", "--lon", "1", "2", "3", "--height", "1"),
        2,
        ["--lat: 2 numbers; expected 1 or 3"],
        "shapes",
    ),
    Expect(
        query("--lat", "91", "--lon", "-121.5", "--height", "2000"),
        1,
        ["latitude[0]: is 91; expected degrees in [-90, 90]"],
        "latitude-91",
    ),
    Expect(
        query("--lat", "46", "--lon", "inf", "--height", "2000"),
        1,
        ["longitude[0]: is inf; expected finite degrees"],
        "longitude-inf",
    ),
    Expect(
        query("--lat", "46", "--lon", "-121.5", "--height", "20"),
        1,
        ["height[0]: is 20; expected at least 1500 m"],
        "below-survey",
    ),
    Expect(query("--lat", "46", "--lon", "-121.5"), 2, ["--height: no positions"], "no-height"),
    Expect(query("--lat", "north", "--lon", "1", "--height", "1"), 2, ["'north' is not a"], "word"),
    Expect(positions(""), 1, ["p.csv line 1: no column 'latitude'"], "csv-empty"),
    Expect(
        positions("latitude,longitude,height\n46,-121.5,high\n"),
        1,
        ["p.csv line 2: height is 'high'; expected a number"],
        "csv-word",
    ),
    Expect(query("--positions", "none.csv"), 1, ["none.csv: No such file"], "csv-missing"),
    Expect(command("query", "nowhere", *_NODE), 1, ["nowhere: is no release"], "no-release"),
    Expect(command("info", "nowhere"), 1, ["nowhere: is no release"], "no-release-info"),
    Expect(command("build", "a.toml"), 2, ["required: --store"], "no-store"),
]

_ALL = {
    "file": _FILES,
    "product": _PRODUCT,
    "source": _SOURCE,
    "stage": _STAGES,
    "version": _VERSIONS,
    "query": _QUERIES,
}


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize(
    "expect",
    [pytest.param(e, id=f"{kind}-{e.id}") for kind, table in _ALL.items() for e in table],
)
def test_one_clear_line_and_nothing_half_written(
    expect: Expect, site: Site, capsys: pytest.CaptureFixture[str]
) -> None:
    before = contents(site.store)
    argv = expect.change(site)
    assert main(argv) == expect.status
    streams = capsys.readouterr()
    errors = [line for line in streams.err.splitlines() if "error: " in line]
    assert len(errors) == 1, streams.err
    for word in expect.words:
        assert word in errors[0]
    assert "Traceback" not in streams.err
    assert streams.out == ""
    assert contents(site.store) == before
    assert not (site.folder / "out.nc").exists()
    # Temporary files and folders carry a leading dot.
    assert [p.name for p in site.folder.rglob(".*")] == []


def flip_a_bit(release: Path) -> Path:
    tile = next((release / "tiles").iterdir())
    content = bytearray(tile.read_bytes())
    content[len(content) // 2] ^= 1
    _replace(tile, bytes(content))
    return tile


def remove_a_tile(release: Path) -> Path:
    tile = next((release / "tiles").iterdir())
    _replace(tile, None)
    return tile


def add_a_file(release: Path) -> Path:
    _replace(release / "notes.txt", b"mine")
    return release / "notes.txt"


def edit_the_manifest(release: Path) -> Path:
    path = release / "manifest.json"
    _replace(path, path.read_bytes().replace(b"IGRF-14", b"IGRF-13"))
    return path


def _replace(path: Path, content: bytes | None) -> None:
    path.parent.chmod(0o755)
    path.unlink(missing_ok=True)
    if content is not None:
        path.write_bytes(content)


@pytest.mark.parametrize("command", [["validate"], ["info"], ["query", *_NODE]], ids=lambda c: c[0])
@pytest.mark.parametrize(
    ("damage", "word"),
    [
        pytest.param(flip_a_bit, "its content changed: sha256 is", id="flipped bit"),
        pytest.param(remove_a_tile, "is missing", id="missing tile"),
        pytest.param(add_a_file, "is a foreign file", id="foreign file"),
        pytest.param(edit_the_manifest, "its digest is not that of its contents", id="manifest"),
    ],
)
def test_every_command_refuses_a_damaged_release(
    damage: Callable[[Path], Path],
    word: str,
    command: list[str],
    site: Site,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = damage(site.release)
    assert main([command[0], str(site.release), *command[1:]]) == 1
    streams = capsys.readouterr()
    said = streams.out if command == ["validate"] else streams.err
    assert f"{path}: {word}" in said
    assert "Traceback" not in streams.err


def test_a_position_that_is_not_a_number_has_no_answer(
    pristine: Site, capsys: pytest.CaptureFixture[str]
) -> None:
    """NaN is a missing position, as filters have them: no error, and no number."""
    words = ["--lat", "46", "nan", "--lon", "-121.5", "--height", "2000", "--json"]
    assert main(["query", str(pristine.release), *words]) == 0
    whole, missing = json.loads(capsys.readouterr().out)
    assert whole["anomaly"] is not None
    assert missing["anomaly"] is None
    assert missing["flags"] == ["beyond_coverage"]


def test_rebuilding_the_same_changes_nothing(
    site: Site, capsys: pytest.CaptureFixture[str]
) -> None:
    before = contents(site.folder)
    assert main(site.build()) == 0
    assert "unchanged" in capsys.readouterr().out
    assert contents(site.folder) == before


def test_levels_below_the_survey_are_flagged_where_they_are_allowed(site: Site) -> None:
    text = site.product.read_text().replace("2500.0", "1300.0").replace('"1.0.0"', '"2.0.0"')
    site.product.write_text(text + "allow_downward_continuation = true\n")
    assert main(site.build()) == 0
    release = open_release(site.store / "small" / "2.0.0")
    assert release.manifest.heights_m == (1300.0, 1500.0, 3500.0)
    assert int(release.anomaly.flags(46.0, -121.5, 1400.0)) & 4
    assert not int(release.anomaly.flags(46.0, -121.5, 1600.0)) & 4
