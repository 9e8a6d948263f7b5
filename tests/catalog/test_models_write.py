"""Models written as files come back as they were."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from gauss import random_crust, static

from magtiles.catalog.models import (
    FieldModel,
    cof_text,
    load_igrf,
    parse_model,
    power_spectrum,
    shc_text,
)
from magtiles.schemas.errors import QueryError


def with_rates(degree: int = 70) -> FieldModel:
    rates = random_crust(1, degree, 20.0, seed=2)
    return dataclasses.replace(
        static(random_crust(1, degree, 300.0), "RANDOM"),
        epochs=np.array([2025.0]),
        secular_variation=rates,
        valid=(2025.0, 2030.0),
    )


def test_cof_with_secular_variation():
    """Six decimals."""
    model = with_rates()
    back = parse_model(cof_text(model, made="01/01/2025"), "random.COF")
    assert (back.name, back.n_min, back.n_max) == ("RANDOM", 1, 70)
    assert (back.epochs.tolist(), back.valid) == ([2025.0], (2025.0, 2030.0))
    np.testing.assert_allclose(back.coefficients, model.coefficients, rtol=0, atol=5.1e-7)
    np.testing.assert_allclose(back.secular_variation, model.secular_variation, rtol=0, atol=5.1e-7)
    assert cof_text(back, made="01/01/2025") == cof_text(model, made="01/01/2025")


def test_cof_of_a_static_crust():
    model = static(random_crust(16, 40, 100.0), "CRUST").degrees(16, 40)
    back = parse_model(cof_text(model), "crust.COF")
    assert (back.n_min, back.n_max, back.secular_variation) == (16, 40, None)
    assert back.valid == (-math.inf, math.inf)
    np.testing.assert_allclose(back.coefficients, model.coefficients, rtol=0, atol=5.1e-7)


def test_cof_lines_are_those_of_the_wmm():
    lines = cof_text(with_rates(2), made="11/13/2024").splitlines()
    assert lines[0] == "    2025.0            RANDOM           11/13/2024"
    assert ["".join(line.split()[:2]) for line in lines[1:6]] == ["10", "11", "20", "21", "22"]
    assert all(len(line.split()) == 6 for line in lines[1:6])
    assert lines[6:] == ["9" * 48] * 2


@pytest.mark.parametrize(
    "model", [load_igrf(), dataclasses.replace(with_rates(2), name="two words")]
)
def test_cof_knows_one_epoch_and_one_word(model):
    with pytest.raises(QueryError, match=r"COF: .*one epoch, and a name of one word"):
        cof_text(model)


def test_shc_keeps_every_digit_of_every_epoch():
    igrf = load_igrf()
    back = parse_model(shc_text(igrf, "a comment"), "igrf.shc")
    np.testing.assert_array_equal(back.coefficients, igrf.coefficients)
    np.testing.assert_array_equal(back.epochs, igrf.epochs)
    assert back.valid == igrf.valid


def test_shc_turns_secular_variation_into_a_last_epoch():
    model = with_rates(12)
    back = parse_model(shc_text(model), "random.shc")
    assert (back.epochs.tolist(), back.valid) == ([2025.0, 2030.0], (2025.0, 2030.0))
    for date in (2025.0, 2026.7, 2030.0):
        np.testing.assert_allclose(back.at(date), model.at(date), rtol=0, atol=1e-11)


def test_shc_of_a_static_model_is_static():
    model = static(random_crust(3, 9, 100.0)).degrees(3, 9)
    back = parse_model(shc_text(model), "crust.shc")
    assert (back.n_min, back.n_max, back.valid) == (3, 9, (-math.inf, math.inf))
    np.testing.assert_array_equal(back.coefficients, model.coefficients)


def test_shc_cannot_say_that_a_model_holds_at_one_date():
    model = dataclasses.replace(static(random_crust(1, 3, 100.0)), valid=(2020.0, 2020.0))
    with pytest.raises(QueryError, match="valid at 2020 only"):
        shc_text(model)


def test_power_by_degree():
    """Of IGRF-14 in 2025 by hand: 2 (g10^2 + g11^2 + h11^2); and of a field made to a power."""
    gauss = load_igrf().at(2025.0)
    assert power_spectrum(gauss)[0] == pytest.approx(2.0 * np.sum(gauss[:3] ** 2))
    assert power_spectrum(gauss).shape == (13,)
    assert power_spectrum(random_crust(1, 150, 100.0)).sum() == pytest.approx(100.0**2, rel=0.03)
