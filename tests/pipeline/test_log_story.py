"""The page from a log to its anomaly: its commands run, and its numbers hold."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from magtiles.pipeline.main import main

PAGE = Path(__file__).resolve().parents[2] / "docs" / "from_log_to_anomaly.md"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where every command of the page was run, in order."""
    made = tmp_path_factory.mktemp("story")
    lines = [line[2:] for line in PAGE.read_text().splitlines() if line.startswith("$ ")]
    assert len(lines) == 16
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(made)
        for line in lines:
            assert main(shlex.split(line)[1:]) == 0, line
    return made


def test_pictures_are_made(folder: Path) -> None:
    for name in ("circles", "path", "compensated", "anomaly"):
        assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_the_truck_is_calibrated(folder: Path) -> None:
    drives = folder / "build/sample/drives"
    with (
        xr.open_dataset(folder / "calibrated.nc", engine="netcdf4") as track,
        xr.open_dataset(drives / "truck-calibration-1-truth.nc", engine="netcdf4") as truth,
    ):
        assert abs(track.attrs["fix_lag_s"]) < 0.03  # found -0.005; the truth is 0
        apart = track["field_body"].values[:, :2] - truth["field_body"].values[:, :2]
    assert np.sqrt((apart**2).mean()) < 320.0  # of which 200 nT are the sensor's noise


def test_the_aircrafts_anomaly_is_the_true_one(folder: Path) -> None:
    truth_file = folder / "build/sample/demo-flight-truth.nc"
    with (
        xr.open_dataset(folder / "anomaly.nc", engine="netcdf4") as track,
        xr.open_dataset(truth_file, engine="netcdf4") as truth,
    ):
        misfit = json.loads(track.attrs["crossover_misfit"])["after"]
        apart = (track["magnetic_anomaly"] - truth["magnetic_anomaly"].values).values
        varied = (track["diurnal"] - truth["diurnal"].values).values
    assert misfit["count"] == 7
    assert misfit["rms"] < 0.06  # found 0.052
    assert np.std(apart) < 0.052  # found 0.048
    assert np.std(varied) < 0.005


def test_table_and_track_of_the_flight_are_the_same(folder: Path) -> None:
    with (
        xr.open_dataset(folder / "flight.nc", engine="netcdf4") as table,
        xr.open_dataset(folder / "build/sample/demo-flight.nc", engine="netcdf4") as track,
    ):
        np.testing.assert_array_equal(table["time"], track["time"])
        # As many digits as the table has.
        for name, digit in (
            ("latitude", 1e-8), ("longitude", 1e-8), ("height", 0.01), ("field_total", 1e-3),
            ("field_body", 0.1), ("speed", 0.01), ("line", 1.0),
        ):  # fmt: skip
            np.testing.assert_allclose(
                table[name].values.astype(float), track[name].values, rtol=0, atol=0.501 * digit
            )
