"""run_stage: contracts on both sides, receipts that say why, nothing half written."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import xarray as xr

from magtiles.pipeline import receipts, runner
from magtiles.pipeline.artifacts import open_artifact, write_artifact
from magtiles.pipeline.runner import run_stage
from magtiles.schemas import contracts
from magtiles.schemas.errors import (
    ContractError,
    FormatError,
    MagtilesError,
    ParameterError,
    UsageError,
)
from magtiles.stages.declare import FILES, Many, OptionalInput, Params, Stage, quantity

GRID = "anomaly-grid/1"


def grid(rows: int = 5, columns: int = 7) -> xr.Dataset:
    """A small valid anomaly grid with a void, flags and every kind of attribute."""
    values = np.arange(rows * columns, dtype=np.float32).reshape(rows, columns)
    values[1, 2] = np.nan
    flags = np.zeros((rows, columns), dtype=np.uint8)
    flags[0, 0] = 200
    dims = ("y", "x")
    return xr.Dataset(
        {
            "magnetic_anomaly": (dims, values, {"units": "nT", "grid_mapping": "crs"}),
            "quality_flag": (dims, flags, {"flag_masks": [1], "flag_meanings": "void_filled"}),
            "height": ((), 150.0, {"units": "m", "positive": "up"}),
            "crs": ((), np.int32(0), pyproj.CRS(32613).to_cf()),
        },
        coords={
            "y": ("y", 1000.0 * np.arange(rows), {"units": "m"}),
            "x": ("x", 1000.0 * np.arange(columns), {"units": "m"}),
        },
        attrs={
            "reference_field": "IGRF-13",
            "reference_epoch": "2015-01-01",
            "anomaly_definition": "total field minus reference",
            "height_reference": "ellipsoid",
            "source": "test",
            "wavelength_band_km": [1.0, 300.0],
        },
    )


class ScaleParams(Params):
    factor: float = quantity("1", gt=0, doc="What to multiply by.")
    bands: tuple[float, ...] = quantity("km", default=(), doc="Not used; a tuple.")


CALLS: list[str] = []


def scale(grid: xr.Dataset, *, params: ScaleParams) -> xr.Dataset:
    CALLS.append("scale")
    result = grid.copy()
    result["magnetic_anomaly"] = grid["magnetic_anomaly"].copy(
        data=grid["magnetic_anomaly"].values * np.float32(params.factor)
    )
    return result


SCALE = Stage("scale", 1, ScaleParams, {"grid": GRID}, GRID, scale)


class NoParams(Params):
    pass


def first(grids: list[xr.Dataset], *, params: NoParams) -> xr.Dataset:
    return grids[0].copy()


FIRST = Stage("first", 1, NoParams, {"grids": Many(GRID)}, GRID, first)


def both(grid: xr.Dataset, other: xr.Dataset | None = None, *, params: NoParams) -> xr.Dataset:
    return grid.copy() if other is None else other.copy()


BOTH = Stage("both", 1, NoParams, {"grid": GRID, "other": OptionalInput(GRID)}, GRID, both)


@pytest.fixture
def source(tmp_path: Path) -> Path:
    write_artifact(grid(), tmp_path / "grid.nc", GRID)
    return tmp_path / "grid.nc"


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_artifact_survives_the_disk_unchanged(source: Path) -> None:
    with open_artifact(source) as back:
        contracts.check(back, GRID)
        assert back.attrs["contract"] == "anomaly-grid/1.0.0"
        assert {k: v.dtype for k, v in back.variables.items()} == {
            k: v.dtype for k, v in grid().variables.items()
        }
        xr.testing.assert_identical(
            back.drop_attrs(), grid().drop_attrs()
        )  # values, NaN and coordinates, to the bit
        assert back["quality_flag"].attrs["flag_masks"].tolist() == [1]
        assert back["crs"].attrs["crs_wkt"] == pyproj.CRS(32613).to_wkt()


def test_an_optional_dataset_is_passed_only_where_it_is_given(source: Path, tmp_path: Path) -> None:
    twice = tmp_path / "twice.nc"
    run_stage(SCALE, {"grid": source}, twice, {"factor": 2.0})
    for given, same in ({}, source), ({"other": twice}, twice):
        result = run_stage(BOTH, {"grid": source, **given}, tmp_path / "both.nc", {})
        assert result.rebuilt
        with open_artifact(result.out) as made, open_artifact(same) as expected:
            xr.testing.assert_equal(made, expected)
    with pytest.raises(UsageError, match="2 files for role 'other'; expected one"):
        run_stage(BOTH, {"grid": source, "other": [twice, twice]}, tmp_path / "x.nc", {})


def test_stage_runs_once_and_says_why_again(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.nc"
    CALLS.clear()

    def go(factor: float = 2.0, stage: Stage = SCALE, force: bool = False) -> tuple[bool, str]:
        result = run_stage(stage, {"grid": source}, out, {"factor": factor}, force=force)
        assert result.out == out
        return result.rebuilt, result.reason

    assert go() == (True, "output missing")
    assert go() == (False, "up to date")
    assert go(3.0) == (True, "params.factor changed from 2.0 to 3.0")
    assert go(3.0, force=True) == (True, "forced")
    assert go(3.0, replace(SCALE, version=2)) == (True, "version changed from 1 to 2")
    assert go(3.0, replace(SCALE, version=2)) == (False, "up to date")
    write_artifact(grid(6, 7), source, GRID)
    assert go(2.0) == (
        True,
        "version changed from 2 to 1; params.factor changed from 3.0 to 2.0; input grid changed",
    )
    assert len(CALLS) == 5
    with open_artifact(out) as made:
        np.testing.assert_array_equal(
            made["magnetic_anomaly"], 2.0 * grid(6, 7)["magnetic_anomaly"]
        )


def test_receipt_notices_a_changed_output_a_lost_receipt_new_code_and_packages(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out.nc"

    def reason() -> str:
        return run_stage(SCALE, {"grid": source}, out, {"factor": 2.0}).reason

    reason()
    made = out.read_bytes()
    out.write_bytes(made[:-1] + bytes([made[-1] ^ 1]))
    assert reason() == "output changed on disk"
    assert out.read_bytes() == made
    out.touch()  # a new time of change alone rebuilds nothing
    assert reason() == "up to date"
    receipts.receipt_path(out).unlink()
    assert reason() == "receipt missing or unreadable"
    receipts.receipt_path(out).write_text('{"output": {"sha256": ""}, "params": []}')
    assert reason() == "receipt missing or unreadable"
    monkeypatch.setattr(receipts, "code_digest", lambda: "other")
    assert reason() == "code changed"
    monkeypatch.setattr(receipts, "package_versions", lambda: {"numpy": "0.1"})
    assert "packages.numpy changed from" in reason()


def test_same_bytes_and_identity_in_two_folders(tmp_path: Path) -> None:
    found = []
    for name in ("a", "b/c"):
        folder = tmp_path / name
        write_artifact(grid(), folder / "grid.nc", GRID)
        run_stage(SCALE, {"grid": folder / "grid.nc"}, folder / "out.nc", {"factor": 2.0})
        receipt = json.loads(receipts.receipt_path(folder / "out.nc").read_text())
        assert str(tmp_path) not in json.dumps(receipt)
        assert receipt["output"].pop("mtime_ns") == (folder / "out.nc").stat().st_mtime_ns
        found.append((sha256(folder / "out.nc"), receipt))
    assert found[0] == found[1]


def test_digest_comes_from_the_receipt_without_reading(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out.nc"
    run_stage(SCALE, {"grid": source}, out, {"factor": 2.0})
    truth = sha256(out)
    monkeypatch.setattr(receipts, "_sha256_once", None)  # reading would now fail
    assert receipts.digest(out) == truth


def test_many_and_files_are_passed_as_lists(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.nc"
    run_stage(FIRST, {"grids": [source, source]}, out, {})
    assert [i["name"] for i in receipts.read_receipt(out)["inputs"]["grids"]] == ["grid.nc"] * 2  # type: ignore[index]
    seen: list[Path] = []

    def ingest(files: list[Path], *, params: NoParams) -> xr.Dataset:
        seen.extend(files)
        return grid()

    stage = Stage("ingest", 1, NoParams, {"files": FILES}, GRID, ingest)
    (tmp_path / "a.tif").write_bytes(b"1")
    assert run_stage(stage, {"files": [tmp_path / "a.tif"]}, out, {}).rebuilt
    assert seen == [tmp_path / "a.tif"]
    (tmp_path / "a.tif").write_bytes(b"2")
    assert run_stage(stage, {"files": tmp_path / "a.tif"}, out, {}).reason == "input files changed"


def break_units(dataset: xr.Dataset) -> xr.Dataset:
    dataset["magnetic_anomaly"].attrs["units"] = "T"
    return dataset


def test_breach_names_role_file_and_variable(tmp_path: Path) -> None:
    write_artifact(break_units(grid()), tmp_path / "bad.nc", GRID)
    with pytest.raises(ContractError) as caught:
        run_stage(SCALE, {"grid": tmp_path / "bad.nc"}, tmp_path / "out.nc", {"factor": 2.0})
    for part in ("bad.nc (role grid)", "magnetic_anomaly.units", "'T'", "'nT'"):
        assert part in str(caught.value)
    assert not (tmp_path / "out.nc").exists()


def test_output_that_breaks_its_contract_is_not_written(source: Path, tmp_path: Path) -> None:
    stage = replace(SCALE, run=lambda grid, *, params: break_units(grid.copy(deep=True)))
    with pytest.raises(ContractError, match="output of stage scale"):
        run_stage(stage, {"grid": source}, tmp_path / "out.nc", {"factor": 2.0})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["grid.nc"]


def test_other_contract_is_refused_by_name(tmp_path: Path) -> None:
    write_artifact(grid(), tmp_path / "c.nc", "component-grid/1")
    with pytest.raises(ContractError, match=r"role grid\).*component-grid/1.0.0.*anomaly-grid"):
        run_stage(SCALE, {"grid": tmp_path / "c.nc"}, tmp_path / "out.nc", {"factor": 2.0})


def test_input_is_checked_once_per_content(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checks: list[str] = []
    check = contracts.check

    def counted(dataset: xr.Dataset, contract: str, *, where: object = None) -> None:
        checks.append(str(where))
        check(dataset, contract, where=where)

    monkeypatch.setattr(contracts, "check", counted)
    monkeypatch.setattr(runner, "_checked", set())
    for factor in (2.0, 3.0):
        run_stage(SCALE, {"grid": source}, tmp_path / "out.nc", {"factor": factor})
    run_stage(SCALE, {"grid": tmp_path / "out.nc"}, tmp_path / "next.nc", {"factor": 2.0})
    # What a stage has just made was checked before it was written.
    assert checks == [f"{source} (role grid)"] + ["output of stage scale"] * 3
    monkeypatch.setattr(receipts, "code_digest", lambda: "newer")  # may know a newer contract
    run_stage(SCALE, {"grid": tmp_path / "out.nc"}, tmp_path / "next.nc", {"factor": 2.0})
    assert checks[4:] == [f"{tmp_path / 'out.nc'} (role grid)", "output of stage scale"]


def write(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(
    ("spoil", "expected"),
    [
        pytest.param(lambda data: b"", "the file is empty", id="empty"),
        pytest.param(lambda data: b"II*\0" + data, "starts with b'II", id="tiff"),
        pytest.param(lambda data: b"CDF\x01" + data, "expected a netCDF-4 file", id="classic"),
        pytest.param(lambda data: data[: len(data) // 2], "truncated or damaged", id="half"),
        pytest.param(lambda data: data[:8], "truncated or damaged", id="signature only"),
        pytest.param(lambda data: data[:8] + bytes(4000), "truncated or damaged", id="zeros"),
    ],
)
def test_damaged_input_is_a_format_error(
    source: Path, tmp_path: Path, spoil: Any, expected: str
) -> None:
    bad = write(tmp_path / "bad.nc", spoil(source.read_bytes()))
    with pytest.raises(FormatError) as caught:
        run_stage(SCALE, {"grid": bad}, tmp_path / "out.nc", {"factor": 2.0})
    assert expected in str(caught.value)
    assert str(bad) in str(caught.value)


def test_a_small_file_cannot_declare_huge_arrays(tmp_path: Path) -> None:
    import netCDF4

    with netCDF4.Dataset(tmp_path / "bomb.nc", "w") as file:
        file.createDimension("x", 1 << 40)
        file.createVariable("magnetic_anomaly", "f8", ("x",), chunksizes=(1 << 20,), zlib=True)
    with pytest.raises(FormatError, match="declares 8796093022208 bytes"):
        open_artifact(tmp_path / "bomb.nc")


@pytest.mark.parametrize(
    ("inputs", "params", "kind", "expected"),
    [
        pytest.param({}, {"factor": 2.0}, UsageError, "no file for role 'grid'", id="no input"),
        pytest.param({"gird": "grid.nc"}, {"factor": 2.0}, UsageError, "unknown role", id="role"),
        pytest.param({"grid": "none.nc"}, {"factor": 2.0}, FormatError, "role grid", id="no file"),
        pytest.param({"grid": "out.nc"}, {"factor": 2.0}, UsageError, "replace", id="in place"),
        pytest.param({"grid": "grid.nc"}, {}, ParameterError, "'factor' is missing", id="missing"),
        pytest.param(
            {"grid": "grid.nc"}, {"factor": float("nan")}, ParameterError, "finite", id="nan"
        ),
        pytest.param({"grid": "grid.nc"}, {"factor": 2.0, "f": 1}, ParameterError, "'f'", id="key"),
    ],
)
def test_bad_use_is_an_error_that_names_the_thing(
    source: Path,
    tmp_path: Path,
    inputs: dict[str, str],
    params: dict[str, Any],
    kind: type[MagtilesError],
    expected: str,
) -> None:
    (tmp_path / "out.nc").write_bytes(b"older")
    files = {role: tmp_path / name for role, name in inputs.items()}
    with pytest.raises(kind, match=expected):
        run_stage(SCALE, files, tmp_path / "out.nc", params)
    assert (tmp_path / "out.nc").read_bytes() == b"older"


def test_two_files_for_a_single_role(source: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="2 files for role 'grid'; expected one"):
        run_stage(SCALE, {"grid": [source, source]}, tmp_path / "o.nc", {"factor": 2.0})


def test_a_failed_write_leaves_nothing(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: xr.Dataset, path: Path, **_: Any) -> None:
        path.write_bytes(b"half")
        raise RuntimeError("NetCDF: HDF error")

    monkeypatch.setattr(xr.Dataset, "to_netcdf", full)
    with pytest.raises(MagtilesError, match="cannot be written"):
        run_stage(SCALE, {"grid": source}, tmp_path / "out.nc", {"factor": 2.0})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["grid.nc"]
