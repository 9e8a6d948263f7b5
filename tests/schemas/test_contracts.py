"""Contracts: each breach is found and named with its place, what was found and expected."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jsonschema
import numpy as np
import pyproj
import pytest
import xarray as xr

from magtiles.schemas import contracts
from magtiles.schemas.errors import ContractError

CONTRACT = "anomaly-grid/1"


def grid() -> xr.Dataset:
    """A small anomaly grid that keeps its contract; one value is missing."""
    values = np.arange(20.0, dtype=np.float32).reshape(4, 5)
    values[1, 2] = np.nan
    return xr.Dataset(
        {
            "magnetic_anomaly": (("y", "x"), values, {"units": "nT", "grid_mapping": "crs"}),
            "height": ((), 150.0, {"units": "m", "positive": "up"}),
            "crs": ((), np.int32(0), pyproj.CRS(32613).to_cf()),
        },
        coords={
            "y": ("y", 1000.0 * np.arange(4), {"units": "m"}),
            "x": ("x", 1000.0 * np.arange(5), {"units": "m"}),
        },
        attrs={
            "reference_field": "IGRF-13",
            "reference_epoch": "2015-01-01",
            "anomaly_definition": "total field minus reference",
            "height_reference": "ellipsoid",
            "source": "test",
        },
    )


def value(number: float) -> Callable[[xr.Dataset], xr.Dataset]:
    def change(dataset: xr.Dataset) -> xr.Dataset:
        dataset["magnetic_anomaly"][0, 0] = number
        return dataset

    return change


def unit(name: str, unit: str) -> Callable[[xr.Dataset], xr.Dataset]:
    def change(dataset: xr.Dataset) -> xr.Dataset:
        dataset[name].attrs["units"] = unit
        return dataset

    return change


def attribute(name: str, text: str) -> Callable[[xr.Dataset], xr.Dataset]:
    return lambda dataset: dataset.assign_attrs({name: text})


def without(name: str) -> Callable[[xr.Dataset], xr.Dataset]:
    def change(dataset: xr.Dataset) -> xr.Dataset:
        if name in dataset.variables:
            return dataset.drop_vars(name)
        del dataset.attrs[name]
        return dataset

    return change


@dataclass(frozen=True)
class Expect:
    change: Callable[[xr.Dataset], xr.Dataset]
    message: str
    id: str


_BREACHES = [
    Expect(without("magnetic_anomaly"), "variables: 'magnetic_anomaly' is missing; e", "variable"),
    Expect(without("reference_epoch"), "attrs: 'reference_epoch' is missing; ex", "attribute"),
    Expect(
        unit("magnetic_anomaly", "T"),
        "variables.magnetic_anomaly.units: found 'T'; expected 'nT'",
        "unit",
    ),
    Expect(
        lambda d: d.assign(magnetic_anomaly=d.magnetic_anomaly.fillna(0).astype("i4")),
        "variables.magnetic_anomaly.dtype: found 'int32'; expected 'float",
        "dtype",
    ),
    Expect(
        value(2e5), "variables.magnetic_anomaly.maximum: found 200000; expected at most 1", "high"
    ),
    Expect(value(-np.inf), "variables.magnetic_anomaly.minimum: found -inf; expe", "infinite"),
    Expect(
        lambda d: d.isel(y=slice(None, None, -1)),
        "variables.y.ascending: found False; expected True",
        "descending",
    ),
    Expect(
        lambda d: d.rename(y="northing"),
        "variables.magnetic_anomaly.dims: found ['northing', 'x']; expected ['y', 'x'] or",
        "dims",
    ),
    Expect(
        attribute("height_reference", "geoid"),
        "attrs.height_reference: found 'geoid'; expected 'ellipsoid' or 'mean_sea_level' or",
        "attribute value",
    ),
    Expect(attribute("reference_epoch", "1 May"), "attrs.reference_epoch: '1 May' does", "date"),
    Expect(
        lambda d: d.assign(magnetic_anomaly_uncertainty=(("y", "x"), np.zeros((4, 5), "f4"))),
        "variables.magnetic_anomaly_uncertainty: 'units' is missing",
        "optional variable",
    ),
]


def test_a_sound_grid_passes() -> None:
    contracts.check(grid(), CONTRACT)


@pytest.mark.parametrize("expect", _BREACHES, ids=lambda expect: expect.id)
def test_breach_is_named(expect: Expect) -> None:
    with pytest.raises(ContractError) as caught:
        contracts.check(expect.change(grid()), CONTRACT, where="a.nc")
    text = str(caught.value)
    assert text.startswith("a.nc")
    assert expect.message in text
    assert text.endswith("; see contract anomaly-grid/1.0.0")


def test_names_resolve_to_the_newest_version_of_a_major() -> None:
    assert contracts.resolve("anomaly-grid/1") == "anomaly-grid/1.0.0"
    assert contracts.resolve("anomaly-grid/1.0") == "anomaly-grid/1.0.0"
    for name in ("anomaly-grid/2", "anomaly-grid/1.9", "no-such/1", "anomaly-grid"):
        with pytest.raises(ContractError, match=f"no contract named '{name}'; expected one of"):
            contracts.resolve(name)


@pytest.mark.parametrize(
    "contract", [f"{name}/{v}" for name, vs in contracts.available().items() for v in vs]
)
def test_every_schema_is_a_schema(contract: str) -> None:
    schema = contracts.load_schema(contract)
    jsonschema.Draft202012Validator.check_schema(schema)
    assert schema["$id"] == f"magtiles:{contract.replace('/', '-')}"


def test_descriptor_says_what_the_arrays_hold() -> None:
    described = contracts.describe(grid())
    anomaly = described["variables"]["magnetic_anomaly"]
    assert described["dims"] == {"y": 4, "x": 5}
    assert (anomaly["minimum"], anomaly["maximum"], anomaly["finite"]) == (0.0, 19.0, False)
    assert described["variables"]["x"]["ascending"] is True
    empty = contracts.describe(xr.Dataset({"a": ("x", np.full(3, np.nan))}))
    assert empty["variables"]["a"]["minimum"] is None
