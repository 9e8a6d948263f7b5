"""A level straight from a field model: against direct sums, and what its uncertainty is worth."""

from __future__ import annotations

import dataclasses
import logging
from pathlib import Path

import numpy as np
import pytest
from direct_sum import direct_field, split_gauss, total_anomaly
from gauss import random_crust, static

from magtiles.catalog.models import cof_text, evaluate_grid, load_igrf, power_spectrum, shc_text
from magtiles.pipeline.sample_model import WorldSpec, world_model
from magtiles.schemas import contracts
from magtiles.schemas.errors import ParameterError
from magtiles.stages.field import harmonic_nodes
from magtiles.stages.field.level import PRODUCTS
from magtiles.stages.field.model_components import (
    ModelComponentsParams,
    derive_model_components,
    shortest_wavelength_m,
)
from magtiles.stages.field.model_parts import split_model
from magtiles.stages.field.model_uncertainty import ModelError

SPEC = WorldSpec(degree=48)
MODEL = world_model(SPEC)
EPOCH = "2026-07-02"
NODES = {"latitude": (-40.0, 10.0, 9), "longitude": (-170.0, 55.0, 5)}
CHOICE = {"epoch": EPOCH, "core_degree": 15, "crust_degree": 16, "highest_degree": None}


@pytest.fixture(scope="module")
def file(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("model") / "world.COF"
    path.write_text(cof_text(MODEL))
    return path


def level(file: Path, core: Path | None = None, **params):
    wanted = {"reference_epoch": EPOCH, "height_m": 3000.0, "uncertainty_nt": 2.0, **NODES}
    given = ModelComponentsParams(**{**wanted, **params})
    return derive_model_components([file], params=given, core=core)


def test_against_direct_sums(file):
    """The whole chain, file included, to the rounding of float32."""
    made = level(file)
    contracts.check(made, "component-grid/1")
    lat, lon = (a.ravel() for a in np.meshgrid(made.latitude, made.longitude, indexing="ij"))
    core, crust = (
        direct_field(gauss, lat, lon, 3000.0) for gauss in split_gauss(MODEL.at(EPOCH), 15)
    )
    vector = np.stack([made[f"anomaly_{a}"].values.ravel() for a in ("north", "east", "down")], -1)
    ambient = np.stack([made[f"ambient_{a}"].values.ravel() for a in ("north", "east", "down")], -1)
    rounding = 2.0**-24 * np.abs(crust).max()
    np.testing.assert_allclose(vector, crust, rtol=0, atol=2 * rounding)
    np.testing.assert_allclose(
        made.magnetic_anomaly.values.ravel(), total_anomaly(core, crust), rtol=0, atol=2 * rounding
    )
    unit = core / np.linalg.norm(core, axis=-1, keepdims=True)
    np.testing.assert_allclose(ambient, unit, rtol=0, atol=1e-7)


def test_tensor_is_the_models_own(file):
    """The tensor itself is held to finite differences where the models are tested."""
    made = level(file)
    crust = MODEL.degrees(16, 48)
    _, tensor = evaluate_grid(crust, made.latitude, made.longitude, 3000.0, EPOCH, gradient=True)
    for name, (i, j) in harmonic_nodes.TENSOR_PARTS.items():
        found = made[f"gradient_{name}"].values
        np.testing.assert_allclose(found, tensor[0, ..., i, j], rtol=2e-7, atol=1e-9)


@pytest.mark.parametrize("step", [7.5, 5.0 / 13.0])
def test_a_whole_turn_is_the_same_to_the_bit(file, step):
    turn = round(360.0 / step)
    made = level(file, longitude=(-180.0 - 4 * step, step, turn + 9))
    for name in (*PRODUCTS, "ambient_east", "magnetic_anomaly_uncertainty"):
        values = made[name].values
        assert values[:, :9].tobytes() == values[:, turn:].tobytes(), name


def test_bands_of_latitude_do_not_show(file, monkeypatch):
    whole = level(file)
    monkeypatch.setattr(harmonic_nodes, "_NODES_AT_ONCE", 10)
    for name in PRODUCTS:
        np.testing.assert_array_equal(level(file)[name], whole[name])


@pytest.mark.parametrize(("height", "flag"), [(-600.0, 0), (-601.0, 4), (0.0, 0), (9e4, 0)])
def test_only_levels_below_all_land_are_flagged(file, height, flag):
    assert (level(file, height_m=height).quality_flag.values == flag).all()


@pytest.mark.parametrize(
    ("choice", "said"),
    [
        ({"core_degree": 16}, "degrees 16 to 16 would be counted twice"),
        ({"core_degree": 13}, "degrees 14 to 15 would be lost"),
        ({"crust_degree": 60}, "no degrees 60 to 48"),
        ({"highest_degree": 49}, "no degrees 16 to 49"),
        ({"highest_degree": 12}, "no degrees 16 to 12"),
        ({"epoch": "2030-06-01"}, "epoch 2030-06-01 is outside the validity of WORLD-48"),
        ({"epoch": "2024-12-31"}, "expected 2025 to 2030"),
    ],
)
def test_degrees_and_dates_that_will_not_do(choice, said):
    with pytest.raises(ParameterError, match=said):
        split_model(MODEL, None, **{**CHOICE, **choice})


def test_a_model_without_core_field_needs_one():
    crust = static(random_crust(16, 40, 30.0), "crust")
    for lone in (crust, crust.degrees(16, 40)):
        with pytest.raises(ParameterError, match=r"no core field.*core = .IGRF-14"):
            split_model(lone, None, **CHOICE)


def test_a_core_of_one_date_is_refused():
    still = dataclasses.replace(MODEL, secular_variation=None, valid=(2025.0, 2025.0))
    with pytest.raises(ParameterError, match="no secular variation"):
        split_model(still, None, **{**CHOICE, "epoch": "2025-01-01"})


def test_another_models_core_may_leave_a_gap_and_says_so(caplog):
    crust = static(random_crust(16, 40, 30.0), "crust")
    with caplog.at_level(logging.WARNING):
        parts = split_model(crust, load_igrf(), **CHOICE)
    assert "degrees 14 to 15" in caplog.text
    assert "degrees 14 to 15 are in neither" in parts.definition
    assert parts.missing == range(14, 16)
    assert (parts.core.n_max, parts.crust.n_min) == (13, 16)
    # Static crust of a file that names one date serves at any.
    dated = dataclasses.replace(crust, valid=(2010.0, 2010.0))
    assert split_model(dated, load_igrf(), **CHOICE).crust_at(EPOCH).any()


def test_core_and_crust_join_without_a_gap():
    parts = split_model(MODEL, None, **CHOICE)
    assert (parts.core.n_max, parts.crust.n_min, parts.missing) == (15, 16, range(16, 16))
    core = np.zeros_like(MODEL.at(EPOCH))
    core[: 15 * 17] = parts.core.at(EPOCH)
    np.testing.assert_array_equal(core + parts.crust_at(EPOCH), MODEL.at(EPOCH))
    assert power_spectrum(core)[13:15].min() > 1.0  # the sample fills 14 and 15


def test_without_a_stated_error_there_is_no_map(file):
    with pytest.raises(ParameterError, match=r"the error of WORLD-48 is not stated"):
        level(file, uncertainty_nt=None)


def deep_crust(degree: int, seed: int) -> np.ndarray:
    """Sources 150 km deep: degrees above 60 still count, those above 200 no more."""
    n = np.sqrt(np.arange(1, degree * (degree + 2) + 1)).astype(int)
    each = np.sqrt(25.0 / ((n + 1) * (2 * n + 1))) * (1 - 150 / 6371.2) ** n
    return np.where(n >= 16, each * np.random.default_rng(seed).normal(size=n.size), 0.0)


@pytest.mark.parametrize("height", [0.0, 20e3])
def test_omission_is_what_the_model_lacks(height):
    """Known degrees 61 to 200, guessed from those to 60: 4 to 11 % off, measured."""
    gauss = deep_crust(200, 3)
    full = static(gauss)
    known = full.degrees(16, 60)
    error = ModelError(known, known.at(2020.0), 1e-6, range(0))
    latitude = np.degrees(np.arcsin(np.linspace(-0.995, 0.995, 61)))  # equal areas
    longitude = np.arange(0.0, 360.0, 3.0)
    lost, slope = evaluate_grid(
        full.degrees(61, 200), latitude, longitude, height, 2020.0, gradient=True
    )
    core = evaluate_grid(load_igrf(), latitude, longitude, height, 2020.0)[0]
    unit = core / np.linalg.norm(core, axis=-1, keepdims=True)
    sigma = error.sigmas(height, unit[..., 2])
    total = np.einsum("...i,...i->...", lost[0], unit)
    five = np.stack([slope[0, ..., i, j] for i, j in harmonic_nodes.TENSOR_PARTS.values()], -1)
    for group, found in (("total", total), ("vector", lost[0]), ("tensor", five)):
        stated = np.sqrt(np.mean(sigma[group] ** 2))
        assert np.sqrt(np.mean(found**2)) == pytest.approx(stated, rel=0.15), group


def test_shares_of_the_components():
    """Down and horizontal by degree, and the tensor's five: exact means over many fields."""
    gauss = deep_crust(60, 5)
    model = static(gauss).degrees(16, 60)
    latitude = np.degrees(np.arcsin(np.linspace(-0.995, 0.995, 101)))
    field, tensor = evaluate_grid(
        model, latitude, np.arange(0.0, 360.0, 3.0), 0.0, 2020.0, gradient=True
    )
    # All of its power taken for error, and no omission to speak of.
    rms = float(np.sqrt(power_spectrum(model.at(2020.0)).sum() / 3.0))
    error = ModelError(model, model.at(2020.0), rms, range(0))
    error._omission = error._omission[0], 0.0 * error._omission[1]
    flat, steep = (float(error.sigmas(0.0, np.array(f))["total"]) for f in (0.0, 1.0))
    # The ellipsoid is up to 15 km nearer or farther than the reference sphere: some 3 %.
    assert np.sqrt(np.mean(field[..., 2] ** 2)) == pytest.approx(steep, rel=0.04)
    assert np.sqrt(np.mean(field[..., :2] ** 2)) == pytest.approx(flat, rel=0.04)
    assert np.sqrt(np.mean(field**2)) == pytest.approx(float(
        error.sigmas(0.0, np.array(0.0))["vector"]), rel=0.04)  # fmt: skip
    five = np.stack([tensor[..., i, j] for i, j in harmonic_nodes.TENSOR_PARTS.values()], -1)
    stated = float(error.sigmas(0.0, np.array(0.0))["tensor"])
    assert np.sqrt(np.mean(five**2)) == pytest.approx(stated, rel=0.05)


def test_stated_error_is_the_sigma_of_a_component_at_the_ellipsoid():
    crust = MODEL.degrees(16, 48)
    error = ModelError(crust, crust.at(EPOCH), 2.0, range(0))
    assert error.parts["commission"] == pytest.approx(2.0)
    lifted = [float(error.sigmas(h, np.array(0.5))["vector"]) for h in (-11e3, 0.0, 1e4, 1e5)]
    assert lifted == sorted(lifted, reverse=True)
    assert lifted[-1] > 1.0


def test_missing_degrees_count():
    crust = MODEL.degrees(16, 48)
    with_gap, without = (
        ModelError(crust, crust.at(EPOCH), 2.0, missing).parts["omission"]
        for missing in (range(14, 16), range(0))
    )
    mean = power_spectrum(crust.at(EPOCH))[15:18].mean()
    assert with_gap**2 - without**2 == pytest.approx(2.0 * mean / 3.0)


def test_shortest_wavelength():
    assert shortest_wavelength_m(790) == pytest.approx(50_640, abs=10)


def test_core_file_of_another_model(file, tmp_path):
    core = tmp_path / "IGRF14.shc"
    core.write_text(shc_text(load_igrf()))
    own, other = level(file), level(file, core)
    np.testing.assert_array_equal(own.anomaly_down, other.anomaly_down)
    assert other.attrs["reference_field"] == "IGRF14 to degree 13"
