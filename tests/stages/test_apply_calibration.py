"""Stage apply-calibration: the field believed, its length, its flags, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from calibration_tracks import BIAS, DISTORTION, GIVEN, TOTAL, circles, track, tumbling

from magtiles.catalog.flags import QualityFlag, TrackFlag, flag_attributes
from magtiles.schemas import contracts
from magtiles.schemas.errors import ContractError
from magtiles.stages.vehicle.calibration.apply import (
    ApplyCalibrationParams,
    apply_calibration,
)
from magtiles.stages.vehicle.calibration.calibrate import (
    CalibrateVectorParams,
    calibrate_vector,
)


def apply(made: xr.Dataset, calibration: xr.Dataset) -> xr.Dataset:
    out = apply_calibration(made, calibration, params=ApplyCalibrationParams())
    contracts.check(out, "track/1")
    return out


@pytest.fixture(scope="module")
def solid() -> xr.Dataset:
    made = track(*tumbling(), distortion=DISTORTION, attitude=True)
    params = CalibrateVectorParams(method="attitude", core_field_nt=GIVEN)
    return calibrate_vector(made, params=params)


@pytest.fixture(scope="module")
def level() -> xr.Dataset:
    return calibrate_vector(track(circles()), params=CalibrateVectorParams(core_field_nt=GIVEN))


def test_the_field_of_a_steel_free_sensor_comes_back(solid: xr.Dataset) -> None:
    motion = circles(1.5), 0.2, -0.3
    out = apply(track(*motion, distortion=DISTORTION), solid)
    truth = track(*motion, distortion=np.eye(3), bias=np.zeros(3))
    # Measured: 8e-11 nT.
    np.testing.assert_allclose(out["field_body"], truth["field_body"], atol=1e-6)
    np.testing.assert_allclose(out["field_total"], TOTAL, atol=1e-6)
    assert (out["quality_flag"] == 0).all()
    assert out.attrs["calibration"] == "attitude from made, residual 0.0 nT rms"


def test_attitudes_that_level_circles_did_not_see_are_flagged(level: xr.Dataset) -> None:
    turn = circles(1.0, 1000)
    pitch = np.where(np.arange(1000) < 500, 0.02, 0.4)
    out = apply(track(turn, pitch), level)
    flagged = (out["quality_flag"].values & int(TrackFlag.EXTRAPOLATED_CALIBRATION)) != 0
    assert not flagged[:500].any()
    assert flagged[500:].mean() > 0.7  # where the pitch shifts the vertical reading by 2.7 uT
    assert out["quality_flag"].dtype == np.uint16


def test_missing_stays_missing_and_flags_are_kept(level: xr.Dataset) -> None:
    made = track(circles(1.0, 500))
    made["field_body"].values[3] = np.nan
    flags = np.zeros(500, np.uint8)
    flags[3] = TrackFlag.FIELD_GAP
    attrs = flag_attributes(QualityFlag, np.uint8)
    out = apply(made.assign(quality_flag=("time", flags, attrs)), level)
    assert np.isnan(out["field_total"].values[3])
    assert out["quality_flag"].values[3] == TrackFlag.FIELD_GAP
    assert "extrapolated_calibration" in out["quality_flag"].attrs["flag_meanings"]


def test_a_total_field_of_another_sensor_is_kept(level: xr.Dataset) -> None:
    made = track(circles(1.0, 500))
    scalar = ("time", np.full(500, TOTAL), {"units": "nT"})
    kept = apply(made.assign(field_total=scalar), level)
    np.testing.assert_array_equal(kept["field_total"], TOTAL)
    raw_length = ("time", np.linalg.norm(made["field_body"], axis=1), {"units": "nT"})
    replaced = apply(made.assign(field_total=raw_length), level)
    np.testing.assert_allclose(replaced["field_total"], TOTAL, rtol=1e-9)


def test_twice_is_refused(level: xr.Dataset) -> None:
    once = apply(track(circles(1.0, 500)), level)
    with pytest.raises(ContractError, match=r"calibrated already.*as it was ingested"):
        apply(once, level)


def test_a_track_without_a_vector_is_refused(level: xr.Dataset) -> None:
    made = track(circles(1.0, 500))
    scalar = made.drop_vars("field_body").assign(
        field_total=("time", np.full(500, TOTAL), {"units": "nT"})
    )
    with pytest.raises(ContractError, match="'field_body' is missing"):
        apply(scalar, level)


def test_coefficients_of_tolles_lawson_are_refused(level: xr.Dataset) -> None:
    with pytest.raises(ContractError, match=r"Tolles-Lawson.*apply-tolles-lawson"):
        apply(track(circles(1.0, 500)), level.drop_vars("matrix"))


def test_bias_is_taken_off_before_the_matrix(level: xr.Dataset) -> None:
    made = track(circles(1.0, 500))
    made["field_body"].values[:] = BIAS
    np.testing.assert_allclose(apply(made, level)["field_body"], 0.0, atol=1e-8)
