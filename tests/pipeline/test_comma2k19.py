"""A real minute of driving, converted: read as it was written, and refused as a calibration."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from comma2k19 import convert

from magtiles.schemas.errors import CoverageError
from magtiles.stages.ingest.log.source import IngestLogParams
from magtiles.stages.ingest.log.stage import ingest_log
from magtiles.stages.vehicle.calibration.calibrate import CalibrateVectorParams, calibrate_vector


@pytest.fixture(scope="module")
def segment(real_data: Path) -> Path:
    return real_data / "drive_comma2k19"


@pytest.fixture(scope="module")
def track(segment: Path, tmp_path_factory: pytest.TempPathFactory) -> xr.Dataset:
    log = convert(segment, tmp_path_factory.mktemp("comma") / "drive.mcap")
    params = IngestLogParams.model_validate({"sensor_to_body": "forward,left,up"})
    return ingest_log([log], params=params)


def test_track_holds_the_arrays(track: xr.Dataset, segment: Path) -> None:
    folder = segment / "processed_log"
    field = np.load(folder / "IMU/magnetometer/value.npy")
    # Rounding of microtesla to tesla and back.
    np.testing.assert_allclose(track.field_body, 1e3 * field, rtol=1e-14)
    fixes = np.load(folder / "GNSS/live_gnss_ublox/value.npy")
    np.testing.assert_array_equal(track.fix_latitude, fixes[:, 0])
    np.testing.assert_array_equal(track.fix_height, fixes[:, 4])
    assert str(track.time.values[0])[:16] == "2018-08-02T16:14"
    assert np.isnan(track.fix_horizontal_sigma).all()
    assert np.isnan(track.attitude_quaternion).all()
    gyro = np.load(folder / "IMU/gyro/value.npy")
    np.testing.assert_array_equal(track.angular_rate, gyro)
    # Wheels and fixes agree on the speed to 1 % once the clocks do.
    fast = np.interp(track.fix_time.astype(np.int64), track.time.astype(np.int64), track.speed)
    assert np.nanmean(fast / fixes[:, 2]) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("method", ["modified-ellipsoid", "swinging", "ellipsoid"])
def test_a_straight_minute_calibrates_nothing(track: xr.Dataset, method: str) -> None:
    with pytest.raises(CoverageError, match="not observed") as caught:
        calibrate_vector(track, params=CalibrateVectorParams.model_validate({"method": method}))
    found = re.search(
        r"measures (\d+) nT in the median, the core field is (\d+) nT", str(caught.value)
    )
    assert found is not None
    assert [int(number) for number in found.groups()] == [42533, 48130]
