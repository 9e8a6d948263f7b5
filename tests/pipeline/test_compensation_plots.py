"""Pictures of tracks: they show what the arrays hold, and refuse what they cannot show."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest
import xarray as xr
from cloverleaf import angles, flight

from magtiles.pipeline.artifacts import write_artifact
from magtiles.pipeline.compensation_plots import compensation_figure
from magtiles.pipeline.main import main
from magtiles.pipeline.track_plots import track_figure
from magtiles.schemas.errors import ContractError
from magtiles.stages.vehicle.tolles_lawson.apply import ApplyTollesLawsonParams, apply_tolles_lawson
from magtiles.stages.vehicle.tolles_lawson.fit import FitTollesLawsonParams, fit_tolles_lawson


@pytest.fixture(scope="module")
def measured() -> xr.Dataset:
    track = flight(angles(), noise_nt=0.05)
    turn = np.linspace(0.0, 2.0 * np.pi, track.sizes["time"])
    around = track["longitude"].values + 171.98 + 0.05 * np.cos(turn)  # over the date line
    return track.assign(
        longitude=("time", np.mod(around + 180.0, 360.0) - 180.0, {"units": "degrees_east"}),
        latitude=("time", 50.0 + 0.02 * np.sin(turn), {"units": "degrees_north"}),
    )


@pytest.fixture(scope="module")
def compensated(measured: xr.Dataset) -> xr.Dataset:
    calibration = fit_tolles_lawson(measured, params=FitTollesLawsonParams())
    return apply_tolles_lawson(measured, calibration, params=ApplyTollesLawsonParams())


def test_compensation_shows_both_fields_and_their_spectra(compensated: xr.Dataset):
    figure = compensation_figure(compensated)
    before, after, spectra = figure.axes
    lines = [axes.lines[0].get_ydata() for axes in (before, after)]
    rms = [np.nanstd(np.asarray(line)[compensated["quality_flag"] & 64 != 0]) for line in lines]
    assert rms[0] > 100.0 * rms[1]
    assert before.get_title(loc="left") == f"measured: {rms[0]:.3g} nT rms in manoeuvres"
    assert after.get_title(loc="left") == f"compensated: {rms[1]:.3g} nT rms in manoeuvres"
    assert [line.get_label() for line in spectra.lines] == ["measured", "compensated"]
    frequency, amplitude = spectra.lines[0].get_data()
    assert np.asarray(frequency)[np.asarray(amplitude)[4:].argmax() + 4] == pytest.approx(0.25)
    # White noise of 0.05 nT at 10 Hz has a density of 0.05 / sqrt(5 Hz).
    frequency, amplitude = spectra.lines[1].get_data()
    white = np.median(np.asarray(amplitude)[np.asarray(frequency) > 1.0])
    assert white == pytest.approx(0.05 / np.sqrt(5.0), rel=0.1)


def test_the_path_is_in_true_shape_and_coloured(measured: xr.Dataset):
    figure = track_figure(measured)
    axes = figure.axes[0]
    figure.canvas.draw()
    dots = axes.collections[0]
    places = np.asarray(dots.get_offsets())
    assert np.ptp(places[:, 0]) == pytest.approx(0.1, rel=0.01)  # unwrapped
    assert axes.get_aspect() == pytest.approx(1.0 / np.cos(np.radians(50.0)), rel=1e-3)
    values = measured["field_total"].values
    np.testing.assert_allclose(dots.get_array(), values - np.median(values))
    assert figure.axes[1].get_xlabel().startswith("total field less 52")
    anomaly = measured.copy(deep=True)
    anomaly["magnetic_anomaly"] = "time", np.linspace(-5.0, 9.0, values.size)
    anomaly["latitude"][5] = np.nan
    dots = track_figure(anomaly).axes[0].collections[0]
    assert np.asarray(dots.get_array()).size == values.size - 1
    assert dots.get_clim() == pytest.approx((-8.9, 8.9), abs=0.1)


def test_a_vector_magnetometer_shows_its_magnitude_and_spectra(measured: xr.Dataset):
    rng = np.random.default_rng(0)
    time = measured.sizes["time"]
    field = np.array([2e4, 0.0, 4e4]) + rng.normal(0.0, [10.0, 20.0, 40.0], (time, 3))
    field[700] = np.nan
    vector = measured.drop_vars("field_total").assign(field_body=(("time", "axis"), field))
    figure = track_figure(vector)
    path, _, spectra = figure.axes
    found = np.asarray(path.collections[0].get_array())
    length = np.linalg.norm(field, axis=1)
    np.testing.assert_allclose(found, (length - np.nanmedian(length))[np.isfinite(length)])
    for line, sigma in zip(spectra.lines, (10.0, 20.0, 40.0), strict=True):
        # White noise at 10 Hz; 50 spectra averaged, so that their median scatters by 1 %.
        density = np.median(np.asarray(line.get_ydata()))
        assert density == pytest.approx(sigma / np.sqrt(5.0), rel=0.05)
    uneven = vector.isel(time=np.sort(rng.choice(time, time // 2, replace=False)))
    assert len(track_figure(uneven).axes) == 2  # path and colours


REFUSED = {
    "not compensated": (compensation_figure, lambda t: t, "'field_total_raw' is missing"),
    "too short": (
        compensation_figure,
        lambda t: t.assign(field_total_raw=t["field_total"]).isel(time=slice(0, 30)),
        "too short",
    ),
    "no field": (track_figure, lambda t: t.drop_vars(["field_total", "field_body"]), "are missing"),
    "no place": (
        track_figure, lambda t: t.assign(longitude=t["longitude"] * np.nan), "no sample has both",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_drawn_is_refused(case: str, measured: xr.Dataset):
    draw, change, message = REFUSED[case]
    with pytest.raises(ContractError, match=message):
        draw(change(measured))


def test_plot_draws_files_by_their_contract(
    measured: xr.Dataset, compensated: xr.Dataset, tmp_path: Path, capsys: Any
):
    for name, track in (("path", measured), ("compensation", compensated)):
        write_artifact(track, tmp_path / f"{name}.nc", "track/1")
        out = tmp_path / f"{name}.png"
        assert main(["plot", str(tmp_path / f"{name}.nc"), "--out", str(out)]) == 0
        assert matplotlib.image.imread(out).shape[1] > 1000
    write_artifact(measured, tmp_path / "other.nc", "activity-index/1")
    assert main(["plot", str(tmp_path / "other.nc"), "--out", str(tmp_path / "o.png")]) == 2
    assert "has contract 'activity-index/1.0.0'" in capsys.readouterr().err
    assert not (tmp_path / "o.png").exists()
