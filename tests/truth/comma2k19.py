"""A segment of comma2k19 (NumPy arrays) as a ROS 2 log with the topics of the sample's drives.

Run as a script:

    python tests/truth/comma2k19.py SEGMENT drive.mcap

Columns are as comma2k19's README has them: `live_gnss_ublox` latitude, longitude, speed, UTC in
milliseconds, height above the ellipsoid, bearing; sensors in microtesla, rad/s and m/s2 along
forward, right, down. Times are seconds since boot, and UTC is known to the receiver.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magtiles.pipeline.ros_log import (
    imu,
    magnetic_field,
    nav_sat_fix,
    twist_stamped,
    write_ros_log,
)

_FLU = np.array([1.0, -1.0, -1.0])


def convert(segment: Path, log: Path) -> Path:
    """Write the log of a segment's folder; axes become forward, left, up."""
    since_boot, fixes = _stream(segment, "GNSS/live_gnss_ublox")
    # The receiver reports a fix some 0.1 s after its instant, the earliest soonest.
    boot_ms = np.max(fixes[:, 3] - 1e3 * since_boot)

    def utc(seconds: NDArray[np.float64]) -> NDArray[np.datetime64]:
        ns = np.round(1e6 * (boot_ms + 1e3 * seconds)).astype(np.int64)
        return ns.astype("datetime64[ns]")

    time, field = _stream(segment, "IMU/magnetometer")
    moving, speed = _stream(segment, "CAN/speed")
    turning, rate = _stream(segment, "IMU/gyro")
    pushed, acceleration = _stream(segment, "IMU/accelerometer")
    held = np.column_stack([np.interp(turning, pushed, part) for part in acceleration.T])
    place = fixes[:, [0, 1, 4]]
    stamps = (1e6 * fixes[:, 3]).astype(np.int64).astype("datetime64[ns]")
    write_ros_log(
        log,
        [
            magnetic_field("/magnetometer", utc(time), 1e-6 * field * _FLU, sigma_t=0.0),
            nav_sat_fix("/gnss/fix", stamps, place, sigma_m=None),
            imu("/imu", utc(turning), None, rate * _FLU, held * _FLU),
            twist_stamped("/wheel_speed", utc(moving), speed[:, 0]),
        ],
    )
    return log


def _stream(segment: Path, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times (n,) s since boot and values (n, k) of a sensor."""
    folder = segment / "processed_log" / name
    return np.load(folder / "t.npy"), np.load(folder / "value.npy")


if __name__ == "__main__":
    print(convert(Path(sys.argv[1]), Path(sys.argv[2])))
