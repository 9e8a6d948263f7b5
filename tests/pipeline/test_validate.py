"""validate, info and query on a release of exact dipoles, sound and damaged."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from magtiles.catalog.flags import QualityFlag
from magtiles.catalog.kernels.dipole import dipole_field_geodetic
from magtiles.catalog.releases.digest import canonical_json, manifest_digest
from magtiles.pipeline.commands.query import read_positions
from magtiles.pipeline.main import main
from magtiles.pipeline.overlaps import Overlaps
from magtiles.pipeline.validate import uncovered_cells, validate_release
from magtiles.schemas.errors import FormatError

Arrays = dict[str, NDArray[Any]]
Capture = pytest.CaptureFixture[str]


def failed(folder: Path) -> dict[str, str]:
    return {check.name: check.where for check in validate_release(folder) if not check.passed}


def test_exact_release_passes_every_check(exact_release: Path, capsys: Capture) -> None:
    assert main(["validate", str(exact_release), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["passed"] is True
    assert [check["name"] for check in report["checks"]] == [
        "manifest",
        "files",
        "digests",
        "self-contained",
        "units",
        "tile contracts",
        "array digests",
        "descriptions",
        "coverage",
        "overlaps",
        "uncertainty",
        "flags",
        "gradients at 500 m",
        "gradients at 1500 m",
        "f . vector at 500 m",
        "f . vector at 1500 m",
        "checks.json",
    ]
    measured = {check["name"]: check["measured"] for check in report["checks"]}
    # Float32 arrays, sources 2 km deep under nodes 0.55 km apart: 6.9e-5 and 1.5e-5 measured.
    assert measured["gradients at 500 m"] < 8e-5
    assert measured["gradients at 1500 m"] < 2e-5
    assert main(["validate", str(exact_release)]) == 0
    assert "17 checks passed" in capsys.readouterr().out


def flip_bit(folder: Path) -> None:
    path = folder / "tiles/0-1.nc"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def edit_manifest(folder: Path) -> None:
    path = folder / "manifest.json"
    path.write_text(path.read_text().replace("IGRF-13", "IGRF-14"))


@pytest.mark.parametrize(
    ("damage", "check", "place"),
    [
        pytest.param(flip_bit, "digests", "0-1.nc", id="flipped bit"),
        pytest.param(lambda f: (f / "tiles/1-0.nc").unlink(), "files", "1-0.nc", id="missing"),
        pytest.param(lambda f: (f / "x.txt").write_text(""), "files", "x.txt", id="foreign"),
        pytest.param(edit_manifest, "manifest", "manifest.json", id="edited manifest"),
        pytest.param(lambda f: (f / "manifest.json").unlink(), "manifest", "", id="no manifest"),
    ],
)
def test_damage_is_found_and_placed(
    release_copy: Path,
    damage: Callable[[Path], None],
    check: str,
    place: str,
    capsys: Capture,
) -> None:
    damage(release_copy)
    assert main(["validate", str(release_copy), "--json"]) == 1
    checks = {c["name"]: c for c in json.loads(capsys.readouterr().out)["checks"]}
    assert checks[check]["passed"] is False
    assert place in checks[check]["where"]


def test_stated_units_must_be_those_of_the_contract(release_copy: Path) -> None:
    path = release_copy / "manifest.json"
    document = json.loads(path.read_text())
    document["identity"]["units"]["gradient_nn"] = "nT m-1"
    document["manifest_digest"] = manifest_digest(document)
    path.write_bytes(canonical_json(document))
    assert failed(release_copy)["units"].startswith("gradient_nn in 'nT m-1'; expected 'nT km-1'")


def one_bit_in_the_halo(row: int, column: int, arrays: Arrays) -> None:
    if (row, column) == (1, 0):
        arrays["anomaly_east"].view(np.uint32)[1, 3, 20] ^= 1


def no_sigma(row: int, column: int, arrays: Arrays) -> None:
    if (row, column) == (1, 1):
        arrays["vector_uncertainty"][0, 30, 30] = 0.0


def unknown_bit(row: int, column: int, arrays: Arrays) -> None:
    if (row, column) == (1, 1):
        arrays["quality_flag"][0, 30, 30] = 32


def in_nanotesla_per_metre(row: int, column: int, arrays: Arrays) -> None:
    for name in arrays:
        if name.startswith("gradient"):
            arrays[name] /= 1000.0


def other_ambient(row: int, column: int, arrays: Arrays) -> None:
    """A declination of the wrong sign."""
    arrays["ambient_east"] *= -1.0


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        pytest.param(one_bit_in_the_halo, {"overlaps"}, id="overlap"),
        pytest.param(no_sigma, {"tile contracts", "uncertainty"}, id="uncertainty of zero"),
        pytest.param(unknown_bit, {"flags"}, id="unknown flag"),
        pytest.param(
            in_nanotesla_per_metre, {"gradients at 500 m", "gradients at 1500 m"}, id="unit"
        ),
        pytest.param(other_ambient, {"f . vector at 500 m", "f . vector at 1500 m"}, id="ambient"),
    ],
)
def test_wrong_content_with_right_digests_is_found(
    spoilt_release: Callable[[Any], Path], change: Any, expected: set[str]
) -> None:
    assert failed(spoilt_release(change)).keys() == expected


def test_place_of_an_overlap(spoilt_release: Callable[[Any], Path]) -> None:
    where = failed(spoilt_release(one_bit_in_the_halo))["overlaps"]
    assert where == "anomaly_east of tiles (0, 0) and (1, 0)"


@pytest.mark.parametrize(
    ("owners", "wrong"),
    [
        pytest.param([(range(0, 4), range(0, 6))], 0, id="one tile"),
        pytest.param([(range(0, 4), range(0, 3)), (range(0, 4), range(3, 6))], 0, id="two"),
        pytest.param([(range(0, 4), range(0, 3)), (range(0, 4), range(2, 6))], 4, id="twice"),
        pytest.param([(range(0, 4), range(0, 3)), (range(0, 4), range(4, 6))], 4, id="gap"),
        pytest.param([(range(0, 5), range(0, 6))], 6, id="outside"),
        pytest.param([], 24, id="none"),
    ],
)
def test_coverage_counts_cells(owners: list[tuple[range, range]], wrong: int) -> None:
    assert uncovered_cells(owners, rows=4, columns=6) == wrong


def test_overlaps_compare_every_neighbour_to_the_bit() -> None:
    """Tiles of 4 cells from one array with -0.0: a change in any one is seen by its neighbours."""
    whole = np.random.default_rng(1).normal(size=(2, 37, 37)).astype(np.float32)
    whole[0, 18, 18] = 0.0

    def differences(change: tuple[int, int] | None) -> int:
        overlaps = Overlaps()
        for row in range(3):
            for column in range(3):
                part = whole[:, 4 * row : 4 * row + 29, 4 * column : 4 * column + 29].copy()
                if (row, column) == change:
                    part[0, 18 - 4 * row, 18 - 4 * column] = -0.0
                overlaps.add(row, column, {"a": part, "latitude": part[0, 0]})
        return overlaps.different

    assert differences(None) == 0
    # The middle tile shares the node with all eight neighbours, a corner tile with three.
    assert differences((1, 1)) == 8
    assert differences((0, 0)) == 3


def test_query_answers_as_the_dipoles_do(exact_release: Path, capsys: Capture) -> None:
    from_truth = exact_at(44.47, -104.41, 500.0)
    argv = ["query", str(exact_release), "--lat", "44.47", "--lon", "-104.41", "--height", "500"]
    assert main([*argv, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert list(answer)[3:10] == [
        "north", "east", "down", "horizontal", "total", "declination", "inclination",
    ]  # fmt: skip
    assert set(list(answer.values())[3:10]) == {None}
    found = [answer[f"anomaly_{axis}"] for axis in ("north", "east", "down")]
    # On a row of nodes, between columns: 2.4e-4 nT off (26.8, 14.4, -15.3) nT measured.
    np.testing.assert_allclose(found, from_truth, atol=3e-4)
    assert answer["uncertainty"] == 2.0
    assert answer["flags"] == []
    assert main(argv) == 0
    assert f"{answer['anomaly']:.2f}" in capsys.readouterr().out


def exact_at(latitude: float, longitude: float, height: float) -> NDArray[np.float64]:
    from magtiles.catalog.kernels.dipole import geodetic_to_ecef

    rng = np.random.default_rng(20150701)
    places = rng.uniform([44.3, -104.6, -6000.0], [44.7, -104.2, -2000.0], (30, 3))
    moments = rng.normal(0.0, 3e10, (30, 3))
    vector, _ = dipole_field_geodetic(
        latitude, longitude, height, geodetic_to_ecef(*places.T), moments
    )
    return vector


def test_query_of_many_positions(
    exact_release: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    release = str(exact_release)

    def ask(*argv: str) -> list[float | None]:
        assert main(["query", release, *argv, "--json"]) == 0
        return [answer["anomaly"] for answer in json.loads(capsys.readouterr().out)]

    first = ask("--lat", "44.45,44.5", "--lon", "-104.45,-104.4", "--height", "700")
    assert None not in first
    assert ask("--lat", "44.45", "44.5", "--lon", "-104.45", "-104.4", "--height", "700") == first
    lines = "name,latitude,longitude,height\na,44.45,-104.45,700\nb,44.5,-104.4,700\n"
    (tmp_path / "p.csv").write_text(lines)
    assert ask("--positions", str(tmp_path / "p.csv")) == first
    monkeypatch.setattr("sys.stdin", io.StringIO(lines))
    assert ask("--positions", "-") == first
    assert ask("--lat", "44.45", "0", "--lon", "-104.45", "--height", "700") == [first[0], None]


@pytest.mark.parametrize(
    ("argv", "status", "expected"),
    [
        pytest.param(["--lat", "44"], 2, "--lon: no positions", id="no longitude"),
        pytest.param(
            ["--lat", "44", "45", "--lon", "1", "2", "3", "--height", "5"],
            2,
            "--lat: 2 numbers; expected 1 or 3",
            id="counts",
        ),
        pytest.param(["--lat", "north"], 2, "'north' is not a number", id="word"),
        pytest.param(["--lat", "1", "--positions", "p.csv"], 2, "--positions", id="both"),
        pytest.param(["--positions", "none.csv"], 1, "none.csv: No such file", id="no file"),
        pytest.param(
            ["--lat", "91", "--lon", "0", "--height", "600"], 1, "latitude", id="latitude 91"
        ),
        pytest.param(
            ["--lat", "44.45", "--lon", "-104.4", "--height", "100"], 1, "height", id="below"
        ),
    ],
)
def test_query_that_cannot_be_answered(
    exact_release: Path, argv: list[str], status: int, expected: str, capsys: Capture
) -> None:
    assert main(["query", str(exact_release), *argv]) == status
    assert expected in capsys.readouterr().err


def test_heights_above_an_unknown_terrain(terrain_release: Path, capsys: Capture) -> None:
    argv = ["query", str(terrain_release), "--lat", "44.45", "--lon", "-104.45", "--height", "700"]
    assert main(argv) == 2
    assert "count from terrain" in capsys.readouterr().err
    assert main([*argv, "--height-above-reference", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["anomaly"] is not None
    assert main(["info", str(terrain_release)]) == 0
    assert "--height-above-reference" in capsys.readouterr().out
    assert failed(terrain_release) == {}


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        pytest.param(["latitude,longitude"], "p.csv line 1: no column 'height'", id="header"),
        pytest.param([], "no column 'latitude'", id="empty"),
        pytest.param(["latitude,longitude,height"], "p.csv: no positions", id="no rows"),
        pytest.param(
            ["latitude,longitude,height", "1,2,3", "1,x,3"], "p.csv line 3: longitude is 'x'",
            id="word",
        ),
        pytest.param(
            ["latitude,longitude,height", "1,2"], "line 2: height is None", id="short row"
        ),
    ],
)  # fmt: skip
def test_positions_that_are_none(lines: list[str], expected: str) -> None:
    with pytest.raises(FormatError) as caught:
        read_positions(lines, "p.csv")
    assert expected in str(caught.value)


def test_positions_that_are_no_text(tmp_path: Path, exact_release: Path, capsys: Capture) -> None:
    (tmp_path / "p.csv").write_bytes(b"latitude,longitude,height\n\xff\xfe1,2,3\n")
    assert main(["query", str(exact_release), "--positions", str(tmp_path / "p.csv")]) == 1
    assert "p.csv: is no CSV text" in capsys.readouterr().err


def test_info_counts_nodes_over_all_tiles(exact_release: Path, capsys: Capture) -> None:
    assert main(["info", str(exact_release), "--json"]) == 0
    about = json.loads(capsys.readouterr().out)
    assert (about["product"], about["version"]) == ("exact", "1.2.3")
    assert about["coverage"]["latitude"] == pytest.approx([44.4, 44.58])
    assert about["coverage"]["longitude"] == pytest.approx([-104.5, -104.304])
    assert about["heights_m"] == [500.0, 1500.0]
    assert about["uncertainty"]["vector_uncertainty"] == [[3.0, 3.0], [3.0, 3.0]]
    files = [f for f in exact_release.rglob("*") if f.is_file() and f.name != "manifest.json"]
    assert about["sizes"]["total"] == sum(f.stat().st_size for f in files)
    assert about["flag_fractions"]["poorly_levelled"] == 0.0
    assert 0.02 < about["flag_fractions"][QualityFlag.BEYOND_COVERAGE.name.lower()] < 0.05
    assert main(["info", str(exact_release)]) == 0
    text = capsys.readouterr().out
    for part in (
        "exact 1.2.3",
        "IGRF-13 at 2015-07-01",
        "CC0-1.0",
        "magtiles query",
        "void_filled",
    ):
        assert part in text


def test_commands_on_what_is_no_release(tmp_path: Path, capsys: Capture) -> None:
    for argv in (["info"], ["query", "--lat", "1", "--lon", "1", "--height", "1"], ["validate"]):
        assert main([argv[0], str(tmp_path), *argv[1:]]) == 1
        streams = capsys.readouterr()
        assert "manifest.json" in streams.err + streams.out
