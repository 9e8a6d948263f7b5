"""Removing the core field from tracks and grids, changing it, and evaluating it on grids."""

from __future__ import annotations

import datetime
import functools
from pathlib import Path

import numpy as np
import ppigrf
import pyproj
import pytest
import xarray as xr
from grids import geographic_grid, projected_grid

from magtiles.catalog.models import evaluate, load_igrf
from magtiles.pipeline.main import main
from magtiles.schemas import contracts
from magtiles.schemas.errors import ContractError, MagtilesError, ParameterError, SourceError
from magtiles.stages.field.core_field import (
    RemoveCoreFieldParams,
    RemoveFromGridParams,
    remove_from_grid,
    remove_from_track,
)
from magtiles.stages.field.evaluate_model import EvaluateModelParams, evaluate_model
from magtiles.stages.field.rereference import ReReferenceParams, re_reference

FOLDER = Path(ppigrf.__file__).parent
CRUST = np.random.default_rng(0).normal(0.0, 80.0, (12, 9))


def core(lat, lon, height, date: str, generation: int = 14) -> np.ndarray:
    """Core field (..., 3) north, east, down, nT, by ppigrf."""
    file = str(FOLDER / f"IGRF{generation}.shc")
    when = datetime.datetime.fromisoformat(date)
    east, north, up = (
        a[0] for a in ppigrf.igrf(lon, lat, np.asarray(height) / 1e3, when, coeff_fn=file)
    )
    return np.stack([north, east, -up], axis=-1)


def magnitude(*arguments) -> np.ndarray:
    return np.linalg.norm(core(*arguments), axis=-1)


@pytest.fixture(scope="module")
def nodes() -> tuple[np.ndarray, ...]:
    """y, x in UTM zone 10, and latitude and longitude (y, x) of the nodes."""
    y, x = 5.1e6 + 2e3 * np.arange(12), 4.2e5 + 2e3 * np.arange(9)
    to_wgs84 = pyproj.Transformer.from_crs("EPSG:32610", "EPSG:4326", always_xy=True)
    lon, lat = to_wgs84.transform(*np.meshgrid(x, y))
    return y, x, lat, lon


def utm(nodes, values: np.ndarray, **attributes) -> xr.Dataset:
    return projected_grid(values, *nodes[:2], height=1200.0, **attributes)


def total_field(nodes, date: str = "2015-01-01", **attributes) -> xr.Dataset:
    whole = magnitude(*nodes[2:], np.full(CRUST.shape, 1200.0), date) + CRUST
    stated = {"reference_field": "none", "anomaly_definition": "total field"}
    return utm(nodes, whole, reference_epoch=date, **(stated | attributes))


def remove(grid: xr.Dataset, **params) -> xr.Dataset:
    return remove_from_grid(grid, params=RemoveFromGridParams(**params))


def test_the_total_field_of_a_grid_becomes_its_anomaly(nodes) -> None:
    out = remove(total_field(nodes))
    contracts.check(out, "anomaly-grid/1")
    # Measured: 1e-10 nT at this epoch of the model.
    assert np.abs(out["magnetic_anomaly"].values - CRUST).max() < 1e-6
    assert out.attrs["reference_field"] == "IGRF-14"
    assert out.attrs["reference_epoch"] == "2015-01-01"
    assert "reference field's magnitude" in out.attrs["anomaly_definition"]


def test_another_generation_and_date_when_asked(nodes) -> None:
    grid = total_field(nodes, "2015-01-01")
    out = remove(grid, reference_field="igrf 13", reference_epoch="2020-01-01")
    place = *nodes[2:], np.full(CRUST.shape, 1200.0)
    secular = magnitude(*place, "2015-01-01", 14) - magnitude(*place, "2020-01-01", 13)
    assert np.abs(out["magnetic_anomaly"].values - CRUST - secular).max() < 1e-6
    assert np.abs(secular).min() > 100.0
    assert out.attrs["reference_field"] == "IGRF-13"
    assert out.attrs["reference_epoch"] == "2020-01-01"


def with_surface(grid: xr.Dataset, reference: str, surface: object) -> xr.Dataset:
    dims = ("y", "x") if np.ndim(surface) else ()
    return grid.assign(reference_surface_height=(dims, surface, {"units": "m"})).assign_attrs(
        height_reference=reference
    )


def test_heights_count_from_the_ellipsoid(nodes) -> None:
    hills = 500.0 + 400.0 * np.random.default_rng(1).random(CRUST.shape)
    grid = utm(nodes, CRUST, reference_field="IGRF-14", reference_epoch="1990-01-01")
    params = ReReferenceParams(reference_epoch="2020-01-01")
    on_hills = re_reference(with_surface(grid, "terrain", hills), params=params)
    place = nodes[2], nodes[3], 1200.0 + hills
    truth = CRUST + magnitude(*place, "1990-01-01") - magnitude(*place, "2020-01-01")
    assert np.abs(on_hills["magnetic_anomaly"].values - truth).max() < 1e-6
    for reference in ("terrain", "mean_sea_level"):
        with pytest.raises(ContractError, match=r"own height is not known.*unknown surface"):
            re_reference(grid.assign_attrs(height_reference=reference), params=params)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        pytest.param(("IGRF-13", "1990-01-01"), ("IGRF-14", "2020-01-01"), id="both"),
        pytest.param(("IGRF-14", "1975-01-01"), ("IGRF-14", "2025-01-01"), id="the date"),
        pytest.param(("IGRF13", "2020-01-01"), ("IGRF-14", None), id="the model"),
    ],
)
def test_re_referencing_changes_exactly_the_difference(nodes, old, new) -> None:
    values = CRUST.astype(np.float32)
    grid = utm(nodes, values, reference_field=old[0], reference_epoch=old[1],
               anomaly_definition=f"total field minus {old[0]} at {old[1]}")  # fmt: skip
    out = re_reference(
        grid, params=ReReferenceParams(reference_field=new[0], reference_epoch=new[1])
    )
    contracts.check(out, "anomaly-grid/1")
    date = new[1] or old[1]
    place = *nodes[2:], np.full(CRUST.shape, 1200.0)
    truth = magnitude(*place, old[1], int(old[0][-2:])) - magnitude(*place, date, 14)
    change = out["magnetic_anomaly"].values - values
    assert np.abs(change - truth).max() < 1e-6
    assert np.abs(truth).max() > 0.1
    assert out.attrs["reference_field"] == "IGRF-14"
    assert out.attrs["reference_epoch"] == date
    assert out.attrs["anomaly_definition"] == f"total field minus IGRF-14 at {date}"
    back = re_reference(
        out, params=ReReferenceParams(reference_field=old[0], reference_epoch=old[1])
    )
    assert np.abs(back["magnetic_anomaly"].values - values).max() < 1e-6


def test_a_grid_in_degrees_across_the_date_line_with_voids() -> None:
    lat, lon = -20.0 + 0.1 * np.arange(12), 179.7 + 0.1 * np.arange(9)
    values = CRUST.copy()
    values[2, 3] = np.nan
    grid = geographic_grid(values, lat, lon)
    out = re_reference(grid, params=ReReferenceParams(reference_epoch="2020-01-01"))
    place = *np.meshgrid(lat, lon, indexing="ij"), np.zeros(CRUST.shape)
    truth = values + magnitude(*place, "1990-01-01") - magnitude(*place, "2020-01-01")
    np.testing.assert_allclose(out["magnetic_anomaly"].values, truth, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("attributes", "error", "message"),
    [
        ({"reference_field": "mixed"}, ContractError, "'mixed': .*different reference fields"),
        ({"reference_field": "none"}, ContractError, "run remove-core-field"),
        ({"reference_field": "WMM-2015"}, SourceError, "--in old_model=FILE"),
        ({"reference_epoch": "1850-01-01"}, MagtilesError, "outside the validity of IGRF-14"),
        ({"reference_field": "IGRF-9"}, MagtilesError, "no IGRF of generation 9"),
    ],
    ids=["mixed", "none", "unknown model", "too early", "no such generation"],
)
def test_what_cannot_be_re_referenced(nodes, attributes, error, message: str) -> None:
    with pytest.raises(error, match=message):
        re_reference(utm(nodes, CRUST, **attributes), params=ReReferenceParams())


def test_a_model_from_a_file(nodes) -> None:
    grid = utm(nodes, CRUST, reference_field="my model", reference_epoch="2010-01-01")
    by_file = re_reference(grid, params=ReReferenceParams(), old_model=FOLDER / "IGRF13.shc")
    named = grid.assign_attrs(reference_field="IGRF-13")
    by_name = re_reference(named, params=ReReferenceParams())
    np.testing.assert_array_equal(by_file["magnetic_anomaly"], by_name["magnetic_anomaly"])


def test_a_grid_that_is_no_total_field_is_refused(nodes) -> None:
    with pytest.raises(ContractError, match=r"'IGRF-14' was already removed.*run re-reference"):
        remove(utm(nodes, CRUST))
    with pytest.raises(ContractError, match=r"magnetic_anomaly: its median is .* nT"):
        remove(utm(nodes, CRUST, reference_field="none"))


@functools.cache
def year_of_flight() -> tuple[xr.Dataset, np.ndarray]:
    """Over 40 degrees of latitude, from the sea to 30 km up, and the crustal field met."""
    count = 200
    at = np.linspace(0.0, 1.0, count)
    time = np.datetime64("2014-07-01", "ns") + (at * 366 * 86400e9).astype("m8[ns]")
    lat, lon, height = 30 + 40 * at, -160 + 350 * at, 30e3 * at
    crust = 100.0 * np.sin(40 * at)
    field = np.array(
        [
            magnitude(*p, str(t.astype("M8[us]")))
            for *p, t in zip(lat, lon, height, time, strict=True)
        ]
    )
    flight = xr.Dataset(
        {
            "latitude": ("time", lat, {"units": "degrees_north"}),
            "longitude": ("time", lon, {"units": "degrees_east"}),
            "height": ("time", height, {"units": "m"}),
            "field_total": ("time", field.ravel() + crust, {"units": "nT"}),
        },
        {"time": time},
        {"height_reference": "ellipsoid", "source": "test"},
    )
    return flight, crust


def track() -> tuple[xr.Dataset, np.ndarray]:
    flight, crust = year_of_flight()
    return flight.copy(deep=True), crust


def test_each_sample_of_a_track_has_its_own_date_and_height() -> None:
    flight, crust = track()
    contracts.check(flight, "track/1")
    out = remove_from_track(flight, params=RemoveCoreFieldParams())
    contracts.check(out, "track-anomaly/1")
    # ppigrf counts elapsed days between epochs, the model calendar years: at most 0.75 day of
    # some 60 nT a year. Measured: 0.022 nT.
    assert np.abs(out["magnetic_anomaly"].values - crust).max() < 0.03
    one_date = remove_from_track(
        flight.assign_coords(time=np.full(200, flight["time"].values[0])),
        params=RemoveCoreFieldParams(),
    )
    assert np.abs(one_date["magnetic_anomaly"].values - crust).max() > 20.0
    again = out["core_field_total"] + out["magnetic_anomaly"]
    np.testing.assert_allclose(again, flight["field_total"], rtol=0, atol=1e-9)
    assert out.attrs["reference_field"] == "IGRF-14"
    assert out.attrs["anomaly_definition"].endswith("at each sample's date")


def test_samples_without_a_place_stay_without_an_anomaly() -> None:
    flight, crust = track()
    flight["latitude"][3] = np.nan
    flight["field_total"][5] = np.nan
    found = remove_from_track(flight, params=RemoveCoreFieldParams())["magnetic_anomaly"].values
    assert np.flatnonzero(np.isnan(found)).tolist() == [3, 5]
    assert np.nanmax(np.abs(found - crust)) < 0.03


def test_what_is_no_track_of_the_total_field_is_refused() -> None:
    flight, crust = track()
    params = RemoveCoreFieldParams()
    with pytest.raises(ContractError, match="'field_total' is missing"):
        remove_from_track(flight.drop_vars("field_total"), params=params)
    with pytest.raises(ContractError, match="field_total: its median is"):
        remove_from_track(flight.assign(field_total=("time", crust)), params=params)
    with pytest.raises(ContractError, match="unknown surface"):
        remove_from_track(flight.assign_attrs(height_reference="terrain"), params=params)
    later = flight.assign_coords(time=flight["time"] + np.timedelta64(20 * 365, "D"))
    with pytest.raises(MagtilesError, match="outside the validity of IGRF-14"):
        remove_from_track(later, params=params)
    out = remove_from_track(later, params=RemoveCoreFieldParams(allow_extrapolated=True))
    assert "extrapolated" in out.attrs["anomaly_definition"]
    late = flight.assign_coords(time=np.array(["NaT"] * 200, "M8[ns]"))
    with pytest.raises(ContractError, match=r"time\.finite"):
        contracts.check(late, "track/1")
    with pytest.raises(ContractError, match="variables: has none of field_total, field_body"):
        contracts.check(flight.drop_vars("field_total"), "track/1")


AXES = {"latitude": (-90.0, 30.0, 7), "longitude": (-180.0, 60.0, 7)}


def test_a_model_on_a_grid_is_the_model_at_its_points() -> None:
    params = EvaluateModelParams(
        reference_epoch="2017-03-01", heights_m=(-100.0, 5000.0), gradient=True, **AXES
    )
    out = evaluate_model(params=params)
    contracts.check(out, "field-grid/1")
    place = np.meshgrid(out["height"], out["latitude"], out["longitude"], indexing="ij")
    vector, tensor = evaluate(
        load_igrf(), place[1], place[2], place[0], "2017-03-01", gradient=True
    )
    for i, axis in enumerate(("north", "east", "down")):
        assert np.abs(out[f"field_{axis}"].values - vector[..., i]).max() < 1e-6
    assert np.abs(out["field_total"].values - np.linalg.norm(vector, axis=-1)).max() < 1e-6
    for name, (i, j) in {"nn": (0, 0), "ne": (0, 1), "nd": (0, 2), "ed": (1, 2)}.items():
        assert np.abs(out[f"gradient_{name}"].values - tensor[..., i, j]).max() < 1e-9
    assert out.attrs["source"] == "IGRF-14, degrees 1 to 13"


def test_some_degrees_of_a_model_file() -> None:
    params = {"reference_epoch": "2015-01-01", **AXES}
    parts = [
        evaluate_model(params=EvaluateModelParams(degrees=d, **params), model=FOLDER / "IGRF13.shc")
        for d in ((1, 1), (2, 13), (1, 13))
    ]
    low, high, whole = (part["field_down"].values for part in parts)
    assert np.abs(low + high - whole).max() < 1e-6
    assert np.abs(low).max() > 1e4


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"latitude": (0.0, 10.0, 11)}, "latitude: is"),
        ({"longitude": (-361.0, 10.0, 3)}, "longitude: is"),
        ({"heights_m": (100.0, 100.0)}, "ascending heights"),
        ({"reference_epoch": "2040-01-01"}, "outside the validity"),
        ({"degrees": (14, 20)}, "no degrees 14 to 20"),
        ({"heights_m": (-7e6,)}, "inside the Earth"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_grids_that_cannot_be(changes, message: str) -> None:
    params = EvaluateModelParams(**({"reference_epoch": "2020-01-01"} | AXES | changes))
    with pytest.raises(MagtilesError, match=message):
        evaluate_model(params=params)


def test_axes_have_counts_and_spacings() -> None:
    with pytest.raises(ValueError, match="greater than 0"):
        EvaluateModelParams(
            reference_epoch="2020-01-01", latitude=(0.0, 0.0, 3), longitude=(0.0, 1.0, 2)
        )
    assert issubclass(ParameterError, MagtilesError)


def test_the_stages_run_on_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """remove-core-field is chosen by its role; a model file may be left out or given."""
    monkeypatch.chdir(tmp_path)
    track()[0].to_netcdf("track.nc", engine="netcdf4")
    run = ["run", "remove-core-field", "--in", "track=track.nc", "--out", "out.nc"]
    assert main(run) == 0
    with xr.open_dataset("out.nc", engine="netcdf4") as out:
        assert "core_field_total" in out
    evaluated = [
        "run", "evaluate-model", "--out", "model.nc", "--in", f"model={FOLDER / 'IGRF13.shc'}",
        "--param", "reference_epoch=2015-01-01", "--param", "latitude=[40, 1.0, 3]",
        "--param", "longitude=[10, 1.0, 3]",
    ]  # fmt: skip
    assert main(evaluated) == 0
    assert main([*run[:3], "road=track.nc", "--out", "out.nc"]) == 2
