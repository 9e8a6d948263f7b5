"""How well the reader tells one real observatory's quiet days from the others'."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import ppigrf
import pytest
import xarray as xr

from magtiles.catalog.models import read_model
from magtiles.catalog.releases.temporal import TemporalModel
from magtiles.catalog.releases.temporal_file import read_temporal
from magtiles.stages.ingest import index
from magtiles.stages.ingest.observatory import stage as ingest
from magtiles.stages.release.temporal_file import write_temporal
from magtiles.stages.temporal import assemble, baseline

# Geodetic latitude and longitude, as stations_from_ack.csv has them; rms told and of no curve.
STATIONS = {
    "bou": (40.14, 254.767, 3.3, 10.5),
    "frd": (38.21, 282.633, 3.5, 10.5),
    "clf": (48.017, 2.267, 4.9, 8.8),
    "kak": (36.232, 140.186, 6.7, 9.5),
    "hon": (21.32, 202.0, 6.3, 11.0),
    "kou": (5.1, 307.4, 10.0, 15.3),
    "gua": (13.59, 144.87, 11.1, 15.9),
    "her": (-34.425, 19.225, 17.9, 11.5),
}


@pytest.fixture(scope="module")
def curves(real_data: Path) -> dict[str, xr.Dataset]:
    quiet = index.STAGE.run(
        files=[real_data / "indices/gfz_quiet_days/qd201019.txt"], params=index.STAGE.params()
    )
    found = {}
    for code, (latitude, longitude, *_) in STATIONS.items():
        file = next((real_data / "observatory_wdc_hourly/2013").glob(f"{code}2013.wdc*"))
        place = ingest.STAGE.params(latitude=latitude, longitude=longitude, elevation_m=0.0)
        record = ingest.STAGE.run(files=[file], params=place)
        found[code] = baseline.STAGE.run(series=record, index=quiet, params=baseline.STAGE.params())
    return found


def test_each_observatory_is_told_from_the_others(
    curves: dict[str, xr.Dataset], tmp_path: Path
) -> None:
    core = read_model(Path(ppigrf.__file__).with_name("IGRF14.shc"))
    for code, (latitude, longitude, told, without) in STATIONS.items():
        others = [model for name, model in curves.items() if name != code]
        write_temporal(
            assemble.STAGE.run(models=others, params=assemble.STAGE.params()), tmp_path / "t.nc"
        )
        read = read_temporal((tmp_path / "t.nc").read_bytes(), "t.nc")
        model = TemporalModel(read, lambda: core, "release x")
        months = model.months.astype("datetime64[ns]")
        # At mid-month, each hour of the local day.
        middle = months + (np.append(months[1:], np.datetime64("2014-01-01")) - months) // 2
        day = middle.astype("datetime64[D]").astype("datetime64[ns]")
        universal = (np.arange(24.0) - longitude / 15.0) % 24.0
        time = day[:, None] + (universal * 3.6e12).astype("timedelta64[ns]")
        truth = curves[code]["baseline"].values[0, :3, :, ::60]
        answer = model.baseline(latitude, longitude, time)
        error = np.moveaxis(answer.values[..., :3], -1, 0) - truth
        rms = float(np.sqrt(np.nanmean(error**2)))
        assert rms == pytest.approx(told, rel=0.1), code
        assert float(np.sqrt(np.nanmean(truth**2))) == pytest.approx(without, rel=0.1), code
        if code == "her":
            assert answer.dip_distance.min() > 50.0
