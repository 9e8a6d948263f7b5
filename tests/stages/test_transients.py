"""Lorries in one pass of nine, and lanes that are no lorries, on roads of known steel."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from road_lorries import dropped, felt, lorry
from roads import CORE, Road, Vehicle, turned

from magtiles.catalog.kernels.dipole import dipole_vector

Floats = NDArray[np.float64]

VEHICLES = ("car",) * 3 + ("suv",) * 3 + ("van",) * 3
SEEDS = tuple(range(300, 308))
LENGTH_M = 400.0


@cache
def road_of(seed: int) -> Road:
    return Road(length_m=LENGTH_M, dipoles=80, seed=seed)


@cache
def passes(seed: int, spacing_m: float = 1.0) -> Floats:
    """Nine passes (9, point, 3), nT: wandering lanes, calibrations, noise of 2 mG in 3 samples."""
    road, rng = road_of(seed), np.random.default_rng(seed)
    along = np.arange(0.0, LENGTH_M, spacing_m)
    vehicles = {name: Vehicle.random(name, seed + k) for k, name in enumerate(sorted({*VEHICLES}))}
    fields = []
    for name in VEHICLES:
        phase, mean = rng.uniform(0.0, 6.3, 2), 0.4 * rng.normal()
        lane = mean + 0.4 * (np.sin(along / 40.0 + phase[0]) + np.sin(along / 25.0 + phase[1]))
        field = road.body_field(along + 0.1 * rng.normal(), lane)
        reading = field @ vehicles[name].matrix.T + vehicles[name].bias
        fields.append(reading + 120.0 / np.sqrt(spacing_m) * rng.normal(size=reading.shape))
    return np.stack(fields)


def share_found(moment: float, number: int, spacing_m: float = 1.0) -> float:
    """Of lorries that one pass meets, one on each road."""
    found = []
    for seed in SEEDS:
        rng = np.random.default_rng([seed, number])
        along = np.arange(0.0, LENGTH_M, spacing_m)
        at = rng.uniform(50.0, LENGTH_M - 50.0)
        course = road_of(seed).at(np.array([at]))[1]
        core = turned(CORE[None] / np.linalg.norm(CORE), course)[0]
        field = lorry(along, at, core, moment, aside_m=-3.6 + 0.5 * rng.normal())
        fields = passes(seed, spacing_m).copy()
        fields[number] += field
        found.append(dropped(fields, VEHICLES, spacing_m)[felt(field)].mean() > 0.5)
    return float(np.mean(found))


@pytest.mark.parametrize("number", [0, 2, 3, 8])
def test_a_lorry_of_three_thousand_ampere_square_metres_is_dropped(number: int) -> None:
    # Also the first pass, by the third, and the first of a vehicle. Measured: at least 7 of 8.
    assert share_found(3000.0, number) >= 0.75


@pytest.mark.parametrize("spacing_m", [0.5, 2.0, 3.0])
def test_a_lorry_is_dropped_at_other_spacings(spacing_m: float) -> None:
    assert share_found(3000.0, 5, spacing_m) >= 0.75  # measured: at least 7 of 8


def test_what_lanes_do_is_no_lorry() -> None:
    # Steel of 600 A m2, 3 m beside lanes that wander by 0.6 m: measured 1.7 % of the points of
    # nine passes, most on one road.
    assert np.mean([dropped(passes(seed), VEHICLES).mean() for seed in SEEDS]) < 0.025


def test_narrow_steel_under_one_lane_stays() -> None:
    """A cover that one pass of nine ran over: 4.5 uT, over less than a lorry."""
    along = np.arange(0.0, LENGTH_M)
    points = np.column_stack([along, np.zeros((along.size, 2))])
    cover = dipole_vector(points, np.array([[200.0, 0.0, 1.3]]), np.array([[0.0, 0.0, 50.0]]))
    assert 4000.0 < np.abs(cover).max() < 5000.0
    for seed in SEEDS:
        without = dropped(passes(seed), VEHICLES)
        fields = passes(seed).copy()
        fields[6] += cover
        np.testing.assert_array_equal(dropped(fields, VEHICLES)[190:211], without[190:211])
