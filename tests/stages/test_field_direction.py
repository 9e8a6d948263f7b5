"""The ambient direction: IGRF of the generation named, at the epoch, or the angles given."""

from __future__ import annotations

import datetime
from pathlib import Path

import numpy as np
import ppigrf
import pytest
from grids import projected_grid

from magtiles.schemas.errors import ParameterError
from magtiles.stages.field.direction import AmbientSource, from_angles
from magtiles.stages.ingest.field_model import igrf_coefficients

LATITUDE, LONGITUDE = np.array([45.0, -34.0, 0.0]), np.array([-121.0, 148.0, 20.0])


def grid(**attributes):
    axes = 5.1e6 + 1000.0 * np.arange(8), 5e5 + 1000.0 * np.arange(9)
    return projected_grid(np.zeros((8, 9)), *axes, height=1500.0, **attributes)


def by_ppigrf(date: datetime.datetime, name: str) -> tuple[np.ndarray, np.ndarray]:
    file = Path(ppigrf.__file__).with_name(f"{name}.shc")
    east, north, up = (
        a[0] for a in ppigrf.igrf(LONGITUDE, LATITUDE, 1.5, date, coeff_fn=str(file))
    )
    inclination = np.degrees(np.arctan2(-up, np.hypot(north, east)))
    return inclination, np.degrees(np.arctan2(east, north))


@pytest.mark.parametrize(
    ("field", "file"), [("IGRF-13", "IGRF13"), ("IGRF-14", "IGRF14"), ("DGRF 1985", "IGRF14")]
)
def test_igrf_of_the_generation_named(field, file):
    """In 2025 the two generations differ: 13 predicts, 14 has seen.

    At an epoch: between them ppigrf counts elapsed days where the IGRF has years. What is left,
    3.5e-7 degrees, is its geodetic conversion.
    """
    source = AmbientSource(grid(reference_field=field, reference_epoch="2025-01-01"), None, None)
    found = source.at(LATITUDE, LONGITUDE)
    inclination, declination = by_ppigrf(datetime.datetime(2025, 1, 1), file)  # noqa: DTZ001
    assert found.inclination_deg == pytest.approx(inclination, abs=1e-6)
    assert found.declination_deg == pytest.approx(declination, abs=1e-6)
    assert np.sqrt(found.north**2 + found.east**2 + found.down**2) == pytest.approx(1.0)


def test_generations_do_differ():
    date = datetime.datetime(2025, 1, 1)  # noqa: DTZ001
    difference = by_ppigrf(date, "IGRF13")[1] - by_ppigrf(date, "IGRF14")[1]
    assert np.abs(difference).max() > 0.005


@pytest.mark.parametrize(("field", "found"), [("IGRF-14", "IGRF14.shc"), ("igrf 13", "IGRF13.shc")])
def test_coefficient_file(field, found):
    assert igrf_coefficients(field).name == found


@pytest.mark.parametrize("field", ["mixed", "IGRF-99", "IGRF-1 4x", "../IGRF14", ""])
def test_no_coefficient_file(field):
    assert igrf_coefficients(field) is None


@pytest.mark.parametrize(
    ("inclination", "declination", "expected"),
    [
        (90.0, 30.0, (0.0, 0.0, 1.0)),
        (0.0, 90.0, (0.0, 1.0, 0.0)),
        (-30.0, 180.0, (-np.sqrt(0.75), 0.0, -0.5)),
    ],
)
def test_angles(inclination, declination, expected):
    assert np.ravel(from_angles(inclination, declination, (1,))) == pytest.approx(expected)
    given = AmbientSource(grid(), inclination, declination).at(LATITUDE, LONGITUDE)
    assert np.stack(given)[:, 2] == pytest.approx(expected)


@pytest.mark.parametrize("angles", [(60.0, None), (None, 17.0)])
def test_one_angle_alone_is_refused(angles):
    with pytest.raises(ParameterError, match="inclination_deg and declination_deg"):
        AmbientSource(grid(), *angles)
