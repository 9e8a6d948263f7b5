"""The whole chain, survey file to reader, against exact fields; measured in docs/accuracy.md."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from chain import BETWEEN, CASES, LEVELS, LIMITS, QUIET, YARDSTICK, Built, full_tensor

# Smaller than the surveys of docs/accuracy.md, so that they take seconds; no easier.
_SMALL = {"width_m": 200e3, "length_m": 150e3, "dipoles": 500}
# One of them has levels a factor of two apart too.
_ALL_LEVELS = tuple(QUIET.height_m + gain for gain in (1000.0, 2000.0, 4000.0, 5000.0))


_SPECS = [replace(case, **_SMALL) for case in CASES]
_SPECS[0] = replace(_SPECS[0], levels_m=_ALL_LEVELS)


@pytest.fixture(scope="module", params=_SPECS, ids=lambda spec: spec.name)
def built(request, tmp_path_factory):
    return Built(request.param, tmp_path_factory.mktemp(request.param.name))


@pytest.mark.parametrize("gain", LEVELS)
def test_as_good_as_a_plain_planar_fft(built, gain):
    ours, plain = built.errors(gain, built.at_nodes), built.planar_errors(gain)
    for quantity in ours:
        assert np.all(ours[quantity] <= YARDSTICK * plain[quantity]), quantity


@pytest.mark.parametrize("gain", LEVELS)
def test_within_absolute_limits_anywhere(built, gain):
    for positions in (built.at_nodes, built.off_nodes):
        for quantity, error in built.errors(gain, positions).items():
            assert np.all(error <= LIMITS[gain][quantity]), quantity


def test_gradient_of_the_total_is_that_of_the_truth(built):
    # Measured: 0.14 % toward north and east, 0.9 % down.
    assert np.all(built.gradient_errors(1000.0)["total"] < [0.003, 0.003, 0.012])


def test_gradient_of_the_vector_is_the_tensor(built):
    place = built.place(1000.0, built.off_nodes)
    _, gradient = built.anomaly.vector_with_gradient(*place)
    tensor = full_tensor(built.anomaly.tensor(*place))
    scale = np.sqrt((tensor**2).mean())
    # Measured: 0.05 %, of the splines.
    assert np.sqrt(((gradient - tensor) ** 2).mean()) < 0.002 * scale


@pytest.mark.parametrize("built", _SPECS[:1], indirect=True, ids=lambda spec: spec.name)
def test_between_levels_as_good_as_on_them(built):
    for gain, around in BETWEEN.items():
        here = built.errors(gain, built.off_nodes)
        levels = [built.errors(g, built.off_nodes) for g in around]
        for quantity, error in here.items():
            worst = np.maximum(*(level[quantity] for level in levels))
            assert np.all(error <= worst + 0.01), (gain, quantity)
        here = built.gradient_errors(gain)
        levels = [built.gradient_errors(g) for g in around]
        for quantity, error in here.items():
            worst = np.maximum(*(level[quantity] for level in levels))
            assert np.all(error <= worst + 0.02), (gain, quantity)
