"""Turning products from a plane's axes to north and east, against matrices."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from magtiles.stages.field.rotation import rotate_to_ned

PRODUCTS = arrays(np.float32, (9, 2, 3), elements=st.floats(-1000, 1000, width=32))
ANGLES = arrays(np.float64, (2, 3), elements=st.floats(-np.pi, np.pi))
PLUNGES = arrays(np.float64, (2, 3), elements=st.floats(-np.pi / 2, np.pi / 2))


def matrices(five):
    nn, ne, nd, ee, ed = five.astype(float)
    rows = [[nn, ne, nd], [ne, ee, ed], [nd, ed, -(nn + ee)]]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


@settings(max_examples=60)
@given(PRODUCTS, ANGLES, PLUNGES, ANGLES, st.floats(-1.5, 1.5), st.floats(-3, 3))
def test_rotation(given_products, turn, plunge, azimuth, plunge_0, azimuth_0):
    """V' = R V, G' = R G R^T, T' = T + (R^T f - f0) . V; norms and the trace are kept."""
    north = np.stack([np.cos(turn), np.sin(turn)]).astype(np.float32)
    a, b, zero = *north.astype(float), np.zeros_like(turn)
    rotation = np.array([[a, b, zero], [-b, a, zero], [zero, zero, zero + 1]])
    rotation = np.moveaxis(rotation, (0, 1), (-2, -1))  # from (y, x, d) to (n, e, d)
    f = _unit(plunge, azimuth).astype(np.float32)
    f_0 = _unit(np.array(plunge_0), np.array(azimuth_0))
    out = given_products.copy()
    rotate_to_ned(out, north, f, f_0)

    vector = np.moveaxis(given_products[1:4].astype(float), 0, -1)
    tensor = matrices(given_products[4:])
    turned, found = matrices(out[4:]), np.moveaxis(out[1:4].astype(float), 0, -1)
    close = {"rtol": 0, "atol": 2e-3}  # float32 of up to 4000
    assert np.allclose(found, np.einsum("...ij,...j->...i", rotation, vector), **close)
    assert np.allclose(turned, rotation @ tensor @ np.swapaxes(rotation, -1, -2), **close)
    along = np.einsum("...ji,j...->...i", rotation, f.astype(float)) - f_0
    assert np.allclose(out[0], given_products[0] + (along * vector).sum(axis=-1), **close)
    assert np.allclose(np.linalg.norm(found, axis=-1), np.linalg.norm(vector, axis=-1), **close)
    norms = [np.linalg.norm(m, axis=(-2, -1)) for m in (turned, tensor)]
    assert np.allclose(*norms, **close)
    horizontal = [m[..., 0, 0] + m[..., 1, 1] for m in (turned, tensor)]
    assert np.allclose(*horizontal, **close)


def _unit(plunge, azimuth):
    return np.stack(
        [np.cos(plunge) * np.cos(azimuth), np.cos(plunge) * np.sin(azimuth), np.sin(plunge)]
    )
