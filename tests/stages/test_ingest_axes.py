"""Axes: regular within their rounding, and longitudes cut open in the right place."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from magtiles.schemas.errors import FormatError
from magtiles.stages.ingest.axes import regular_axis, wrapped_longitudes


@pytest.mark.parametrize(
    ("nodes", "message"),
    [
        ([0.0], "has 1 node; expected at least 2"),
        ([0.0, 1.0, np.nan], "index 2 is nan"),
        ([0.0, 1.0, 2.0, 3.5], r"from index 2 to 3 the step is 1.5, \+0.5"),
        ([0.0, 1.0, 2.01, 3.0], r"from index 1 to 2 the step is 1.01"),
        ([0.0, 1.0, 1.0, 2.0, 3.0], r"from index 1 to 2 the step is 0"),
        ([3.0, 2.0, 1.0, 2.0], r"from index 2 to 3 the step is 1, \+2"),
        ([5.0, 5.0, 5.0], "irregular"),
    ],
)
def test_irregular_axis_names_its_first_step(nodes, message):
    with pytest.raises(FormatError, match=message):
        regular_axis(np.array(nodes), 0.0, where="a.nc axis x")


@given(
    start=st.floats(-1e7, 1e7),
    step=st.floats(1e-2, 1e5),
    count=st.integers(2, 200),
    sign=st.sampled_from([-1, 1]),
)
def test_rounded_axis_is_restored(start, step, count, sign):
    exact = start + sign * step * np.arange(count)
    # A quarter of a thousandth of a step each: within what few printed digits leave.
    jitter = 2.5e-4 * step * np.sin(np.arange(count) * 12.9898)
    found = regular_axis(exact + jitter, 0.0, where="x")
    assert np.all(np.abs(found - exact) <= 2.6e-4 * step + 1e-9 * np.abs(exact))
    assert np.ptp(np.diff(found)) <= 1e-8 * step + 8 * np.spacing(np.abs(exact).max())


@given(
    west=st.floats(-360.0, 360.0),
    step=st.sampled_from([0.25, 1.0, 2.5, 10.0]),
    count=st.integers(2, 1440),
)
def test_longitudes_keep_their_meridians(west, step, count):
    count = min(count, int(360.0 / step))
    longitude = west + step * np.arange(count)
    found, columns = wrapped_longitudes(longitude, where="x")
    assert -180.0 <= found[0] < 180.0
    np.testing.assert_allclose(np.diff(found), step, atol=1e-9)
    away = (found - longitude[columns] + 180.0) % 360.0 - 180.0
    assert np.abs(away).max() < 1e-9
    assert sorted(columns) == list(range(count))


def test_more_than_one_turn_is_refused():
    with pytest.raises(FormatError, match="span 400"):
        wrapped_longitudes(np.arange(0.0, 401.0, 10.0), where="x")
