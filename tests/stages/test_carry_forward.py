"""Carrying a map forward: against rocks magnetised by the core field alone, and identities."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from grids import geographic_grid, projected_grid
from induced import Induced
from known import Floats

from magtiles.catalog.flags import QualityFlag
from magtiles.schemas import contracts
from magtiles.schemas.errors import ContractError, MagtilesError, ParameterError
from magtiles.stages.declare import parse_params
from magtiles.stages.field.carry_forward import CarryForwardParams, carry_forward

SURVEYED, NOW = "1960-01-01", "2025-01-01"
INNER = np.s_[10:-10, 10:-10]


def survey(world: Induced, **attributes: str) -> xr.Dataset:
    stated = {"reference_field": "IGRF-14", "reference_epoch": SURVEYED} | attributes
    return projected_grid(
        world.anomaly(SURVEYED), *world.axes, world.crs, height=world.height_m, **stated
    )


def carry(grid: xr.Dataset, date: str = NOW, **params: object) -> xr.Dataset:
    return carry_forward(grid, params=CarryForwardParams(reference_epoch=date, **params))


def rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize(
    ("world", "everywhere", "inside"),
    # How many times closer to the truth than doing nothing. Measured: 99, 174; 48, 124;
    # 141, 202; 44, 57; 275, 324; 122, 161.
    [
        pytest.param(Induced("EPSG:32610", 46.0, -121.5), 80, 140, id="turned 2.8 degrees"),
        pytest.param(
            Induced("EPSG:32610", 46.0, -121.5, 4000.0, 200, 120), 40, 100, id="800 km wide"
        ),
        pytest.param(
            Induced("EPSG:32610", 46.0, -111.0, 2000.0, 200, 140), 110, 160, id="replaned"
        ),
        pytest.param(Induced("EPSG:32723", -24.0, -44.0), 30, 40, id="turned 19 degrees"),
        pytest.param(Induced("EPSG:32734", -34.0, 20.0), 200, 250, id="a sixth weaker"),
        pytest.param(Induced("EPSG:32620", 5.0, -60.0), 100, 130, id="inclination from 33 to 18"),
    ],
)
def test_induced_anomalies_are_those_of_the_new_date(
    world: Induced, everywhere: float, inside: float
) -> None:
    grid, truth = survey(world), world.anomaly(NOW)
    nothing = grid["magnetic_anomaly"].values - truth
    error = carry(grid)["magnetic_anomaly"].values - truth
    assert rms(nothing) / rms(error) > everywhere
    assert rms(nothing[INNER]) / rms(error[INNER]) > inside


def test_sources_beyond_the_border_are_felt_near_it() -> None:
    world = Induced("EPSG:32610", 46.0, -121.5, margin_m=30e3, sources=250)
    grid, truth = survey(world), world.anomaly(NOW)
    nothing = grid["magnetic_anomaly"].values - truth
    error = carry(grid)["magnetic_anomaly"].values - truth
    # Measured: 9.4 over all, 54 more than ten cells inside.
    assert rms(nothing) / rms(error) > 8.0
    assert rms(nothing[INNER]) / rms(error[INNER]) > 45.0


def test_a_grid_in_degrees_is_carried_like_one_in_metres() -> None:
    world = Induced("EPSG:32610", 46.0, -121.5, height_m=0.0)
    axes = np.arange(45.55, 46.45, 0.009), np.arange(-122.4, -120.6, 0.013)
    nodes = tuple(np.meshgrid(*axes, indexing="ij"))
    grid = geographic_grid(world.anomaly(SURVEYED, nodes), *axes, reference_epoch=SURVEYED)
    truth = world.anomaly(NOW, nodes)
    error = carry(grid)["magnetic_anomaly"].values - truth
    nothing = grid["magnetic_anomaly"].values - truth
    # Measured: 124.
    assert rms(nothing) / rms(error) > 100.0


def test_no_time_no_change() -> None:
    grid = survey(Induced("EPSG:32620", 5.0, -60.0))
    same = carry(grid, SURVEYED)
    np.testing.assert_array_equal(same["magnetic_anomaly"], grid["magnetic_anomaly"])


def test_there_and_back_again() -> None:
    grid = survey(Induced("EPSG:32610", 46.0, -121.5))
    back = carry(carry(grid), SURVEYED)
    error = (back["magnetic_anomaly"] - grid["magnetic_anomaly"]).values
    # Measured: 0.007 nT of 70; the change itself is 7.4.
    assert rms(error[INNER]) < 0.01
    assert back.attrs["reference_epoch"] == SURVEYED


def test_attributes_stay_true() -> None:
    grid = survey(Induced("EPSG:32610", 46.0, -121.5), reference_field="IGRF-13")
    carried = carry(grid)
    contracts.check(carried, "anomaly-grid/1")
    assert carried.attrs["reference_field"] == "IGRF-13"
    assert carried.attrs["reference_epoch"] == NOW
    assert carried.attrs["magnetization_assumption"] == "induced"
    assert carried.attrs["anomaly_definition"].endswith(
        "carried from 1960-01-01 to 2025-01-01, all magnetisation taken as induced"
    )
    assert carry(grid, reference_field="IGRF-14").attrs["reference_field"] == "IGRF-14"
    assert "quality_flag" not in carried


@pytest.mark.parametrize(("field", "after"), [("mixed", "mixed"), ("WMM-1985", "IGRF-14")])
def test_the_igrf_stands_in_for_the_direction_of_others(field: str, after: str) -> None:
    world = Induced("EPSG:32610", 46.0, -121.5)
    carried = carry(survey(world, reference_field=field))
    assert carried.attrs["reference_field"] == after
    np.testing.assert_array_equal(
        carried["magnetic_anomaly"], carry(survey(world))["magnetic_anomaly"]
    )


def test_low_inclination_is_flagged_beside_what_was() -> None:
    """At 6.1 north, 60 west the inclination falls from 34 degrees to 20 within the map."""
    grid = survey(Induced("EPSG:32620", 6.1, -60.0))
    flags = np.zeros(grid["magnetic_anomaly"].shape, np.uint8)
    flags[0, 0] = 1
    meaning = {"flag_masks": np.array([1, 16], np.uint8), "flag_meanings": "a b"}
    carried = carry(grid.assign(quality_flag=(("y", "x"), flags, meaning)))
    contracts.check(carried, "anomaly-grid/1")
    low = (carried["quality_flag"].values & QualityFlag.REDUCED_ACCURACY_DIRECTION) > 0
    assert 0.0 < low.mean() < 1.0
    assert low[0].all()  # the south, nearer the magnetic equator
    assert not low[-1].any()
    assert carried["quality_flag"].values[0, 0] & 1


def with_a_void(grid: xr.Dataset) -> xr.Dataset:
    values = grid["magnetic_anomaly"].values.copy()
    values[3, 4] = np.nan
    return grid.assign(magnetic_anomaly=grid["magnetic_anomaly"].copy(data=values))


def test_bad_input_says_what() -> None:
    grid = survey(Induced("EPSG:32610", 46.0, -121.5, columns=30, rows=20, margin_m=-5e3))
    with pytest.raises(ContractError, match=r"magnetic_anomaly\[3, 4\]: the grid has voids"):
        carry(with_a_void(grid))
    with pytest.raises(ContractError, match="no reference field was removed"):
        carry(grid.assign_attrs(reference_field="none"))
    with pytest.raises(MagtilesError, match=r"2031.* outside the validity of IGRF-14"):
        carry(grid, "2031-01-01")
    carried = carry(grid, "2031-01-01", allow_extrapolated=True)
    assert "(IGRF-14 extrapolated in time)" in carried.attrs["anomaly_definition"]
    with pytest.raises(MagtilesError, match=r"'CHAOS-8' are not known.*--in new_model=FILE"):
        carry(grid, reference_field="CHAOS-8")
    with pytest.raises(ParameterError, match="reference_epoch"):
        parse_params(CarryForwardParams, {"reference_epoch": "today"}, where="a.toml")
