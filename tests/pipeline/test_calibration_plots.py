"""The picture of a calibration: what it shows is what the readings are."""

from __future__ import annotations

from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
import xarray as xr
from calibration_tracks import CORE, DISTORTION, GIVEN, TOTAL, circles, track, tumbling

from magtiles.pipeline.artifacts import write_artifact
from magtiles.pipeline.calibration_plots import calibration_figure
from magtiles.pipeline.main import main
from magtiles.schemas.errors import ContractError
from magtiles.stages.vehicle.calibration.calibrate import (
    CalibrateVectorParams,
    calibrate_vector,
)

LEVEL_UT = float(np.hypot(*CORE[:2])) / 1e3


def calibrated(made: xr.Dataset, **params) -> xr.Dataset:
    return calibrate_vector(made, params=CalibrateVectorParams(core_field_nt=GIVEN, **params))


def test_level_circles_with_attitude_show_circle_magnitude_and_heading() -> None:
    made = track(circles(), attitude=True)
    figure = calibration_figure(made, calibrated(made))
    plane, magnitude, heading, error = figure.axes
    raw, after, core = (np.hypot(*line.get_data()) for line in plane.lines[:3])
    assert np.ptp(raw) > 10.0
    np.testing.assert_allclose(after, LEVEL_UT, rtol=1e-9)
    np.testing.assert_allclose(core, LEVEL_UT, rtol=1e-9)
    np.testing.assert_allclose(magnitude.lines[2].get_ydata(), LEVEL_UT, rtol=1e-9)
    assert "horizontal" in magnitude.get_ylabel()
    true, _, by_field = (line.get_ydata() for line in heading.lines)
    np.testing.assert_allclose(np.sin(np.radians(by_field - true)), 0.0, atol=1e-9)
    # Symmetric distortion asked for and driven: the error of the heading is gone.
    np.testing.assert_allclose(error.lines[1].get_ydata(), 0.0, atol=1e-9)
    assert np.abs(error.lines[0].get_ydata()).max() > 20.0


def test_an_ellipsoid_without_attitude_shows_two_planes_and_no_heading() -> None:
    made = track(*tumbling(), distortion=DISTORTION)
    figure = calibration_figure(made, calibrated(made, method="ellipsoid"))
    assert len(figure.axes) == 4
    assert [a.get_ylabel().split(",")[0] for a in figure.axes[:2]] == ["forward", "down"]
    assert figure.axes[1].yaxis_inverted()
    np.testing.assert_allclose(figure.axes[2].lines[2].get_ydata(), TOTAL / 1e3, rtol=1e-9)
    np.testing.assert_allclose(figure.axes[3].lines[0].get_ydata(), 0.0, atol=1e-9)


def test_heading_of_a_tilted_sensor_is_levelled_by_its_attitude() -> None:
    n = np.arange(3000)
    motion = circles(4.0, 3000), 0.4 * np.sin(n / 37.0), 0.6 * np.sin(n / 53.0)
    made = track(*motion, distortion=DISTORTION, attitude=True)
    figure = calibration_figure(made, calibrated(made, method="attitude"))
    np.testing.assert_allclose(figure.axes[-1].lines[1].get_ydata(), 0.0, atol=1e-8)


def test_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = track(circles(), noise=200.0)
    files = {"track": tmp_path / "track.nc", "calibration": tmp_path / "calibration.nc"}
    write_artifact(made, files["track"], "track/1")
    write_artifact(calibrated(made), files["calibration"], "sensor-calibration/1")
    picture = tmp_path / "calibration.png"
    plot = ["plot", str(files["calibration"]), "--out", str(picture)]
    assert main([*plot, "--track", str(files["track"])]) == 0
    assert matplotlib.image.imread(picture).shape[:2] == (924, 1540)
    assert main(plot) == 2
    assert "a calibration is drawn with --track" in capsys.readouterr().err
    assert main([*plot, "--track", str(files["calibration"])]) == 1
    assert "the file holds a sensor-calibration" in capsys.readouterr().err


def test_other_tracks_and_other_calibrations_are_refused() -> None:
    made = track(circles())
    level = calibrated(made)
    with pytest.raises(ContractError, match="Tolles-Lawson"):
        calibration_figure(made, level.drop_vars("matrix"))
    with pytest.raises(ContractError, match="calibrated already"):
        calibration_figure(made.assign_attrs(calibration="swinging"), level)
