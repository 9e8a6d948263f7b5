"""Unions of temporal models: nothing lost, nothing contradicted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from daily import MEAN_FIELD, daily, quiet_list, record, times

from magtiles.catalog.models import evaluate
from magtiles.pipeline.artifacts import write_artifact
from magtiles.pipeline.runner import run_stage
from magtiles.schemas import contracts
from magtiles.schemas.errors import ContractError
from magtiles.stages.ingest.field_model import igrf
from magtiles.stages.temporal.assemble import STAGE, AssembleTemporalParams, assemble_temporal
from magtiles.stages.temporal.baseline import QuietDayBaselineParams, quiet_day_baseline

LIST = quiet_list({f"2024-{m:02d}": list(range(4, 14)) for m in (1, 2, 3)})
PLACES = {"BOU": (40.137, -105.237), "KOU": (5.21, -52.73)}


def curves(code: str, start: str, end: str, scale: float = 1.0) -> xr.Dataset:
    latitude, longitude = PLACES[code]
    time = times(start, end, 3600.0)
    vector = MEAN_FIELD[:, None] + scale * daily(time, longitude)
    series = record(
        time, vector, code=code, latitude=latitude, longitude=longitude, cadence_s=3600.0
    )
    series.attrs["source"] = f"{code} from {start}"
    return quiet_day_baseline(series, params=QuietDayBaselineParams(), index=LIST)


def statistics(code: str, starts: list[str], sigma: float = 7.0) -> xr.Dataset:
    """The part of a model that fit-fogm makes, with two classes."""
    start = np.array(starts, "datetime64[ns]")
    shape = (1, 4, start.size)
    whole = curves(code, "2024-01-01", "2024-02-02")
    place = ["iaga_code", "latitude", "longitude", "elevation", "dip_latitude", "element"]
    nt, seconds = {"units": "nT"}, {"units": "s"}
    variables = {
        name: (("observatory", "element", "segment"), np.full(shape, value), units)
        for stem, value, units in (("sigma", sigma, nt), ("tau", 900.0, seconds))
        for name in (stem, f"{stem}_low", f"{stem}_high", f"{stem}_autocorrelation")
    }
    of_class = ("observatory", "element", "class")
    return whole[place].assign(variables).assign(
        segment_start=("segment", start),
        kp=("segment", np.arange(start.size, dtype=np.float32), {"units": "1"}),
        tau_unidentified=(("observatory", "element", "segment"), np.zeros(shape, np.uint8)),
        class_kp=("class", np.array([-1, 1], np.int8)),
        class_season=("class", np.array([-1, -1], np.int8)),
        class_local_time=("class", np.array([-1, -1], np.int8)),
        class_sigma=(of_class, np.full((1, 4, 2), sigma), nt),
        class_tau=(of_class, np.full((1, 4, 2), 900.0), seconds),
        class_segments=(of_class, np.full((1, 4, 2), 40, np.int32)),
        class_tau_unidentified=(of_class, np.zeros((1, 4, 2), np.uint8)),
    ).assign_attrs(segment_s=10800.0, source=f"{code} statistics")  # fmt: skip


def assembled(*models: xr.Dataset) -> xr.Dataset:
    made = assemble_temporal(models, params=AssembleTemporalParams())
    contracts.check(made, STAGE.output)
    return made


def test_observatories_months_and_segments_are_united() -> None:
    kou, early, late = (
        curves("KOU", "2024-02-01", "2024-04-02"),
        curves("BOU", "2024-01-01", "2024-02-02"),
        curves("BOU", "2024-02-01", "2024-03-02"),
    )
    of_bou = statistics("BOU", ["2024-01-01T03", "2024-01-01T00"])
    of_kou = statistics("KOU", ["2024-01-01T06", "2024-01-01T03"][::-1], sigma=9.0)
    made = assembled(kou, of_kou, late, early, of_bou)
    assert made["iaga_code"].values.tolist() == ["BOU", "KOU"]
    months = made["month"].values.astype("datetime64[M]").astype(str)
    assert months.tolist() == ["2024-01", "2024-02", "2024-03"]
    for code, month, source in ((0, 0, early), (0, 1, late), (1, 1, kou), (1, 2, kou)):
        at = int(np.flatnonzero(source["month"].values == made["month"].values[month])[0])
        for name in ("baseline", "baseline_standard_error"):
            np.testing.assert_array_equal(
                made[name].values[code, :, month], source[name].values[0, :, at]
            )
        np.testing.assert_array_equal(
            made["quiet_day"].values[code, month], source["quiet_day"].values[0, at]
        )
    assert np.isnan(made["level"].values[0, :, 2]).all()
    assert made["quiet_day_choice"].values.tolist() == [[1, 1, 0], [0, 1, 1]]
    assert made["quiet_day_choice"].dtype == np.uint8
    assert (np.diff(made["segment_start"].values) > np.timedelta64(0)).all()
    np.testing.assert_array_equal(made["sigma"].values[:, 0], [[7, 7, np.nan], [np.nan, 9, 9]])
    np.testing.assert_array_equal(made["tau_unidentified"].values[:, 0], [[0, 0, 1], [1, 0, 0]])
    assert made["class_segments"].dtype == np.int32
    assert made["class_kp"].values.tolist() == [-1, 1]
    assert (made.attrs["segment_s"], made.attrs["cadence_s"]) == (10800.0, 3600.0)
    minutes = assembled(kou, of_bou.assign_attrs(cadence_s=60.0))
    assert "cadence_s" not in minutes.attrs
    assert made["quiet_day_choice"].attrs["flag_meanings"].startswith("list kp record")
    assert made.attrs["source"].split("; ")[0] == "KOU from 2024-02-01"


def test_the_order_of_models_changes_nothing_but_the_sources() -> None:
    parts = curves("KOU", "2024-02-01", "2024-03-02"), curves("BOU", "2024-01-01", "2024-02-02")
    xr.testing.assert_equal(assembled(*parts), assembled(*parts[::-1]))


def test_dip_latitude_is_that_of_the_middle_of_it_all() -> None:
    made = assembled(
        curves("KOU", "2024-01-01", "2024-02-02"), curves("KOU", "2024-03-01", "2024-04-02")
    )
    latitude, longitude = PLACES["KOU"]
    # January and March begin the first and last month: half-way is the night of 30 January.
    north, east, down = evaluate(igrf(), latitude, longitude, 1682.0, "2024-01-31")
    truth = np.degrees(np.arctan(0.5 * down / np.hypot(north, east)))
    assert made["dip_latitude"].values == pytest.approx(truth, abs=1e-9)
    assert truth == pytest.approx(5.87, abs=0.01)


def test_the_same_statement_twice_is_no_clash() -> None:
    whole = curves("BOU", "2024-01-01", "2024-03-02")
    part = curves("BOU", "2024-01-01", "2024-02-02")
    made = assembled(whole, part)
    np.testing.assert_array_equal(made["baseline"].values, whole["baseline"].values)


def moved(model: xr.Dataset) -> xr.Dataset:
    return model.assign(latitude=model["latitude"] + 0.1)


def coarse(model: xr.Dataset) -> xr.Dataset:
    return model.isel(minute=slice(None, None, 60))


EARLY = ("2024-01-01", "2024-02-02")
CLASHES = {
    "same code, other curves": (
        lambda: (curves("BOU", *EARLY), curves("BOU", *EARLY, scale=2.0)),
        r"BOU baseline: .* in one model and .* in another at element north, month 2024-01",
    ),
    "same code, other place": (
        lambda: (curves("BOU", *EARLY), moved(curves("BOU", "2024-02-01", "2024-03-02"))),
        r"BOU latitude: 40.137 in one model and 40.237 in another; .*'BOU from 2024-01-01' and",
    ),
    "other Kp": (
        lambda: (
            statistics("BOU", ["2024-01-01"]),
            statistics("KOU", ["2024-01-01"]).assign(kp=("segment", [5.0], {"units": "1"})),
        ),
        r"kp: 0 in one model and 5 in another at segment 2024-01-01",
    ),
    "other segments": (
        lambda: (
            statistics("BOU", ["2024-01-01"]),
            statistics("KOU", ["2024-01-01"]).assign_attrs(segment_s=3600.0),
        ),
        "segment_s: segments of 3600 and 10800 s; expected one length",
    ),
    "other minutes": (
        lambda: (curves("BOU", *EARLY), coarse(curves("KOU", *EARLY))),
        "curves of 1440 and of 24 minutes",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CLASHES)
def test_models_that_contradict_each_other(case: str) -> None:
    models, message = CLASHES[case]
    with pytest.raises(ContractError, match=message):
        assembled(*models())


def test_models_are_assembled_from_files(tmp_path: Path) -> None:
    parts = curves("KOU", "2024-02-01", "2024-03-02"), statistics("BOU", ["2024-01-01"])
    paths = [tmp_path / f"{n}.nc" for n in range(2)]
    for part, path in zip(parts, paths, strict=True):
        write_artifact(part, path, STAGE.output)
    made = run_stage(STAGE, {"models": paths}, tmp_path / "all.nc", {}).dataset
    assert made is not None
    xr.testing.assert_equal(made.load(), assembled(*parts))
