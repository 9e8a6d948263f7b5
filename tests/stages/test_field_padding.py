"""Padding before a transform: room, continuity, and an end at the mean."""

from __future__ import annotations

import numpy as np
import pytest

from magtiles.stages.field.padding import pad, plan_padding


@pytest.mark.parametrize("shape", [(37, 90), (90, 37), (240, 181), (1, 12)])
@pytest.mark.parametrize("gain", [0.0, 150.0, 9000.0])
def test_sizes(shape, gain):
    padding = plan_padding(shape, (1000.0, 800.0), gain)
    for size, before, total in zip(shape, padding.offset, padding.shape, strict=True):
        assert total % 2 == 1  # no ambiguous Nyquist term
        assert before >= size // 2
        assert total - before - size >= size // 2
        factors = total
        for prime in (3, 5, 7, 11, 13):
            while factors % prime == 0:
                factors //= prime
        assert factors == 1


def test_large_maps_take_the_reach_of_the_kernels():
    padding = plan_padding((4000, 5000), (100.0, 50.0), 1000.0)
    assert 200 <= padding.offset[0] < 320  # 20 heights
    assert 400 <= padding.offset[1] < 560


def test_the_map_is_kept_its_border_continued_and_the_ends_at_the_mean():
    rng = np.random.default_rng(0)
    values = 40.0 + rng.normal(size=(41, 60)).cumsum(axis=0).cumsum(axis=1)
    padding = plan_padding(values.shape, (1000.0, 1000.0), 2000.0)
    padded = pad(values, padding)
    rows, columns = padding.interior
    assert padded.shape == padding.shape
    assert np.allclose(padded[padding.interior], values, rtol=0, atol=1e-9)
    spread = np.abs(values - values.mean()).max()
    reflected = padded[rows, columns.stop] - values[:, -2]
    assert np.abs(reflected).max() < 0.01 * spread
    for edge in (padded[0], padded[-1], padded[:, 0], padded[:, -1]):
        assert np.abs(edge - values.mean()).max() < 0.02 * spread
    # No jump, inside or across the seam of the periodic field, worse than the map's own.
    steps = [np.abs(np.diff(padded, axis=a, append=padded.take([0], a))).max() for a in (0, 1)]
    own = [np.abs(np.diff(values, axis=a)).max() for a in (0, 1)]
    assert steps[0] < 1.5 * own[0]
    assert steps[1] < 1.5 * own[1]
