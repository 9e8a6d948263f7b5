"""Real surveys become validated releases."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from magtiles.catalog import open_release
from magtiles.pipeline.build import build_product
from magtiles.pipeline.validate import validate_release


class Survey(NamedTuple):
    """A real grid: its TOML keys, and a place and height where the release must answer."""

    file: str
    grid: str
    anomaly: str
    latitude: float
    longitude: float
    height: float
    total: tuple[float, float]


# Flown 150 m above ground; the intrusion's peak is 1678 nT at the survey surface.
MAG5001 = Survey(
    "mag5001.gxf",
    'crs = "+proj=lcc +lat_0=41 +lon_0=-107.5 +lat_1=33 +lat_2=45 +datum=NAD27"\n'
    'height_m = 150\nreference_epoch = "1975-07-01"\nline_spacing_m = 800\n',
    "heights_m = [300, 650, 1150, 2150]\n",
    44.505, -104.455, 300.0, (300.0, 1700.0),
)  # fmt: skip
TEMPEST = Survey(
    "tempest_magnetics.tif",
    'height_m = 120\nreference_epoch = "2019-11-28"\n',
    "heights_m = [1120, 2120]\n"
    "region = {latitude = [36.2, 37.0], longitude = [-90.4, -89.2]}\n",
    36.8, -89.82, 1120.0, (300.0, 1200.0),
)  # fmt: skip


@pytest.mark.parametrize("survey", [MAG5001, TEMPEST], ids=["gxf", "geotiff"])
def test_a_real_survey_becomes_a_validated_release(
    survey: Survey, real_data: Path, tmp_path: Path
) -> None:
    (tmp_path / "source.toml").write_text(
        f'[source]\nid = "real"\nkind = "anomaly-grid"\nfiles = ["{survey.file}"]\n'
        f'licence = "US public domain"\n[grid]\n{survey.grid}height_reference = "terrain"\n'
        'reference_field = "IGRF-13"\nuncertainty_nt = 5.0\n'
    )
    product = tmp_path / "product.toml"
    product.write_text(
        '[product]\nname = "real"\nversion = "1.0.0"\n[anomaly]\nsource = "source.toml"\n'
        f'height_reference = "terrain"\n{survey.anomaly}'
    )
    release = build_product(
        product, store=tmp_path / "store", work=tmp_path / "work", data=real_data / "grids"
    ).path
    assert [check.name for check in validate_release(release) if not check.passed] == []
    anomaly = open_release(release).anomaly
    total = anomaly.total(survey.latitude, survey.longitude, height_above_reference=survey.height)
    assert survey.total[0] < total < survey.total[1]
    north_pole = anomaly.total(89.0, survey.longitude, height_above_reference=survey.height)
    assert np.isnan(north_pole)
