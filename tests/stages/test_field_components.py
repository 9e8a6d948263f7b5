"""Vector, tensor and continuation against exact dipoles, identities and another library."""

from __future__ import annotations

from dataclasses import replace

import harmonica
import numpy as np
import pytest
import xarray as xr
from grids import grid_of, products, projected_grid
from known import Field, relative

from magtiles.catalog.kernels.geodesy import metres_per_degree
from magtiles.pipeline.sample import DEMO, ConstantField, Sample, synthesize
from magtiles.schemas import contracts
from magtiles.schemas.errors import ContractError, CoverageError, MagtilesError, ParameterError
from magtiles.stages.field.components import DeriveComponentsParams, derive_components
from magtiles.stages.field.continuation import UpwardContinueParams, upward_continue
from magtiles.stages.field.padding import pad, plan_padding
from magtiles.stages.field.plane import choose_plane

INNER = np.s_[10:-10, 10:-10]
# All sources well inside, so that nothing regional, which no map can know, comes in.
TURNED = replace(
    DEMO,
    width_m=130e3,
    length_m=90e3,
    dipoles=60,
    depth_m=(3000.0, 5000.0),
    margin_m=-30e3,
    noise_nt=0.0,
    void=False,
    coast=False,
    ambient=ConstantField(54000.0, 62.0, 37.0),
)
ANGLES = {"inclination_deg": 62.0, "declination_deg": 37.0}


def derive(grid: xr.Dataset, height_m: float = 0.0, **params) -> xr.Dataset:
    return derive_components(grid, params=DeriveComponentsParams(height_m=height_m, **params))


def inner_errors(sample: Sample, components: xr.Dataset, gain: float) -> dict[str, np.ndarray]:
    truth = sample.truth(sample.latitude, sample.longitude, sample.spec.height_m + gain)
    found = (values[INNER] for _, values in products(components))
    true = (values[INNER] for _, values in Field(*truth))
    names = ("total", "vector", "tensor")
    return {n: relative(f, t) for n, f, t in zip(names, found, true, strict=True)}


@pytest.fixture(scope="module")
def turned() -> Sample:
    return synthesize(TURNED)


@pytest.fixture(scope="module")
def varying() -> Sample:
    """800 km wide, under the IGRF, whose direction turns by some 6 degrees over it."""
    size = {"spacing_m": 4e3, "width_m": 800e3, "length_m": 480e3, "margin_m": -100e3}
    return synthesize(replace(TURNED, ambient=None, depth_m=(12e3, 20e3), **size))


@pytest.mark.parametrize(
    ("gain", "total", "vector", "tensor"),
    # Measured: 0.08, 0.5, 0.7 %; 0.25, 0.6, 0.4 %; 0.6, 0.9, 0.5 %.
    [(0.0, 0.0015, 0.008, 0.011), (1000.0, 0.004, 0.009, 0.007), (3000.0, 0.009, 0.014, 0.008)],
)
def test_exact_dipoles_under_a_turned_field(turned, gain, total, vector, tensor):
    """A grid that is not square, declination 37 degrees: swapped axes would be 100 % off."""
    errors = inner_errors(turned, derive(grid_of(turned), gain, **ANGLES), gain)
    assert errors["total"].max() < total
    assert errors["vector"].max() < vector
    assert errors["tensor"].max() < tensor


def test_a_direction_that_varies_is_followed(varying):
    components = derive(grid_of(varying), 4000.0)
    errors = inner_errors(varying, components, 4000.0)
    # Measured: 0.25, 0.7, 0.5 %; with a constant direction 0.26, 1.6, 1.4 %.
    assert errors["total"].max() < 0.004
    assert errors["vector"].max() < 0.010
    assert errors["tensor"].max() < 0.007
    constant = derive(
        grid_of(varying),
        4000.0,
        inclination_deg=components.attrs["ambient_inclination_deg"],
        declination_deg=components.attrs["ambient_declination_deg"],
    )
    assert inner_errors(varying, constant, 4000.0)["tensor"].max() > 2.0 * errors["tensor"].max()


def test_the_total_is_the_vector_along_the_ambient_field(varying):
    components = derive(grid_of(varying), 4000.0)
    found = products(components)
    ambient = np.stack([components[f"ambient_{a}"] for a in ("north", "east", "down")], axis=-1)
    # Everywhere, to float32 of some 500 nT. Measured: 8e-5 nT.
    assert np.abs((ambient * found.vector).sum(axis=-1) - found.total).max() < 3e-4


def test_contracts_are_kept(turned):
    grid = grid_of(turned)
    contracts.check(grid, "anomaly-grid/1")
    contracts.check(derive(grid, 1000.0), "component-grid/1")
    lifted = upward_continue(grid, params=UpwardContinueParams(height_m=1000.0))
    contracts.check(lifted, "anomaly-grid/1")


def test_tensor_is_the_derivative_of_the_vector(turned):
    """By differences over the nodes of a geographic lattice and over 120 m of height.

    Nine derivatives: that the tensor is symmetric (no curl) and without trace (no divergence)
    is what they say of the vector, since the grid holds only five.
    """
    south, west = turned.latitude.mean() - 0.15, turned.longitude.mean() - 0.2
    axes = {"latitude": (south, 0.004, 75), "longitude": (west, 0.006, 66)}
    low, middle, high = (
        derive(grid_of(turned), 1000.0 + step, **axes, **ANGLES) for step in (-60.0, 0.0, 60.0)
    )
    metres = metres_per_degree(middle["latitude"].values, TURNED.height_m + 1000.0)
    vector, tensor = products(middle).vector, products(middle).tensor
    nn, ne, nd, ee, ed = np.moveaxis(tensor, -1, 0)
    north = _central(vector, 0) / (0.004e-3 * metres[0][:, None, None])
    east = _central(vector, 1) / (0.006e-3 * metres[1][:, None, None])
    down = (products(low).vector - products(high).vector) / 0.12
    inside = np.s_[3:-3, 3:-3]
    # Measured: 0.1 %, of the differences' own.
    for differences, row in (
        (north, (nn, ne, nd)),
        (east, (ne, ee, ed)),
        (down, (nd, ed, -nn - ee)),
    ):
        errors = relative(differences[inside], np.stack(row, axis=-1)[inside])
        assert errors.max() < 0.002


def _central(values: np.ndarray, axis: int) -> np.ndarray:
    """Fourth-order central differences per node; wrong at two nodes from either end."""
    one = np.roll(values, -1, axis) - np.roll(values, 1, axis)
    two = np.roll(values, -2, axis) - np.roll(values, 2, axis)
    return (8.0 * one - two) / 12.0


@pytest.mark.filterwarnings("ignore::FutureWarning")  # of what harmonica rests on
def test_continuation_against_harmonica(turned):
    """The same padded samples through another library's exp(-k h), under a vertical field.

    Any other ambient direction varies on the plane, which is taken care of, at some 1e-4.
    """
    grid = grid_of(turned)
    values = grid["magnetic_anomaly"].values
    spacing = 1000.0 / choose_plane(grid).scale
    padding = plan_padding(values.shape, (spacing, spacing), 2000.0)
    coordinates = {d: spacing * np.arange(n) for d, n in zip("yx", padding.shape, strict=True)}
    padded = xr.DataArray(pad(values, padding), coords=coordinates, dims=("y", "x"))
    theirs = harmonica.upward_continuation(padded, 2000.0).values[padding.interior]
    lifted = derive(grid, 2000.0, inclination_deg=90.0, declination_deg=0.0)
    error = products(lifted).total - theirs
    # Single precision. Measured: below 1e-5 of the rms.
    assert np.sqrt((error[INNER] ** 2).mean()) < 1e-5 * theirs.std()


@pytest.mark.parametrize("wavelength_cells", [6.0, 40.0])
@pytest.mark.parametrize("gain", [0.0, 1000.0])
def test_a_wave_is_kept_and_lifted_exactly(wavelength_cells, gain):
    x, y = 500e3 + 1000.0 * np.arange(180), 5.1e6 + 1000.0 * np.arange(161)
    k = 2 * np.pi / (1000.0 * wavelength_cells)
    phase = k * np.add.outer(0.8 * (y - y.mean()), 0.6 * (x - x.mean()))
    grid = projected_grid(100.0 * np.cos(phase), y, x)
    found = derive(grid, gain)["magnetic_anomaly"].values
    scale = choose_plane(grid).scale
    expected = 100.0 * np.cos(phase) * np.exp(-k * scale * gain)
    middle = np.s_[70:-70, 80:-80]
    assert np.abs(found - expected)[middle].max() < 0.04  # nT. Measured: 0.02 and less


def test_a_constant_map_has_the_vector_of_sources_without_strike():
    """Tensor zero, f . vector the constant; the rest from isotropic random sources, by regression.

    A cluster of wavenumbers in all azimuths: B along each axis against T = f . B.
    """
    y, x = 5.1e6 + 1000.0 * np.arange(90), 500e3 + 1000.0 * np.arange(130)
    components = derive(projected_grid(np.full((90, 130), 5.0), y, x), 2000.0, **ANGLES)
    found = products(components)
    inclination, declination = np.radians([62.0, 37.0])
    f = np.array(
        [
            np.cos(inclination) * np.cos(declination),
            np.cos(inclination) * np.sin(declination),
            np.sin(inclination),
        ]
    )
    azimuth = 2 * np.pi * np.arange(720) / 720
    unit = np.stack([1j * np.cos(azimuth), 1j * np.sin(azimuth), np.ones(720)], axis=-1)
    total = unit @ f
    slope = (unit * total.conj()[:, None]).real.mean(axis=0) / (np.abs(total) ** 2).mean()
    assert found.vector[45, 65] == pytest.approx(5.0 * slope, rel=1e-3)
    assert found.vector @ f == pytest.approx(5.0, rel=1e-4)
    assert np.abs(found.tensor).max() < 1e-9


def test_below_the_survey_with_permission(turned):
    """1 km down through 1 nT of noise: flagged, less sure, and honestly so."""
    noise = np.random.default_rng(4).normal(size=turned.exact.shape)
    noisy = grid_of(turned, turned.exact + noise, sigma=1.0)
    down = derive(noisy, -1000.0, allow_downward_continuation=True, **ANGLES)
    assert np.all(down["quality_flag"].values & 4)
    surface = derive(noisy, **ANGLES)
    for name in ("magnetic_anomaly", "vector", "tensor"):
        sigma = f"{name}_uncertainty"
        assert down[sigma].values.mean() > 3.0 * surface[sigma].values.mean()
    truth = turned.truth(turned.latitude, turned.longitude, TURNED.height_m - 1000.0)
    error = np.abs(products(down).total - truth[0])[INNER]
    # Measured: 9.5 nT in rms, of 125; 69 % within one sigma.
    assert 0.5 < (error < down["magnetic_anomaly_uncertainty"].values[INNER]).mean() < 0.9
    assert np.sqrt((error**2).mean()) < 12.0


def test_noise_does_not_explode_however_far_down(turned):
    """Where signal is no more than noise, the damped factor is at most a half."""
    noise = np.random.default_rng(4).normal(size=turned.exact.shape)
    down = derive(grid_of(turned, noise, sigma=1.0), -8000.0, allow_downward_continuation=True)
    assert products(down).total.std() < 0.5


def test_low_inclination_is_flagged_and_less_sure(turned):
    """The same map as if under 10 and under 62 degrees of inclination."""
    grid = grid_of(turned)
    high = derive(grid, 1000.0, **ANGLES)
    low = derive(grid, 1000.0, inclination_deg=10.0, declination_deg=37.0)
    assert np.all(low["quality_flag"].values & 16)
    assert not np.any(high["quality_flag"].values & 16)
    ratio = low["vector_uncertainty"].values / high["vector_uncertainty"].values
    assert np.median(ratio) > 4.0  # measured: 6.8
    assert not np.any(derive(grid, inclination_deg=-25.0, declination_deg=0.0)["quality_flag"] & 16)


@pytest.mark.parametrize(
    ("params", "error", "says"),
    [
        ({"height_m": -1.0}, CoverageError, "allow_downward_continuation"),
        ({"inclination_deg": 60.0}, ParameterError, "declination_deg"),
        ({"latitude": (45.0, 0.01, 20)}, MagtilesError, "longitude"),
    ],
    ids=["below", "one angle", "one axis"],
)
def test_what_is_refused(turned, params, error, says):
    with pytest.raises(error, match=says):
        derive(grid_of(turned), **params)


def test_voids_are_refused_by_their_place(turned):
    values = turned.exact.copy()
    values[7, 11] = np.nan
    with pytest.raises(ContractError, match=r"magnetic_anomaly\[7, 11\].*fill-voids"):
        derive(grid_of(turned, values))
