"""Stated sigmas are honest: half to nine tenths of all errors lie inside one of them.

Errors of long wavelength are nearly one draw a map, and a void is one draw of a heavy-tailed
lot. The demo, which everyone sees, must do well by itself; where luck has the say, many surveys
are pooled.
"""

from __future__ import annotations

import pytest
from chain import Built
from honesty import PLACES, fractions, pooled

from magtiles.pipeline.sample import DEMO

GAINS = (0.0, 1000.0, 2000.0, 4000.0, 8000.0)
QUANTITIES = ("total", "vector", "tensor")


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    return Built(DEMO, tmp_path_factory.mktemp("demo")).coverage(GAINS)


@pytest.mark.parametrize("quantity", QUANTITIES)
@pytest.mark.parametrize("place", PLACES)
def test_demo_as_the_reader_answers(demo, quantity, place):
    found = fractions(demo)
    for gain in GAINS:
        assert 0.5 < found[gain, quantity, place] < 0.9, gain


@pytest.fixture(scope="module")
def many():
    """24 surveys of six voids each, on the lowest and the highest level."""
    return fractions(pooled(range(1, 25), (0.0, 8000.0)))


@pytest.mark.parametrize("gain", [0.0, 8000.0])
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("quantity", QUANTITIES)
def test_many_surveys(many, gain, place, quantity):
    assert 0.5 < many[gain, quantity, place] < 0.9
