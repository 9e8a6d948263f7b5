"""magtiles info of a stage's artifact: contract, stage, ranges. Other netCDF is none."""

from __future__ import annotations

import json
from pathlib import Path

import netCDF4
import numpy as np
import pytest
from temporal import temporal_dataset

from magtiles.pipeline.artifacts import write_artifact
from magtiles.pipeline.main import main

Capture = pytest.CaptureFixture[str]


@pytest.fixture
def artifact(tmp_path: Path) -> Path:
    model = temporal_dataset()
    model["tau_high"] = model["tau_high"].astype("f8")
    model["tau_high"].values[0, 0, :3] = np.nan, np.nan, np.inf
    write_artifact(model, tmp_path / "model.nc", "temporal-model/1")
    return tmp_path / "model.nc"


def test_an_artifact_is_described(artifact: Path, capsys: Capture) -> None:
    assert main(["info", str(artifact), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["contract"] == "temporal-model/1.0.0"
    assert told["stage"] is None  # no receipt beside it
    assert told["sizes"]["segment"] == 480
    assert told["attributes"]["segment_s"] == 10800.0
    assert told["variables"]["latitude"] == {
        "dims": ["observatory"], "dtype": "float64", "units": "degrees_north",
        "minimum": 20.0, "maximum": 44.0, "missing": 0,
    }  # fmt: skip
    high = told["variables"]["tau_high"]
    assert (high["minimum"], high["maximum"], high["missing"]) == (900.0, None, 2)  # infinite
    assert told["variables"]["month"]["maximum"] == "2024-03-01T00:00:00"
    assert told["variables"]["quiet_day"]["missing"] == 4


def test_an_artifact_is_printed_with_what_made_it(
    artifact: Path, tmp_path: Path, capsys: Capture
) -> None:
    united = tmp_path / "united.nc"
    argv = ["run", "assemble-temporal", "--in", f"models={artifact}", "--out", str(united)]
    assert main(argv) == 0
    capsys.readouterr()
    assert main(["info", str(united)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == ["contract     temporal-model/1.0.0", "stage        assemble-temporal"]
    row = next(line.split() for line in lines if line.startswith("class_sigma "))
    assert row == ["class_sigma", "(observatory,", "element,", "class)", "nT", "1", "112.3", "0"]


def test_other_netcdf_is_no_artifact(tmp_path: Path, capsys: Capture) -> None:
    with netCDF4.Dataset(tmp_path / "other.nc", "w") as file:
        file.title = "somebody else's"
    assert main(["info", str(tmp_path / "other.nc")]) == 1
    assert "list its datasets with ncdump or h5dump" in capsys.readouterr().err
