"""The physics checks against exact dipoles, and that each notices what it is there for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from magtiles.catalog.flags import QualityFlag
from magtiles.catalog.kernels.dipole import dipole_field_geodetic, geodetic_to_ecef
from magtiles.pipeline.physics import (
    GradientSums,
    add_gradients,
    projection_excess,
)

HALO = 12
DOWN = np.array([0.0, 0.0, 1.0])


def exact_level(
    depth: float, spacing: float = 0.01, south: float = 59.8
) -> tuple[dict[str, NDArray[Any]], NDArray[np.float64], NDArray[np.float64]]:
    """40 dipoles at one depth (m) below a 64 x 56 lattice, high up north where frames turn fast."""
    rng = np.random.default_rng(7)
    latitude = south + spacing * np.arange(64)
    longitude = 15.0 + 2 * spacing * np.arange(56)
    places = np.column_stack(
        [
            rng.uniform(latitude[0], latitude[-1], 40),
            rng.uniform(longitude[0], longitude[-1], 40),
            np.full(40, -depth),
        ]
    )
    vector, tensor = dipole_field_geodetic(
        latitude[:, None],
        longitude[None, :],
        0.0,
        geodetic_to_ecef(*places.T),
        rng.normal(0.0, 1e2 * depth**3 / 100.0, (40, 3)),
    )
    level = {f"anomaly_{a}": vector[..., i] for i, a in enumerate(("north", "east", "down"))}
    level |= {f"gradient_{p}": tensor[..., i] for i, p in enumerate(("nn", "ne", "nd", "ee", "ed"))}
    level["magnetic_anomaly"] = vector @ DOWN
    level["quality_flag"] = np.zeros(vector.shape[:2], np.uint8)
    return level, latitude, longitude


def worst(level: dict[str, NDArray[Any]], *axes: NDArray[np.float64]) -> tuple[float, float]:
    sums = GradientSums()
    add_gradients(sums, level, axes[0], axes[1], 0.0, HALO)
    _, residual, truncation = sums.worst()
    return residual, truncation


@pytest.mark.parametrize(
    ("depth", "residual"),
    [
        # Measured 8.16e-3, 2.12e-4, 3.73e-6, 2.04e-8 of the rms gradient; nodes 1.11 km apart.
        pytest.param(2500.0, 9e-3, id="2.2 nodes"),
        pytest.param(5000.0, 2.3e-4, id="4.5 nodes"),
        pytest.param(10_000.0, 4.1e-6, id="9 nodes"),
        pytest.param(40_000.0, 2.3e-8, id="36 nodes"),
    ],
)
def test_exact_gradients_pass_and_the_scheme_knows_its_truncation(
    depth: float, residual: float
) -> None:
    found, truncation = worst(*exact_level(depth))
    assert found <= residual
    assert found <= truncation + 1e-7


def test_turning_of_the_frame_counts() -> None:
    """Without the frame's terms, sources 40 km deep at 60 N miss by 6.9e-3 of the gradient."""
    level, latitude, longitude = exact_level(40_000.0)
    flat = latitude - latitude.mean() + 1e-9  # at the equator tan(latitude) vanishes
    turned, _ = worst(level, latitude, longitude)
    # Same spacing in km at the equator: squeeze longitudes by cos(60).
    squeezed = longitude * float(np.cos(np.radians(latitude.mean())))
    unturned, _ = worst(level, flat, squeezed)
    assert turned < 1e-7
    assert unturned > 5e-3


def swap(level: dict[str, NDArray[Any]]) -> None:
    level["gradient_ne"], level["gradient_ed"] = level["gradient_ed"], level["gradient_ne"]


def per_metre(level: dict[str, NDArray[Any]]) -> None:
    level["gradient_nn"] = level["gradient_nn"] * 1.03


def flipped(level: dict[str, NDArray[Any]]) -> None:
    level["anomaly_down"] = -level["anomaly_down"]


def grid_north(level: dict[str, NDArray[Any]]) -> None:
    """The vector left in grid axes, 2 degrees of meridian convergence off: 3.6 % measured."""
    c, s = np.cos(np.radians(2.0)), np.sin(np.radians(2.0))
    north, east = level["anomaly_north"], level["anomaly_east"]
    level["anomaly_north"], level["anomaly_east"] = c * north + s * east, c * east - s * north


def half_cell(level: dict[str, NDArray[Any]]) -> None:
    for name in ("anomaly_north", "anomaly_east", "anomaly_down"):
        level[name] = 0.5 * (level[name] + np.roll(level[name], 1, axis=1))


@pytest.mark.parametrize("spoil", [swap, per_metre, flipped, grid_north, half_cell])
def test_wrong_gradients_exceed_one_percent(spoil: Callable[[dict[str, Any]], None]) -> None:
    level, *axes = exact_level(5000.0)
    spoil(level)
    residual, truncation = worst(level, *axes)
    assert residual > 0.01 + truncation


def test_nodes_beyond_coverage_do_not_count() -> None:
    level, *axes = exact_level(5000.0)
    level["anomaly_north"][:, :20] = 1e4
    level["quality_flag"][:, :20] |= np.uint8(QualityFlag.BEYOND_COVERAGE)
    residual, truncation = worst(level, *axes)
    assert residual <= 0.01 + truncation
    level["quality_flag"][:] = QualityFlag.BEYOND_COVERAGE
    sums = GradientSums()
    add_gradients(sums, level, *axes, 0.0, HALO)
    assert sums.nodes == 0


def ambient(direction: NDArray[np.float64], shape: tuple[int, ...]) -> dict[str, NDArray[Any]]:
    return {
        f"ambient_{axis}": np.full(shape, direction[i])
        for i, axis in enumerate(("north", "east", "down"))
    }


def test_projection_bound_holds_for_a_magnetometer() -> None:
    """|F + B| - |F| of a true 45 000 nT field stays within the bound; twice that does not."""
    level, *_ = exact_level(2500.0)
    vector = np.stack([level[f"anomaly_{a}"] for a in ("north", "east", "down")], axis=-1)
    vector *= 800.0 / np.abs(vector).max()
    for i, axis in enumerate(("north", "east", "down")):
        level[f"anomaly_{axis}"] = vector[..., i]
    core = 45_000.0 * DOWN
    level["magnetic_anomaly"] = np.linalg.norm(core + vector, axis=-1) - np.linalg.norm(core)
    along = ambient(DOWN, vector.shape[:2])
    excess = projection_excess(level, along, HALO, 0.0)
    assert excess.size == 40 * 32
    assert excess.max() <= 1e-9
    linear = np.abs(vector @ DOWN - level["magnetic_anomaly"]).max()
    assert linear > 1.0  # so the bound did something
    level["magnetic_anomaly"] = 2.0 * level["magnetic_anomaly"]
    assert projection_excess(level, along, HALO, 0.0).max() > 10.0


def test_projection_looks_at_clean_nodes_only() -> None:
    level, *_ = exact_level(2500.0)
    level["magnetic_anomaly"][30, 30] += 500.0
    along = ambient(DOWN, level["magnetic_anomaly"].shape)
    assert projection_excess(level, along, HALO, 0.0).max() > 400.0
    level["quality_flag"][30, 30] = QualityFlag.VOID_FILLED
    assert projection_excess(level, along, HALO, 0.0).max() < 1e-9
