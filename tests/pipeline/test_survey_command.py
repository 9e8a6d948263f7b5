"""``magtiles run grid-survey`` on files, and what takes its grid."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from small_survey import dipoles, track_of, walked

from magtiles.pipeline.artifacts import write_artifact
from magtiles.pipeline.main import main


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str]:
    status = main(["run", *map(str, words)])
    captured = capsys.readouterr()
    return status, captured.out + captured.err


def test_tracks_become_a_grid_that_is_filled(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    x, y = walked(0, apart=2.0, step=0.5)
    values = dipoles(0)(x, y)
    for name, part in (("one", slice(None, 200)), ("two", slice(200, None))):
        track = track_of(x[part], y[part], values[part], source=name)
        write_artifact(track, tmp_path / f"{name}.nc", "track-anomaly/1")
    grid, filled = tmp_path / "grid.nc", tmp_path / "filled.nc"
    tracks = (f"--in=track={tmp_path / 'one.nc'}", f"--in=track={tmp_path / 'two.nc'}")
    poor = "--param=noise_nt=1.0", '--param=method="polynomial"', "--param=max_degree=3"
    assert run(capsys, "grid-survey", *tracks, "--out", grid, *poor, "--json")[0] == 0
    with xr.open_dataset(grid) as made:
        assert made.attrs["source"] == "one, two"
        assert made.attrs["reduced_chi_squared"].shape == (9,)
        assert np.isfinite(made["magnetic_anomaly"]).all()
    again = run(capsys, "grid-survey", *tracks, "--out", grid, *poor, "--json")
    assert json.loads(again[1])["rebuilt"] is False
    total = run(capsys, "grid-survey", f"--in=total={tmp_path / 'one.nc'}", "--out", filled)
    assert "expected track/1" in total[1]  # an anomaly's track by the other role
    assert run(capsys, "fill-voids", "--in", f"grid={grid}", "--out", filled)[0] == 0
    assert filled.is_file()


def test_mixed_tracks_are_refused_and_nothing_is_left(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    x, y = walked(0, apart=2.0)
    for name in ("IGRF-13", "IGRF-14"):
        track = track_of(x, y, dipoles(0)(x, y), source=name, reference_field=name)
        write_artifact(track, tmp_path / f"{name}.nc", "track-anomaly/1")
    tracks = (f"--in=track={tmp_path / f'{n}.nc'}" for n in ("IGRF-13", "IGRF-14"))
    status, said = run(capsys, "grid-survey", *tracks, "--out", tmp_path / "grid.nc")
    assert status == 1
    assert "reference_field is 'IGRF-14' here and 'IGRF-13'" in said
    assert not (tmp_path / "grid.nc").exists()
