"""Maps transformed block by block: against one transform, against exact dipoles, at the seams."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.fft
import xarray as xr
from grids import grid_of, products, projected_grid
from known import Field, relative_rms

from magtiles.pipeline.sample import DEMO, synthesize
from magtiles.schemas import contracts
from magtiles.schemas.errors import ContractError
from magtiles.stages.field import large
from magtiles.stages.field.blocks import plan_blocks
from magtiles.stages.field.components import (
    DeriveComponentsParams,
    derive_components,
    makes_blocks,
)
from magtiles.stages.field.decimation import passed, spline_matrix, thinning_matrix
from magtiles.stages.field.level import PRODUCTS, SIGMAS
from magtiles.stages.field.padding import pad, plan_padding
from magtiles.stages.field.prepare import prepare
from magtiles.stages.field.voids import FillVoidsParams, fill_voids
from magtiles.stages.field.windows import MapWindows, Reflection

SPACING_M = 500.0
TRUE_SCALE = "+proj=tmerc +lat_0=46 +lon_0=-120 +datum=WGS84"
ASKEW = "+proj=lcc +lat_1=30 +lat_2=60 +lat_0=45 +lon_0=-100 +datum=WGS84"
LOW = {"inclination_deg": 8.0, "declination_deg": 37.0}


def derive(grid: xr.Dataset, height_m: float = 0.0, **params) -> xr.Dataset:
    return derive_components(grid, params=DeriveComponentsParams(height_m=height_m, **params))


def red_noise(shape: tuple[int, int]) -> np.ndarray:
    """100 nT of a crust's kind, of wavelengths up to the map's, and 1 nT of white noise."""
    rng = np.random.default_rng(7)
    full = [n + 200 for n in shape]
    k = np.hypot(np.fft.fftfreq(full[0])[:, None], np.fft.rfftfreq(full[1]))
    k[0, 0] = np.inf
    spectrum = scipy.fft.rfft2(rng.standard_normal(full)) * k**-1.3 * np.exp(-25.0 * k)
    values = scipy.fft.irfft2(np.nan_to_num(spectrum), s=full)[: shape[0], : shape[1]]
    return 30.0 + 100.0 * values / values.std() + rng.standard_normal(shape)


def gapped(crs: str = TRUE_SCALE, spacing: float = SPACING_M) -> xr.Dataset:
    """A map that is not square, with a void across a seam and a coast, filled."""
    values = red_noise((320, 450))
    i, j = np.mgrid[:320, :450]
    values[(i - 150) ** 2 + (j - 225) ** 2 / 2 < 18**2] = np.nan
    values[j < 15 + 10 * np.sin(i / 20)] = np.nan
    y, x = (spacing * (np.arange(n) - n / 2) for n in values.shape)
    stated = {"line_spacing_m": 2 * spacing, "source_distance_m": 4 * spacing}
    return fill_voids(projected_grid(values, y, x, crs, **stated), params=FillVoidsParams())


@pytest.fixture(scope="module")
def true_scale() -> xr.Dataset:
    return gapped()


def group_of(name: str) -> str:
    if name == "magnetic_anomaly":
        return "magnetic_anomaly_uncertainty"
    return "vector_uncertainty" if name.startswith("anomaly") else "tensor_uncertainty"


def difference(one: xr.Dataset, blocked: xr.Dataset) -> dict[str, np.ndarray]:
    """Of each product, in sigma as one transform states it."""
    return {
        name: (blocked[name] - one[name]).values / one[group_of(name)].values for name in PRODUCTS
    }


@pytest.mark.parametrize(
    ("crs", "spacing", "gain", "params", "limit"),
    # Measured: 0.023, 0.011, 0.002, 0.033, 0.050 sigma; the last for each block's own scale.
    [
        pytest.param(TRUE_SCALE, 500.0, 0.0, {}, 0.04, id="surface"),
        pytest.param(TRUE_SCALE, 500.0, 2000.0, {}, 0.02, id="four-cells-up"),
        pytest.param(TRUE_SCALE, 500.0, 20000.0, {}, 0.02, id="forty-cells-up"),
        pytest.param(TRUE_SCALE, 500.0, 2000.0, LOW, 0.06, id="low-inclination"),
        pytest.param(ASKEW, 2000.0, 6000.0, {}, 0.08, id="resampled"),
    ],
)
def test_blocks_differ_from_one_transform_by_less_than_a_tenth_of_sigma(
    true_scale, crs, spacing, gain, params, limit
):
    grid = true_scale if crs == TRUE_SCALE else gapped(crs, spacing)
    assert prepare(grid).plane.is_source == (crs == TRUE_SCALE)
    one, blocked = derive(grid, gain, **params), derive(grid, gain, block_nodes=160, **params)
    found = difference(one, blocked)
    assert max(np.abs(values).max() for values in found.values()) < limit
    for name in SIGMAS:  # the same within 3 %: measured 2.8 % for the tensor at the surface
        assert np.abs(blocked[name] / one[name] - 1.0).max() < 0.05
    assert np.array_equal(one["quality_flag"], blocked["quality_flag"])
    # The gradient that a spline through the nodes has, at seams as elsewhere.
    sigma = one["tensor_uncertainty"].values / 1000.0 * spacing
    for name in PRODUCTS[:4]:
        error = (blocked[name] - one[name]).values.astype(float)
        for axis in (0, 1):
            inner = np.delete(sigma, -1, axis)
            assert (np.abs(np.diff(error, axis=axis)) / inner).max() < limit


def test_blocks_of_exact_dipoles():
    """A survey 240 x 180 km under the IGRF, four blocks: no less true than one transform."""
    quiet = {"noise_nt": 0.0, "void": False, "coast": False, "depth_m": (2500.0, 12000.0)}
    sample = synthesize(replace(DEMO, **quiet))
    grid = fill_voids(grid_of(sample), params=FillVoidsParams())
    for gain in (2000.0,):
        truth = sample.truth(sample.latitude, sample.longitude, sample.spec.height_m + gain)
        one, blocked = (
            relative_rms(inside(products(made)), inside(Field(*truth)))
            for made in (derive(grid, gain), derive(grid, gain, block_nodes=160))
        )
        for name, errors in blocked.items():
            # Measured: 0.999 to 1.001.
            assert (errors / one[name]).max() < 1.01


def inside(field: Field) -> Field:
    return Field(*(part[20:-20, 20:-20] for part in (field.total, field.vector, field.tensor)))


def test_what_blocks_make_keeps_the_contract(true_scale):
    axes = {"latitude": (45.5, 0.005, 200), "longitude": (-120.9, 0.006, 250)}
    made = derive(true_scale, 1000.0, block_nodes=160, **axes)
    contracts.check(made, "component-grid/1")
    one = derive(true_scale, 1000.0, **axes)
    assert made.variables.keys() == one.variables.keys()
    assert made.attrs.keys() == one.attrs.keys()
    for axis in ("inclination", "declination"):
        name = f"ambient_{axis}_deg"
        assert made.attrs[name] == pytest.approx(one.attrs[name], abs=1e-5)
    for name in one.variables:
        assert made[name].dtype == one[name].dtype
        assert str(made[name].attrs) == str(one[name].attrs)


@pytest.mark.parametrize("shape", [(300, 520), (64, 64), (1000, 90)])
def test_blocks_own_every_node_once_and_blend_to_one(shape, monkeypatch):
    monkeypatch.setattr(large, "_STRIP", 50)  # that cut blocks and overlaps
    blocks = plan_blocks(shape, (128, 100), (12, 20))
    ones = {
        b: np.ones((np.ptp(b.outer_rows), np.ptp(b.outer_columns))) for row in blocks for b in row
    }
    for name in ("anomaly_north", "quality_flag"):
        read = large.strips(blocks, name, lambda block, *part: ones[block][part])
        spans, strips = zip(*read, strict=True)
        assert [a for a, _ in spans] == [0, *(b for _, b in spans[:-1])]
        whole = np.concatenate(strips)
        assert whole.shape == shape
        assert np.abs(whole - 1.0).max() < 1e-15


def test_windows_are_those_of_the_padded_map(true_scale):
    plane_map, windows = prepare(true_scale), MapWindows.of(true_scale)
    padding = plan_padding(plane_map.values.shape, plane_map.spacing, 0.0)
    padded = pad(plane_map.values, padding)
    for rows, columns in (((-60, 40), (300, 520)), ((200, 440), (-100, 550)), ((5, 6), (7, 9))):
        window = windows.extended(rows, columns, padding)
        part = padded[
            slice(*(r + padding.offset[0] for r in rows)),
            slice(*(c + padding.offset[1] for c in columns)),
        ]
        assert window.values == pytest.approx(part, rel=0, abs=1e-10)
        inside = np.zeros(part.shape, dtype=bool)
        inside[max(-rows[0], 0) : 320 - rows[0], max(-columns[0], 0) : 450 - columns[0]] = True
        assert window.beyond[~inside].all()
        assert not window.void[~inside].any()


def test_resampled_windows_are_those_of_the_resampled_map():
    grid = gapped(ASKEW, 2000.0)
    plane_map, windows = prepare(grid), MapWindows.of(grid)
    assert not windows.plane.is_source
    rows, columns = (90, 170), (200, 310)
    window = windows.read(rows, columns)
    part = slice(*rows), slice(*columns)
    # Measured: 2e-4 nT of a map of 100.
    assert np.abs(window.values - plane_map.values[part]).max() < 1e-3
    assert np.array_equal(window.void, plane_map.void[part])
    assert np.array_equal(window.beyond, plane_map.beyond[part])


def test_thinning_keeps_sums_and_long_waves():
    axis, count = Reflection(600, 90, 100), 98
    matrix = thinning_matrix(axis, count)
    ratio = 790 / count
    assert matrix.sum() * ratio == pytest.approx(axis.weights.sum(), rel=1e-12)
    # A wave of 100 nodes, away from the ends, is what `passed` says of it.
    k = 2 * np.pi / 100
    thin = matrix @ np.cos(k * np.arange(600))
    at = np.arange(count) * ratio - 90
    inner = (at > 30) & (at < 570)
    assert thin[inner] == pytest.approx(passed(k, ratio) * np.cos(k * at[inner]), abs=1e-6)


def test_a_spline_matrix_reproduces_straight_lines():
    places = np.linspace(3.0, 12.0, 37)
    assert spline_matrix(places, 16) @ np.arange(16.0) == pytest.approx(places, abs=1e-12)
    around = spline_matrix(np.array([15.5, -0.5]), 16)
    assert around.sum(axis=1) == pytest.approx([1.0, 1.0])
    assert np.flatnonzero(around.toarray()[0]).tolist() == [0, 1, 14, 15]


def test_a_large_map_is_made_in_blocks(monkeypatch, true_scale):
    params = DeriveComponentsParams()
    assert not makes_blocks(true_scale, params)
    monkeypatch.setattr(large, "LARGEST", 320 * 450)
    assert not makes_blocks(true_scale, params)  # as large as may be
    monkeypatch.setattr(large, "LARGEST", 320 * 450 - 1)
    assert makes_blocks(true_scale, params)
    # Some 3.4 times as many nodes as the map has.
    wide = DeriveComponentsParams(latitude=(45.5, 0.002, 700), longitude=(-120.9, 0.002, 700))
    monkeypatch.setattr(large, "LARGEST", 320 * 450)
    assert makes_blocks(true_scale, wide)


def test_voids_are_refused_by_name(true_scale):
    grid = true_scale.copy(deep=True)
    grid["magnetic_anomaly"][201, 44] = np.nan
    with pytest.raises(ContractError, match=r"magnetic_anomaly\[201, 44\]"):
        derive(grid, block_nodes=160)


def test_a_lattice_that_leaves_the_map_is_beyond_coverage(true_scale):
    far = {"latitude": (44.0, 0.02, 150), "longitude": (-123.0, 0.04, 150)}
    made = derive(true_scale, 1000.0, block_nodes=160, **far)
    assert np.isfinite(made["magnetic_anomaly"]).all()
    assert (made["quality_flag"][[0, -1]] & 2 > 0).all()
