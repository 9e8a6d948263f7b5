"""Models between and beyond their epochs, dates, and choice of degrees."""

from __future__ import annotations

import subprocess
import sys
from datetime import UTC, date, datetime, timedelta, timezone
from typing import Any

import numpy as np
import pytest
from gauss import RADIUS_KM, random_crust, static

from magtiles.catalog.kernels.harmonics import count
from magtiles.catalog.models import (
    FieldModel,
    decimal_year,
    evaluate,
    evaluate_grid,
    load_igrf,
)
from magtiles.schemas.errors import QueryError


def varying(secular_variation: bool = True) -> FieldModel:
    values = np.stack([random_crust(1, 8, 1000.0, seed) for seed in range(3)])
    rates = random_crust(1, 4, 30.0, seed=3)
    rates = np.concatenate([rates, np.zeros(count(8) - count(4))])
    epochs = np.array([2000.0, 2001.0, 2005.0])
    sv = rates if secular_variation else None
    return FieldModel("test", 1, 8, RADIUS_KM, epochs, values, sv, (2000.0, 2010.0))


@pytest.mark.parametrize(
    ("when", "year"),
    [
        ("2020-01-01", 2020.0),
        ("2020-07-02T00:00", 2020.5),
        ("2019-07-02T12:00:00Z", 2019.5),
        ("2020-07-02T02:00+02:00", 2020.5),
        ("2024.25", 2024.25),
        (1987, 1987.0),
        (date(2021, 1, 1), 2021.0),
        (datetime(2019, 7, 2, 12, tzinfo=UTC), 2019.5),
        (datetime(2019, 7, 2, 14, tzinfo=timezone(timedelta(hours=2))), 2019.5),
        (np.datetime64("2000-12-31T12", "ns"), 2000.0 + 365.5 / 366.0),
        (np.array(["1900-07-02T12", "2000-07-02"], dtype="M8[ns]"), [1900.5, 2000.5]),
        (["2019-01-01", "2020-07-02"], [2019.0, 2020.5]),
        ([datetime(2019, 7, 2, 12, tzinfo=UTC), date(2020, 7, 2)], [2019.5, 2020.5]),
    ],
)
def test_decimal_years(when: Any, year: Any) -> None:
    np.testing.assert_allclose(decimal_year(when), year, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("when", "message"),
    [
        ("June", "date is 'June'"),
        ("2020-13-01", "date is '2020-13-01'"),
        (np.nan, r"date\[0\]: date is missing"),
        (np.array(["2020-01-01", "NaT"], dtype="M8[D]"), r"date\[1\]: date is missing"),
        (None, r"date\[0\]: date is missing"),
        (True, "date is True"),
    ],
)
def test_dates_that_are_none(when: Any, message: str) -> None:
    with pytest.raises(QueryError, match=message):
        decimal_year(when)


def test_between_and_after_epochs() -> None:
    model = varying()
    c, sv = model.coefficients, model.secular_variation
    assert sv is not None
    for year, expected in (
        (2000.0, c[0]),
        (2000.25, 0.75 * c[0] + 0.25 * c[1]),
        (2004.0, 0.25 * c[1] + 0.75 * c[2]),
        (2005.0, c[2]),
        (2007.0, c[2] + 2.0 * sv),
    ):
        np.testing.assert_allclose(model.at(year), expected, rtol=0, atol=1e-12)
    beyond = model.at(2012.0, allow_extrapolated=True)
    np.testing.assert_allclose(beyond, c[2] + 7.0 * sv, rtol=0, atol=1e-12)
    before = model.at(1999.0, allow_extrapolated=True)
    np.testing.assert_allclose(before, 2.0 * c[0] - c[1], rtol=0, atol=1e-12)
    straight = varying(secular_variation=False).at(2009.0, allow_extrapolated=True)
    np.testing.assert_allclose(straight, 2.0 * c[2] - c[1], rtol=0, atol=1e-12)


@pytest.mark.parametrize("ask", [evaluate, evaluate_grid], ids=["points", "grid"])
def test_dates_outside_the_validity(ask: Any) -> None:
    model = varying()
    place = ([10.0], [20.0], [0.0])
    with pytest.raises(QueryError) as caught:
        ask(model, *place, "2010-01-02")
    for part in ("2010.0027", "validity of test", "2000 to 2010", "--allow-extrapolated"):
        assert part in str(caught.value)
    assert np.isfinite(ask(model, *place, "2010-01-02", allow_extrapolated=True)).all()
    assert model.covers(["2010-01-01", "2010-01-02"]).tolist() == [True, False]


def test_a_date_for_each_sample() -> None:
    model = varying()
    rng = np.random.default_rng(6)
    lat, lon = rng.uniform(-90.0, 90.0, 60), rng.uniform(-180.0, 180.0, 60)
    years = rng.uniform(2000.0, 2010.0, 60)
    together, slopes = evaluate(model, lat, lon, 100.0, years, gradient=True)
    for i, year in enumerate(years):
        then = static(model.at(year))
        alone, slope = evaluate(then, lat[i], lon[i], 100.0, 2020.0, gradient=True)
        np.testing.assert_allclose(together[i], alone, rtol=0, atol=1e-9)
        np.testing.assert_allclose(slopes[i], slope, rtol=0, atol=1e-10)
    grid = evaluate_grid(model, lat[:4], lon[:5], 100.0, 2003.3)
    points = evaluate(model, lat[:4, None], lon[:5], 100.0, 2003.3)
    np.testing.assert_allclose(grid[0], points, rtol=0, atol=1e-9)


def test_degrees_add_up() -> None:
    model = varying()
    parts = [model.degrees(1, 3), model.degrees(4, 15)]
    assert [(p.n_min, p.n_max) for p in parts] == [(1, 3), (4, 8)]
    assert parts[0].coefficients.shape == (3, count(3))
    total = sum(evaluate(p, 45.0, 7.0, 0.0, 2007.5) for p in parts)
    np.testing.assert_allclose(total, evaluate(model, 45.0, 7.0, 0.0, 2007.5), rtol=0, atol=1e-9)
    with pytest.raises(QueryError, match="no degrees 9 to 20; expected some of 1 to 8"):
        model.degrees(9, 20)


def test_a_model_of_zeros_has_no_field() -> None:
    model = static(np.zeros(count(3)))
    field, tensor = evaluate(model, [0.0, 90.0], 0.0, 0.0, 2020.0, gradient=True)
    assert not field.any()
    assert not tensor.any()
    assert not evaluate_grid(model, [0.0], [0.0], 0.0, 2020.0).any()


@pytest.mark.parametrize("n_max", [7, 9])
def test_coefficients_must_fit_the_degree(n_max: int) -> None:
    with pytest.raises(QueryError, match=rf"expected \(1, {count(n_max)}\) for degree {n_max}"):
        FieldModel(
            "x", 1, n_max, RADIUS_KM, np.array([2020.0]), np.zeros((1, count(8))), None, (0.0, 1.0)
        )


def test_core_field_gradient_of_middle_latitudes() -> None:
    """Some 4 to 5 nT/km north, and 20 to 30 down, as the design says."""
    vector, tensor = evaluate(load_igrf(), 45.0, -104.0, 0.0, "2020-01-01", gradient=True)
    slope = vector @ tensor / np.linalg.norm(vector)
    assert 3.0 < slope[0] < 6.0
    assert 20.0 < slope[2] < 30.0


@pytest.mark.parametrize("axis", [[], [[1.0]], 5.0])
def test_axes_of_a_grid(axis: Any) -> None:
    with pytest.raises(QueryError, match="latitudes of shape"):
        evaluate_grid(varying(), axis, [0.0], 0.0, 2003.0)


def test_importing_models_compiles_nothing() -> None:
    program = "import sys, magtiles.catalog.models; print(*{m.split('.')[0] for m in sys.modules})"
    loaded = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout.split()
    assert "numpy" in loaded
    assert not {"numba", "pandas", "ppigrf", "scipy", "xarray"} & set(loaded)
