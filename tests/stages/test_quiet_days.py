"""Choosing quiet days: from the list, from Kp as the list is made, and from the record."""

from __future__ import annotations

import csv
import logging
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import xarray as xr
from daily import Floats, daily, gauss_markov, kp_index, listed, quiet_list, record, times

from magtiles.catalog.flags import QuietDayChoice as How
from magtiles.schemas.errors import CoverageError
from magtiles.stages.temporal.baseline import QuietDayBaselineParams, quiet_day_baseline
from magtiles.stages.temporal.quiet_days import kp_quiet_days

LIST = {"2024-03": [12, 7, 20, 3, 28, 15, 9, 22, 5, 30]}
EAST = 20.0


def march(seed: int = 1, noise_nt: float = 0.5) -> tuple[np.ndarray, Floats]:
    """Minutes from 29 February to 2 April, and a quiet record of them (3, time)."""
    time = times("2024-02-29", "2024-04-02", 300.0)
    rng = np.random.default_rng(seed)
    noise = [gauss_markov(rng, time.size, 300.0, noise_nt, 3600.0) for _ in range(3)]
    return time, daily(time, EAST) + np.array([[21e3], [3e3], [47e3]]) + noise


def baseline(
    time: np.ndarray, vector: Floats, index: xr.Dataset | None = None, **params: float
) -> xr.Dataset:
    series = record(time, vector, longitude=EAST, cadence_s=300.0)
    made = quiet_day_baseline(series, params=QuietDayBaselineParams(**params), index=index)
    return made.sel(month=slice("2024-03", "2024-03"))


def used(made: xr.Dataset) -> list[int]:
    days = made["quiet_day"].values[0, 0]
    return [int(str(d)[8:10]) for d in days[~np.isnat(days)]]


def without(time: np.ndarray, vector: Floats, *days: int, hours: int = 24) -> Floats:
    """A record that lacks the first hours of some local days of March."""
    gap = np.zeros(time.size, bool)
    for day in days:
        start = np.datetime64(f"2024-03-{day:02d}", "ns") - np.timedelta64(80, "m")  # 20 E
        gap |= (time >= start) & (time < start + np.timedelta64(hours, "h"))
    return np.where(gap, np.nan, vector)


class Expect(NamedTuple):
    missing: tuple[int, ...]
    hours: int
    used: list[int]
    how: How
    id: str


STANDBY = How.LIST | How.STANDBY
OF_THE_LIST = [
    Expect((), 24, [12, 7, 20, 3, 28], How.LIST, "the five of the list"),
    Expect((7,), 24, [12, 20, 3, 28, 15], STANDBY, "the sixth stands in"),
    Expect((12, 7, 15, 9), 24, [20, 3, 28, 22, 5], STANDBY, "stand-ins may lack too"),
    Expect((7,), 2, [12, 7, 20, 3, 28], How.LIST, "two hours may be missing"),
    Expect((7,), 3, [12, 20, 3, 28, 15], STANDBY, "three hours may not"),
    Expect(
        (12, 7, 20, 3, 15, 9), 24, [28, 22, 5, 30], STANDBY | How.FEWER_THAN_FIVE, "four are left"
    ),
]


@pytest.mark.parametrize("case", OF_THE_LIST, ids=lambda c: c.id)
def test_days_of_the_list(case: Expect) -> None:
    time, vector = march()
    lacking = without(time, vector, *case.missing, hours=case.hours)
    made = baseline(time, lacking, quiet_list(LIST))
    assert used(made) == case.used
    assert made["quiet_day_choice"].values[0, 0] == case.how


def test_a_month_with_too_few_days_is_nan_named_and_flagged(
    caplog: pytest.LogCaptureFixture,
) -> None:
    time, vector = march()
    lacking = without(time, vector, *(d for d in LIST["2024-03"] if d not in (5, 30)))
    with caplog.at_level(logging.WARNING):
        series = record(time, lacking, longitude=EAST, cadence_s=300.0)
        # The first day of April is whole, and makes that month the second.
        both = quiet_list(LIST | {"2024-04": [1, 2, 3, 4, 5, 6, 7, 8, 9, 10]})
        with pytest.raises(CoverageError, match="no month has 3 usable quiet days; the best has 2"):
            quiet_day_baseline(series, params=QuietDayBaselineParams(), index=both)
    assert "BOU 2024-03: 2 usable quiet days: no baseline" in caplog.text


def test_kp_stands_in_for_the_list_and_says_so() -> None:
    time, vector = march()
    kp = np.full((31, 8), 3.0)
    kp[[4, 8, 13, 18, 23]] = np.array([0.333, 0.667, 1.0, 1.333, 1.667])[:, None]
    kp[27] = 2.0
    made = baseline(time, vector, kp_index("2024-03-01", kp))
    assert used(made) == [5, 9, 14, 19, 24]
    assert made["quiet_day_choice"].values[0, 0] == How.KP
    made = baseline(time, without(time, vector, 9), kp_index("2024-03-01", kp))
    assert used(made) == [5, 14, 19, 24, 28]
    assert made["quiet_day_choice"].values[0, 0] == How.KP | How.STANDBY


@pytest.mark.parametrize("given", [False, True], ids=["no index", "an index of another month"])
def test_the_record_chooses_where_no_index_does(
    given: bool, caplog: pytest.LogCaptureFixture
) -> None:
    time, vector = march(noise_nt=0.3)
    calm = [2, 11, 17, 23, 29]
    rng = np.random.default_rng(9)
    for day in range(1, 32):
        inside = (time >= np.datetime64(f"2024-03-{day:02d}", "ns")) & (
            time < np.datetime64(f"2024-03-{day:02d}", "ns") + np.timedelta64(1, "D")
        )
        if day not in calm:
            vector[0, inside] += gauss_markov(rng, inside.sum(), 300.0, 15.0, 3000.0)
    index = quiet_list({"2024-05": LIST["2024-03"]}) if given else None
    with caplog.at_level(logging.WARNING):
        made = baseline(time, vector, index)
    assert sorted(used(made)) == calm
    assert made["quiet_day_choice"].values[0, 0] == How.RECORD
    assert ("neither ranks nor all Kp" in caplog.text) == given


def test_the_rule_of_kp_makes_the_lists_of_gfz(real_data: Path) -> None:
    with (real_data / "indices/geoclimate_GFZ_Potsdam_Kp.csv").open() as file:
        rows = list(csv.reader(file))[1:]
    kp = np.array([[float(word or "nan") for word in row[1:9]] for row in rows])
    index = kp_index(rows[0][0], kp)
    months = {m: days for m, days in listed(real_data).items() if m >= "2006-01"}
    chosen = {m: [int(str(d)[8:]) for d in kp_quiet_days(index, np.datetime64(m))] for m in months}
    assert len(months) == 168
    # Measured: the five of every month; the ten in their order in 165 of 168.
    assert [m for m in months if set(chosen[m][:5]) != set(months[m][:5])] == []
    assert sum(chosen[m] == months[m] for m in months) >= 165


def test_kp_ranks_no_month_of_which_a_value_is_missing() -> None:
    kp = np.full((31, 8), 2.0)
    assert kp_quiet_days(kp_index("2024-03-01", kp), np.datetime64("2024-03")).size == 10
    kp[30, 7] = np.nan
    assert kp_quiet_days(kp_index("2024-03-01", kp), np.datetime64("2024-03")).size == 0
    assert kp_quiet_days(kp_index("2024-03-01", kp[:30]), np.datetime64("2024-03")).size == 0
    assert kp_quiet_days(quiet_list(LIST), np.datetime64("2024-03")).size == 0
