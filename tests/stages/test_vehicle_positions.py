"""Positions and attitudes at the field's times, against closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyproj
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magtiles.catalog.flags import TrackFlag
from magtiles.stages.vehicle.positions import (
    Attitudes,
    Fixes,
    Positions,
    attitude_at,
    interpolated,
    moved_by_lever,
    positions_at,
)


def times(*seconds: float) -> NDArray[np.datetime64]:
    """UTC of today's size, where a double no longer holds nanoseconds."""
    start = np.datetime64("2024-05-06T07:08:09.123456789", "ns")
    return start + (np.array(seconds) * 1e9).astype("timedelta64[ns]")


def fixes(seconds: list[float], **columns: Any) -> Fixes:
    n = len(seconds)
    whole: dict[str, Any] = {
        "latitude": np.linspace(45.0, 45.001, n),
        "longitude": np.full(n, 7.0),
        "height": np.full(n, 300.0),
        "status": np.zeros(n, np.int8),
        "horizontal_sigma": np.full(n, np.nan),
        "vertical_sigma": np.full(n, np.nan),
    } | columns
    return Fixes(times(*seconds), **whole)


def test_a_straight_run_on_the_ellipsoid_is_followed_to_a_millimetre() -> None:
    """Fixes 100 m apart on a geodesic at 70 degrees; the truth in between is PROJ's geodesic."""
    geod = pyproj.Geod(ellps="WGS84")
    along = np.arange(0.0, 1000.0, 100.0)
    origin = np.full(along.size, 20.0), np.full(along.size, 70.0), np.full(along.size, 60.0)
    longitude, latitude, _ = geod.fwd(*origin, along)
    run = fixes([float(a) / 100 for a in along], latitude=latitude, longitude=longitude)
    between = np.arange(0.0, 900.0, 7.0)
    found = positions_at(times(*(between / 100)), run, max_gap_s=1.0)
    origin = np.full(between.size, 20.0), np.full(between.size, 70.0), np.full(between.size, 60.0)
    true_longitude, true_latitude, _ = geod.fwd(*origin, between)
    _, _, miss = geod.inv(true_longitude, true_latitude, found.longitude, found.latitude)
    assert miss.max() < 1e-3  # found 0.5 mm
    assert not found.flag.any()


def test_gaps_ends_and_refusals_are_flagged_apart() -> None:
    run = fixes([0, 1, 5, 6, 7, 9], status=np.array([0, 0, 0, -1, -1, 2], np.int8))
    at = times(-0.1, 0, 0.5, 1, 1.1, 4.9, 5, 6, 8.9, 9, 9.1)
    found = positions_at(at, run, max_gap_s=2.0)
    lost, gap = TrackFlag.NO_FIX.value, TrackFlag.POSITION_GAP.value
    assert found.flag.tolist() == [lost, 0, 0, 0, gap, gap, 0, lost, lost, 0, lost]
    np.testing.assert_array_equal(np.isnan(found.latitude), found.flag > 0)
    np.testing.assert_array_equal(np.isnan(found.height), found.flag > 0)


@pytest.mark.parametrize("status", [[-1, -1], [0, -1], [-1, 0]])
def test_no_or_one_valid_fix(status: list[int]) -> None:
    found = positions_at(times(0, 0.5, 1), fixes([0, 1], status=np.array(status)), max_gap_s=9.0)
    known = [status[0] == 0, False, status[1] == 0]
    np.testing.assert_array_equal(np.isfinite(found.latitude), known)


def test_the_date_line_is_crossed_the_short_way() -> None:
    run = fixes([0, 1, 2], longitude=np.array([179.9, -179.9, 179.9]))
    found = positions_at(times(0.25, 0.75, 1.5), run, max_gap_s=9.0)
    np.testing.assert_allclose(found.longitude, [179.95, -179.95, -180.0], atol=1e-12)


def test_attitudes_turn_evenly_and_know_their_gaps() -> None:
    angles = np.radians([0.0, 90.0, 100.0, 200.0])
    turn = Rotation.from_rotvec(angles[:, None] * np.array([0.0, 0.0, 1.0])).as_quat(
        scalar_first=True
    )
    turn[1] *= -1  # the same attitude
    sampled = Attitudes(times(0, 1, 2, 7), turn, np.full((4, 3), np.nan))
    at = times(-1, 0.5, 1.5, 4, 7, 8)
    found = attitude_at(at, sampled, max_gap_s=2.0)
    assert np.isnan(found[[0, 3, 5]]).all()
    # The sample at 7 s ends a gap, and belongs to it.
    assert np.isnan(found[4]).all()
    yaw = Rotation.from_quat(found[[1, 2]], scalar_first=True).as_euler("zyx", degrees=True)[:, 0]
    np.testing.assert_allclose(yaw, [45.0, 95.0], atol=1e-9)


def test_the_lever_arm_is_that_of_proj_s_geodesic() -> None:
    geod = pyproj.Geod(ellps="WGS84")
    place = Positions(*(np.array([v]) for v in (60.0, 10.0, 100.0)), np.zeros(1, np.uint16))
    turn = Rotation.from_euler("ZYX", [40.0, 0.0, 0.0], degrees=True).as_quat(scalar_first=True)
    found = moved_by_lever(place, turn[None], np.array([5.0, 0.0, -2.0]))
    azimuth, _, distance = geod.inv(10.0, 60.0, found.longitude[0], found.latitude[0])
    assert azimuth == pytest.approx(40.0, abs=1e-3)
    assert distance == pytest.approx(5.0, rel=1e-4)  # radii of curvature 100 m up
    assert found.height[0] == 102.0


def test_interpolation_leaves_gaps_and_missing_values_out() -> None:
    values = np.array([0.0, np.nan, 2.0, 9.0])
    found = interpolated(times(0.5, 1.5, 3, 5), times(0, 1, 2, 4.5), values, max_gap_s=2.0)
    np.testing.assert_allclose(found[:2], [0.5, 1.5], atol=1e-9)
    assert np.isnan(found[2:]).all()
