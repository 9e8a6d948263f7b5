"""Classes of activity, season and local time."""

from __future__ import annotations

import numpy as np

from magtiles.catalog.kernels import activity_classes as classes


def test_stormy_begins_at_kp_3() -> None:
    found = classes.kp_class([0.0, 2.667, 3.0, 9.0, np.nan])
    assert found.tolist() == [0, 0, 1, 1, classes.ANY]


def test_seasons_are_those_of_the_hemisphere() -> None:
    months = np.arange("2016-01", "2017-01", dtype="datetime64[M]").astype("datetime64[ns]")
    north, south = classes.season(months, 45.0), classes.season(months, -45.0)
    assert [classes.SEASONS[i][0] for i in north] == list("wwee" + "ssss" + "eeww")
    assert np.array_equal(south, 2 - north)


def test_local_time_is_quarters_from_midnight() -> None:
    assert classes.local_time([0.0, 359.9, 360.0, 719.9, 720.0, 1439.9]).tolist() == [
        0, 0, 1, 1, 2, 3,
    ]  # fmt: skip
