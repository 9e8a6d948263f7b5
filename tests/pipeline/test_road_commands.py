"""Road maps of a release on the command line: validated, described, examined."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from road_maps import Pass, Road, road_map
from synthetic_release import World

from magtiles.catalog.releases.road_table import ROAD_VARIABLES
from magtiles.pipeline.artifacts import write_artifact
from magtiles.pipeline.main import main
from magtiles.pipeline.validate import validate_release
from magtiles.stages.release.road_file import write_road
from magtiles.stages.road.match import MatchRoadParams
from magtiles.stages.road.matchability import with_matchability

SHORT = Road("loop", 300.0, 40)


def publish(folder: Path, road: xr.Dataset) -> Path:
    write_road(road, folder / "loop.nc")
    world = World(heights=(0.0, 1000.0))
    return world.publish(folder / "s", extra_files={"roads/loop.nc": folder / "loop.nc"}).path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    road = with_matchability([road_map(SHORT)])[0]
    return publish(tmp_path_factory.mktemp("good"), road)


def test_a_good_road_is_valid(folder: Path) -> None:
    checks = {check.name: check for check in validate_release(folder)}
    roads = [check for name, check in checks.items() if name.startswith("road")]
    assert [c.name for c in roads] == [
        "road contracts", "road arrays", "road uncertainty", "road geometry",
    ]  # fmt: skip
    assert all(check.passed for check in checks.values())
    assert checks["road uncertainty"].measured == 266.0
    assert checks["road geometry"].measured < 1e-3


def test_a_stretched_road_is_not(tmp_path: Path) -> None:
    """Ten per cent further between positions than distance says."""
    road = road_map(SHORT)
    for name in ("latitude", "longitude"):
        road[name] = road[name][0] + 1.1 * (road[name] - road[name][0])
        road[name].attrs["units"] = "degrees_north" if name == "latitude" else "degrees_east"
    checks = {check.name: check for check in validate_release(publish(tmp_path, road))}
    assert not checks["road geometry"].passed
    assert checks["road geometry"].measured == pytest.approx(0.1, abs=1e-3)
    assert "road loop" in checks["road geometry"].where
    assert all(c.passed for n, c in checks.items() if n != "road geometry")


def test_a_damaged_road_is_not(tmp_path: Path) -> None:
    release = publish(tmp_path, road_map(SHORT))
    path = release / "roads/loop.nc"
    path.chmod(0o644)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    failed = {check.name for check in validate_release(release) if not check.passed}
    assert {"digests", "road contracts"} <= failed


def test_info_lists_roads(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(folder)]) == 0
    printed = capsys.readouterr().out
    line = next(line for line in printed.splitlines() if line.startswith("loop "))
    assert "300 every 1" in line
    assert "perfect" in line
    assert main(["info", str(folder), "--json"]) == 0
    (road,) = json.loads(capsys.readouterr().out)["roads"]
    assert (road["name"], road["length_m"], road["passes"]) == ("loop", 300.0, 1)
    assert 0.0 < road["matchability"] <= 1.0


def test_match_road_runs_on_files(tmp_path: Path) -> None:
    paths = []
    for number in (1, 2):
        paths.append(tmp_path / f"{number}.nc")
        write_artifact(road_map(SHORT, None, Pass(seed=number)), paths[-1], "road-map/1")
    out = tmp_path / "report.nc"
    command = ["run", "match-road", "--in", f"road={paths[0]}", "--in", f"section={paths[1]}"]
    assert main([*command, "--out", str(out), "--param", "section_m=[0.0, 9.0]"]) == 0
    with xr.open_dataset(out, engine="netcdf4") as report:
        ml = report["method"].values == "ml"
        within = report["percent_within"].values[ml & (report["form"].values == "measured")]
        assert (np.diff(within, axis=1) >= 0.0).all()
        assert within[1, 1] > within[0, 1] > 20.0


def test_a_pass_in_a_file_is_drawn(tmp_path: Path) -> None:
    path, out = tmp_path / "pass.nc", tmp_path / "pass.png"
    write_artifact(road_map(SHORT), path, "road-map/1")
    assert main(["plot", str(path), "--out", str(out)]) == 0
    assert out.read_bytes().startswith(b"\x89PNG")


def test_the_pages_have_every_variable_and_parameter() -> None:
    docs = Path(__file__).resolve().parents[2] / "docs"
    page = (docs / "format.md").read_text("utf-8")
    for name, rule in ROAD_VARIABLES.items():
        kinds = " or ".join("text" if d == "str" else d for d in rule.dtypes)
        dims = ", ".join(rule.dims)
        row = f"| `{name}` | ({dims}) | {kinds} | {rule.units or '-'} | {rule.long_name} |"
        assert row in page
    page = (docs / "matching.md").read_text("utf-8")
    for name, field in MatchRoadParams.model_fields.items():
        row = next(line for line in page.splitlines() if line.startswith(f"| `{name}` |"))
        assert f"`{json.dumps(field.default)}` | {field.description} |" in row
