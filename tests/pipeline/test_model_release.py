"""A release of a field model, from its product TOML to the reader's answers, against the model.

Independent truth of the model's own sums is in test_model_components; here it is what a release
adds: tiles, interpolation, seams, the core field at other dates, and refusing bad products.
"""

from __future__ import annotations

import json
import logging
import re
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from direct_sum import direct_field, split_gauss, total_anomaly

from magtiles.catalog import open_release
from magtiles.catalog.models import FieldModel, evaluate, load_igrf, read_model
from magtiles.pipeline.build import build_product
from magtiles.pipeline.main import main
from magtiles.pipeline.sample_model import WorldSpec, world_model, write_world
from magtiles.pipeline.validate import validate_release
from magtiles.schemas.errors import MagtilesError
from magtiles.stages.ingest.field_model import FIELD_MODEL
from magtiles.stages.ingest.source import load_source

SPEC = WorldSpec(degree=72)
COARSE = WorldSpec(name="coarse", degree=24, heights_m=(0.0, 20e3))
EPOCH = "2025-01-01"
PACIFIC = "region = {latitude = [-20, 20], longitude = [165, -165]}\n"
TROPICS = "region = {latitude = [-40, 40], longitude = [-180, 180]}\ntile_deg = 90\n"


def build(folder: Path, spec: WorldSpec, more: str) -> Path:
    product = write_world(folder / "in", spec)[-1]
    product.write_text(product.read_text() + more)
    return build_product(product, store=folder / "store", work=folder / "work").path


@pytest.fixture(scope="module")
def pacific(tmp_path_factory) -> Path:
    """Degree 72 on both sides of the date line."""
    return build(tmp_path_factory.mktemp("pacific"), SPEC, PACIFIC)


@pytest.fixture(scope="module")
def tropics(tmp_path_factory) -> Path:
    """Degree 24 all around, in four tiles."""
    return build(tmp_path_factory.mktemp("tropics"), COARSE, TROPICS)


@dataclass(frozen=True)
class Truth:
    core: FieldModel
    crust: FieldModel
    latitude: np.ndarray
    longitude: np.ndarray
    height: np.ndarray

    def total(self) -> np.ndarray:
        place = self.latitude, self.longitude, self.height, EPOCH
        return total_anomaly(evaluate(self.core, *place), evaluate(self.crust, *place))

    def total_gradient(self) -> np.ndarray:
        """Of |C + K| - |C|: exact, with both tensors."""
        place = self.latitude, self.longitude, self.height, EPOCH
        core, of_core = evaluate(self.core, *place, gradient=True)
        crust, of_crust = evaluate(self.crust, *place, gradient=True)
        with_crust, alone = (
            np.einsum("ni,nij->nj", v / np.linalg.norm(v, axis=-1, keepdims=True), slope)
            for v, slope in ((core + crust, of_core + of_crust), (core, of_core))
        )
        return with_crust - alone

    @property
    def place(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.latitude, self.longitude, self.height


@pytest.fixture(scope="module")
def truth() -> Truth:
    model = world_model(SPEC)
    rng = np.random.default_rng(11)
    n = 2000
    longitude = (rng.uniform(165.0, 195.0, n) + 180.0) % 360.0 - 180.0
    return Truth(
        model.degrees(1, 15),
        model.degrees(16, 72),
        rng.uniform(-20.0, 20.0, n),
        longitude,
        rng.uniform(0.0, 15e3, n),
    )


@pytest.mark.parametrize("name", ["pacific", "tropics"])
def test_release_is_valid(name, request):
    failed = [c for c in validate_release(request.getfixturevalue(name)) if not c.passed]
    assert failed == []


def test_total_off_the_nodes(pacific, truth):
    """Eight nodes on the shortest wave, levels 5 and 10 km apart, total of 18 nT rms.

    Largest error 0.0097 nT measured, 0.0027 rms.
    """
    anomaly = open_release(pacific).anomaly
    error = anomaly.total(*truth.place) - truth.total()
    assert np.abs(error).max() < 0.015
    assert np.sqrt(np.mean(error**2)) < 0.004


def test_vector_and_tensor_off_the_nodes(pacific, truth):
    anomaly = open_release(pacific).anomaly
    vector, tensor = evaluate(truth.crust, *truth.place, EPOCH, gradient=True)
    # Of 19 nT and 0.11 nT/km rms; 0.020 nT and 2.2e-4 nT/km measured.
    assert np.abs(anomaly.vector(*truth.place) - vector).max() < 0.03
    five = np.stack([tensor[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2))], -1)
    assert np.abs(anomaly.tensor(*truth.place) - five).max() < 4e-4


def test_gradient_of_the_total_between_levels(pacific, truth):
    """The reader lets f . G stand for the vertical derivative at the levels, f of the core.

    Exactly it is b . G + (b - f) . G_core with b along core + crust. Their difference is below
    the crust across the core times what the core turns by, 2e-4 rad/km; it does not touch the
    horizontal gradients.
    """
    _, found = open_release(pacific).anomaly.total_with_gradient(*truth.place)
    error = np.abs(found - truth.total_gradient())
    crust = np.linalg.norm(evaluate(truth.crust, *truth.place, EPOCH), axis=-1)
    assert error[:, :2].max() < 6e-4  # of 0.09 nT/km rms; 4.1e-4 measured
    assert error[:, 2].max() < 2.2e-4 * crust.max()  # 0.0028 measured of 0.0156
    assert np.sqrt(np.mean(error[:, 2] ** 2)) < 8e-4  # of 0.13 nT/km rms; 5.5e-4 measured


def test_date_line_has_no_seam(pacific, tropics):
    latitude, height = np.linspace(-19.0, 19.0, 60), np.linspace(0.0, 15e3, 60)
    for path in (pacific, tropics):
        anomaly = open_release(path).anomaly
        west, east = (anomaly.vector(latitude, lon, height) for lon in (180.0, -180.0))
        np.testing.assert_array_equal(west, east)
        west, east = (anomaly.vector(latitude, lon, height) for lon in (179.999, -179.999))
        model = world_model(SPEC if path == pacific else COARSE).degrees(16, 72)
        exact = [evaluate(model, latitude, lon, height, EPOCH) for lon in (179.999, -179.999)]
        # Over 222 m the field changes by some 0.02 nT; the two sides err alike.
        np.testing.assert_allclose(east - west, exact[1] - exact[0], rtol=0, atol=2e-4)


def test_whole_field_at_the_epoch_is_the_whole_model(pacific, truth):
    """All degrees of the file, summed by another code at places off the nodes."""
    anomaly = open_release(pacific).anomaly
    gauss = world_model(SPEC).at(EPOCH)
    place = truth.latitude[:12], truth.longitude[:12], np.full(12, 5000.0)
    core, crust = (direct_field(part, *place) for part in split_gauss(gauss, 15))
    expected = np.linalg.norm(core + crust, axis=-1)
    assert np.abs(anomaly.expected_total_field(*place, EPOCH) - expected).max() < 0.015
    assert np.abs(anomaly.expected_vector(*place, EPOCH) - core - crust).max() < 0.03


@pytest.mark.parametrize(("date", "rms", "largest"), [(2026.0, 0.01, 0.04), (2030.0, 0.05, 0.2)])
def test_whole_field_at_other_dates(pacific, truth, date, rms, largest):
    """The core at its date; what the anomaly changes by as the core turns is left out.

    Measured: 0.007 nT rms and 0.025 at most after one year, 0.032 and 0.12 after five; over the
    whole globe 0.04 and 0.34, 0.19 and 1.7.
    """
    found = open_release(pacific).anomaly.expected_total_field(*truth.place, date)
    exact = np.linalg.norm(evaluate(world_model(SPEC), *truth.place, date), axis=-1)
    error = found - exact
    assert 5e-3 < np.sqrt(np.mean(error**2)) < rms
    assert np.abs(error).max() < largest


def test_the_releases_own_core_field(pacific):
    core = read_model(pacific / "core_field.shc")
    model = world_model(SPEC).degrees(1, 15)
    assert core.valid == (2025.0, 2030.0)
    for date in (2025.0, 2027.3, 2030.0):
        np.testing.assert_allclose(core.at(date), model.at(date), rtol=0, atol=1e-9)


def test_manifest_says_what_it_is(pacific):
    manifest = open_release(pacific).manifest
    assert manifest.identity["reference_field"] == "WORLD-72 to degree 15"
    assert manifest.identity["reference_epoch"] == EPOCH
    assert "crust WORLD-72 of degrees 16 to 72" in manifest.identity["anomaly_definition"]
    assert [(i.id, i.role) for i in manifest.inputs] == [("world-model", "field model")]
    provenance = json.loads((pacific / "provenance.json").read_text())
    made = provenance["predicate"]["runDetails"]["byproducts"]
    assert {step["annotations"]["stage"] for step in made} == {"derive-components"}


def test_commands_take_such_a_release(tropics, tmp_path, capsys):
    assert main(["info", str(tropics), "--json"]) == 0
    coverage = json.loads(capsys.readouterr().out)["coverage"]
    assert coverage["longitude"] == [-180.0, 180.0]
    picture = tmp_path / "map.png"
    assert main(["plot", str(tropics), "--out", str(picture)]) == 0
    assert picture.stat().st_size > 10_000
    place = ["--lat", "10", "--lon", "-179.5", "--height", "0", "--date", "2025-01-01"]
    capsys.readouterr()
    assert main(["query", str(tropics), *place, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    answer = answer[0] if isinstance(answer, list) else answer
    model = str(tropics.parents[2] / "in/coarse.COF")
    assert main(["query", "--model", model, *place, "--json"]) == 0
    whole = json.loads(capsys.readouterr().out)
    whole = whole[0] if isinstance(whole, list) else whole
    assert answer["total"] == pytest.approx(whole["total"], abs=0.05)
    assert answer["flags"] in ([], 0, "", "-")


def test_sample_files_are_the_same_every_time(tmp_path):
    one, two = (write_world(tmp_path / name, SPEC) for name in "ab")
    assert [p.read_bytes() for p in one] == [p.read_bytes() for p in two]
    assert [p.name for p in one] == ["world.COF", "world-model.toml", "world.toml"]
    read, made = read_model(one[0]), world_model(SPEC)
    assert (read.n_min, read.n_max, read.valid) == (1, 72, (2025.0, 2030.0))
    np.testing.assert_array_equal(read.coefficients, made.coefficients)
    np.testing.assert_array_equal(read.secular_variation, made.secular_variation)


def test_the_sample_command_writes_a_world(tmp_path, capsys):
    assert main(["sample", str(tmp_path)]) == 0
    written = capsys.readouterr().out.split()
    names = ["world.COF", "world-model.toml", "world.toml"]
    assert set(names) <= {Path(path).name for path in written}


def test_a_folder_without_coefficients(site, capsys):
    (site / "empty").mkdir()
    said = message(site, capsys, '"coarse-model.toml"', '"empty"')
    assert "empty: holds no coefficient files" in said


@pytest.fixture
def site(tmp_path) -> Path:
    """A folder with the sample model's files, to be spoilt."""
    write_world(tmp_path, COARSE)
    return tmp_path


def message(site: Path, capsys, old: str, new: str, *, file: str = "coarse.toml") -> str:
    """What `magtiles build` says of the product (or other file) with one text changed."""
    path = site / file
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    store = site / "store"
    words = ["build", str(site / "coarse.toml"), "--store", str(store), "--work", str(site / "w")]
    assert main(words) == 1
    assert not list(store.glob("*/*.*.*"))
    said = capsys.readouterr().err
    assert "Traceback" not in said
    return said


_HEIGHTS = "heights_m = [0.0, 20000.0]"


@pytest.mark.parametrize(
    ("new", "said"),
    [
        (_HEIGHTS + '\n[anomaly]\nsource = "x"\nheights_m = [0]\nheight_reference = "terrain"',
         r"both \[anomaly\] and \[model\].*make two products"),
        ("heights_m = [-20000.0]", r"'model\.heights_m'.*-12000"),
        ("heights_m = [0.0, 0.5]", r"model\.heights_m.*too close"),
        (_HEIGHTS + "\nspacing_m = 900000", r"model\.spacing_m.*degree 24.*Nyquist"),
        (_HEIGHTS + "\nregion = {latitude = [60, 89], longitude = [0, 90]}", r"beyond 85.*region"),
        (_HEIGHTS + "\nspacing_m = 100000", r"reach over a pole.*lower spacing_m"),
        (_HEIGHTS + "\nspacing_m = 40000\ntile_deg = 50", "divide the circle"),
        (_HEIGHTS + "\ncore_degree = 13", "degrees 14 to 15 would be lost"),
        (_HEIGHTS + "\ncrust_degree = 15", "degrees 15 to 15 would be counted twice"),
        (_HEIGHTS + "\nhighest_degree = 30", "no degrees 16 to 30"),
        (_HEIGHTS + '\ncore = "IGRF-99"', r"model\.core.*IGRF-14"),
        (_HEIGHTS + "\ncrust = 16", "crust"),
        (_HEIGHTS + "\nuncertainty_nt = 0.0", "uncertainty_nt"),
    ],
)  # fmt: skip
def test_bad_products(site, capsys, new, said):
    found = message(site, capsys, _HEIGHTS, new)
    assert re.search(said, found, re.S), found
    assert "coarse.toml" in found


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("epoch = 2025-01-01", "epoch = 2031-01-01", r"outside the validity.*2025 to 2030"),
        ("[model]", "[anomaly]", "coefficients"),
        ('"coarse-model.toml"', '"elsewhere.toml"', r"model\.coefficients.*elsewhere\.toml"),
        ('"coarse-model.toml"', '"no-such-id"', "catalog has no source 'no-such-id'"),
        (
            '"coarse-model.toml"',
            '"lost.COF"',
            r"coefficient file 'lost\.COF' does not exist.*--from",
        ),
        ('"coarse-model.toml"', '"coarse.COF"', r"error of COARSE-24 is not stated"),
    ],
)
def test_bad_product_keys(site, capsys, old, new, said):
    found = message(site, capsys, old, new)
    assert re.search(said, found, re.S), found


def test_neither_map_nor_model(site, capsys):
    text = (site / "coarse.toml").read_text()
    said = message(site, capsys, text[text.index("[model]") :], "")
    assert "neither [anomaly] nor [model]" in said


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('kind = "field-model"', 'kind = "anomaly-grid"', "'field-model'"),
        ("coarse.COF", "lost.COF", r"1 of the 1 coefficient files.*lost\.COF.*--from"),
        ("uncertainty_nt = 2.0", "sigma = 2.0", "unknown key 'sigma'"),
        ("uncertainty_nt = 2.0", "", "error of COARSE-24 is not stated"),
    ],
)
def test_bad_sources(site, capsys, old, new, said):
    found = message(site, capsys, old, new, file="coarse-model.toml")
    assert re.search(said, found, re.S), found


def test_truncated_coefficients_name_the_line(site, capsys):
    lines = (site / "coarse.COF").read_text().splitlines(keepends=True)
    (site / "coarse.COF").write_text("".join(lines[:200]))
    assert re.search(r"coarse\.COF.*200", message(site, capsys, "", ""))


def test_a_coarse_spacing_is_warned_of(tmp_path, caplog):
    """Degree 40 has waves of 990 km."""
    region = "region = {latitude = [-10, 10], longitude = [0, 180]}\n"
    with caplog.at_level(logging.WARNING):
        build(tmp_path, WorldSpec(degree=40), "spacing_m = 300000\ntile_deg = 90\n" + region)
    assert "less than four nodes" in caplog.text


def test_local_copies_by_from(site, tmp_path):
    data = tmp_path / "data"
    data.mkdir()
    shutil.move(site / "coarse.COF", data)
    product = site / "coarse.toml"
    product.write_text(product.read_text() + TROPICS)
    with pytest.raises(MagtilesError, match="--from"):
        build_product(product, store=site / "s", work=site / "w")
    assert build_product(product, store=site / "s", work=site / "w", data=data).changed


def test_the_catalogs_emm_asks_for_its_files(tmp_path, capsys):
    folder = Path(__file__).resolve().parents[2] / "catalog"
    source = load_source(folder / "sources/emm2017.toml", FIELD_MODEL)
    assert len(source.source.files) == 19
    words = ["build", str(folder / "products/emm.toml"), "--store", str(tmp_path / "s")]
    assert main([*words, "--work", str(tmp_path / "w"), "--from", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert re.search(r"19 of the 19 coefficient files of 'emm2017'.*fetch them from http", said)


def test_an_emm_set_is_a_model_like_any_other(tmp_path):
    """The catalog's own TOMLs on a small stand-in for the set, laid out as NOAA's."""
    catalog = Path(__file__).resolve().parents[2] / "catalog"
    shutil.copytree(catalog / "products", tmp_path / "products")
    product = tmp_path / "products/emm.toml"
    product.write_text(
        re.sub(r"(?m)^(spacing_m|tile_deg|region).*\n", "", product.read_text())
        + "region = {latitude = [-10, 10], longitude = [170, -170]}\n"
    )
    _write_small_emm(tmp_path / "data")
    store, work = tmp_path / "s", tmp_path / "w"
    release = open_release(
        build_product(product, store=store, work=work, data=tmp_path / "data").path
    )
    assert release.manifest.identity["reference_field"] == "EMM2017 to degree 15"
    model = read_model(tmp_path / "data")
    place = np.array([3.0, -7.0]), np.array([-179.9, 175.0]), np.array([5000.0, 5000.0])
    found = release.anomaly.expected_total_field(*place, "2020-01-01")
    exact = np.linalg.norm(evaluate(model, *place, "2020-01-01"), axis=-1)
    np.testing.assert_allclose(found, exact, rtol=0, atol=0.02)


def _write_small_emm(folder: Path) -> None:
    """Yearly files of the IGRF's degrees to 13, and a full one, with a crust to degree 36."""
    from gauss import cof_rows

    folder.mkdir()
    spec = WorldSpec(epoch=2020.0, degree=36)
    full = world_model(spec)
    gauss = full.coefficients[0]
    for year in range(2000, 2018):
        degrees = 36 if year == 2017 else 15
        rows = cof_rows(gauss[: degrees * (degrees + 2)])
        (folder / f"EMM{year}.COF").write_text("\n".join([f"  {year}.0  EMM-{year}", *rows]) + "\n")
    rows = cof_rows(np.zeros(15 * 17))
    (folder / "EMM2017SV.COF").write_text("\n".join(rows) + "\n")


def test_lcs1_with_the_igrfs_core(real_data, tmp_path, caplog):
    """A real crust, of degrees 16 to 185, in the South Atlantic; its core is another model's."""
    shutil.copy(real_data / "harmonics/LCS-1.shc", tmp_path)
    product = tmp_path / "lcs1.toml"
    product.write_text(
        '[product]\nname = "lcs1"\nversion = "1.0.0"\n[model]\ncoefficients = "LCS-1.shc"\n'
        'core = "IGRF-14"\nepoch = 2020-01-01\nheights_m = [0, 5000, 15000]\nuncertainty_nt = 10\n'
        "region = {latitude = [-36, -24], longitude = [10, 26]}\n"
    )
    with caplog.at_level(logging.WARNING):
        path = build_product(product, store=tmp_path / "s", work=tmp_path / "w").path
    assert "degrees 14 to 15 are neither" in caplog.text
    assert [check for check in validate_release(path) if not check.passed] == []
    release = open_release(path)
    assert {i.role for i in release.manifest.inputs} == {"field model", "core field"}
    rng = np.random.default_rng(3)
    place = rng.uniform((-36, 10, 0), (-24, 26, 15e3), (800, 3)).T
    lcs, igrf = read_model(real_data / "harmonics/LCS-1.shc").degrees(16, 185), load_igrf()
    crust, core = evaluate(lcs, *place, "2020-01-01"), evaluate(igrf, *place, "2020-01-01")
    # Of 43 nT rms; 0.031 nT in the total and 0.026 nT in the vector measured.
    error = release.anomaly.total(*place) - total_anomaly(core, crust)
    assert np.abs(error).max() < 0.05
    expected = release.anomaly.expected_vector(*place, "2020-01-01")
    assert np.abs(expected - core - crust).max() < 0.1
