"""What large maps do faster, against the plain way of doing it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import scipy.fft
from scipy import ndimage

from magtiles.stages.field import spectral
from magtiles.stages.field.interpolate import add_splines, evaluate_spline
from magtiles.stages.field.prepare import PlaneMap
from magtiles.stages.field.spectral import forward, inverse


def test_splines_side_by_side_are_those_of_one_after_the_other():
    rng = np.random.default_rng(5)
    coefficients = rng.standard_normal((40, 50, 9)).astype(np.float32)
    row, column = rng.uniform(-3.0, 43.0, (30, 70)), rng.uniform(-3.0, 53.0, (30, 70))
    start = rng.standard_normal((9, 30, 70)).astype(np.float32)
    found, one = start.copy(), np.empty((30, 70), np.float32)
    add_splines(coefficients, row, column, found)
    for k in range(9):
        plane = np.ascontiguousarray(coefficients[..., k])
        evaluate_spline(plane, row, column, 1.0, np.zeros(2), one)
        # Single precision of sums of sixteen: measured 7e-7.
        assert np.abs(found[k] - start[k] - one).max() < 5e-6


@pytest.mark.parametrize("outside", [True, False])
@pytest.mark.parametrize("kind", ["none", "frame", "rows", "patch"])
def test_distances_are_those_of_a_distance_transform(kind, outside):
    gaps = np.zeros((30, 45), dtype=bool)
    if kind == "frame":
        gaps[:4] = gaps[:, :7] = gaps[:, -2:] = True
    elif kind == "rows":
        gaps[11:13] = True
    elif kind == "patch":
        gaps[10:15, 20:31] = True
    spacing = 250.0, 180.0
    found = PlaneMap.distance(SimpleNamespace(spacing=spacing), gaps, outside)
    ringed = np.pad(gaps, 1, constant_values=outside)
    if ringed.any():
        expected = ndimage.distance_transform_edt(~ringed, sampling=spacing)[1:-1, 1:-1]
        assert found == pytest.approx(expected, rel=1e-12)
    else:
        assert np.isinf(found).all()


def test_an_inverse_in_strips_is_the_whole_one(monkeypatch):
    monkeypatch.setattr(spectral, "_STRIP", 200)  # four rows at a time
    values = np.random.default_rng(6).standard_normal((35, 45))
    rows, columns = slice(3, 31), slice(5, 40)
    out = np.full((28, 35), np.nan)
    found = inverse(forward(values), values.shape, rows, columns, out)
    assert found is out
    whole = scipy.fft.irfft2(forward(values), s=values.shape)[rows, columns]
    assert np.abs(found - whole).max() < 1e-14
    assert np.abs(found - values[rows, columns]).max() < 1e-14
