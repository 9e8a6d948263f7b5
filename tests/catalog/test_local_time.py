"""Local mean solar time against arithmetic by hand; curves against closed forms."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from magtiles.catalog.kernels.local_time import (
    baseline_at,
    level_at,
    mid_month,
    solar_minute,
    standard_error_at,
)

MONTHS = np.array(["2015-12-01", "2016-01-01", "2016-02-01"], "datetime64[ns]")


def instants(*text: str) -> NDArray[np.datetime64]:
    return np.array(text, "datetime64[ns]")


class Expect(NamedTuple):
    time: str
    longitude: float
    minute: float
    id: str


TIMES = [
    Expect("2016-01-01T00:00", 0.0, 0.0, "midnight at Greenwich"),
    Expect("2016-01-01T12:00", 180.0, 0.0, "midnight on the date line"),
    Expect("2016-01-01T12:00", -180.0, 0.0, "the date line from the west"),
    Expect("2016-01-01T00:00", -105.237, 1440.0 - 420.948, "the evening before at Boulder"),
    Expect("2016-01-01T00:00", 254.763, 1440.0 - 420.948, "its longitude counted eastward"),
    Expect("1969-12-31T23:59:30", 0.25, 0.5, "before 1970, over midnight"),
    Expect("2016-01-01T00:00", -1e-18, 0.0, "never 1440 itself"),
]


@pytest.mark.parametrize("case", TIMES, ids=lambda c: c.id)
def test_solar_minute(case: Expect) -> None:
    found = solar_minute(instants(case.time), case.longitude)
    assert found == pytest.approx(case.minute, abs=1e-9)
    assert 0.0 <= found[0] < 1440.0


def test_solar_minute_broadcasts_and_keeps_what_is_missing_missing() -> None:
    found = solar_minute(instants("2016-01-01T00:00", "NaT")[:, None], np.array([15.0, np.nan]))
    np.testing.assert_array_equal(found, [[60.0, np.nan], [np.nan, np.nan]])


def test_months_have_their_own_middles() -> None:
    expected = instants("2015-12-16T12:00", "2016-01-16T12:00", "2016-02-15T12:00")
    np.testing.assert_array_equal(mid_month(MONTHS), expected)


def curve(minutes: int = 1440, amplitude: float = 1.0) -> NDArray[np.float64]:
    return amplitude * np.sin(2 * np.pi * np.arange(minutes) / minutes)


def test_a_day_is_periodic_and_linear_between_minutes() -> None:
    rows = np.tile(curve(), (3, 1))
    time = np.datetime64("2016-01-10", "ns") + np.arange(0, 86400_000, 777).astype("m8[ms]")
    for longitude in (0.0, -105.24, 179.9):
        phase = 2 * np.pi * solar_minute(time, longitude) / 1440
        error = baseline_at(MONTHS, rows, time, longitude) - np.sin(phase)
        # Linear interpolation of a sine: at most (2 pi / 1440)^2 / 8 = 2.4e-6.
        assert np.abs(error).max() < 2.4e-6


def test_an_hourly_curve_is_a_curve_of_24_columns() -> None:
    rows = np.arange(24.0)[None]
    time = instants("2016-01-10T01:30", "2016-01-10T23:30")
    np.testing.assert_allclose(baseline_at(MONTHS[:1], rows, time, 0.0), [1.5, 11.5])


BETWEEN = [
    ("2016-01-16T12:00", 2.0, "the middle of a month is that month"),
    ("2016-01-31T12:00", 3.0, "half-way to the next"),
    ("2015-01-01", 1.0, "before the first middle, the first"),
    ("2016-02-29", 4.0, "after the last middle, the last"),
]


@pytest.mark.parametrize(("time", "value"), [c[:2] for c in BETWEEN], ids=[c[2] for c in BETWEEN])
def test_months_join_between_their_middles(time: str, value: float) -> None:
    rows = np.array([1.0, 2.0, 4.0])[:, None] * np.ones(1440)
    assert baseline_at(MONTHS, rows, instants(time), 33.0) == pytest.approx(value, abs=1e-12)
    level = np.array([[1.0, 2.0, 4.0], [10.0, 20.0, 40.0]])
    found = level_at(MONTHS, level, instants(time))
    np.testing.assert_allclose(found, [[value], [10 * value]], rtol=1e-12)


def test_a_month_of_nan_is_passed_over_and_single_minutes_are_not() -> None:
    rows = np.array([1.0, np.nan, 3.0])[:, None] * np.ones(1440)
    half = mid_month(MONTHS)[[0]] + (mid_month(MONTHS)[2] - mid_month(MONTHS)[0]) // 2
    assert baseline_at(MONTHS, rows, half, 0.0) == pytest.approx(2.0)
    rows[2, 100] = np.nan
    at = instants("2016-02-20T01:39", "2016-02-20T01:39:30", "2016-02-20T01:40")
    np.testing.assert_array_equal(baseline_at(MONTHS, rows, at, 0.0), [3.0, np.nan, np.nan])
    # The last month counts for nothing in the first's days, nor does a hole in it.
    assert baseline_at(MONTHS, rows, instants("2015-12-01T01:40"), 0.0) == 1.0
    assert np.isnan(baseline_at(MONTHS, np.full((3, 1440), np.nan), at, 0.0)).all()


def test_elements_and_places_broadcast() -> None:
    rows = np.stack([np.tile(curve(amplitude=a), (3, 1)) for a in (1.0, 10.0)])
    time = instants("2016-01-10T06:00", "NaT", "2016-01-10T18:00")
    found = baseline_at(MONTHS, rows, time, np.array([[0.0], [180.0]]))
    assert found.shape == (2, 2, 3)
    one = np.array([[1.0, np.nan, -1.0], [-1.0, np.nan, 1.0]])
    np.testing.assert_allclose(found, [one, 10 * one], atol=1e-12)


def test_standard_errors_of_two_months_combine_as_variances() -> None:
    rng = np.random.default_rng(5)
    sigma = np.array([3.0, 4.0, 1.0])
    time = instants("2016-01-01T00:00")  # half-way between December's middle and January's
    rows = sigma[:, None] * np.ones(1440)
    found = standard_error_at(MONTHS, rows, time, 0.0)
    assert found == pytest.approx(2.5, abs=1e-9)  # hypot(3, 4) / 2
    draws = sigma[:, None] * rng.standard_normal((3, 20_000))
    seen = level_at(MONTHS, draws.T, time).std()
    assert seen == pytest.approx(found[0], rel=0.02)  # 20,000 draws: 0.5 % at one sigma
    assert standard_error_at(MONTHS, rows, mid_month(MONTHS), 0.0) == pytest.approx(sigma)
