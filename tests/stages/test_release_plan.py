"""Lattices of tiles: every bound covered, in whole cells, no coarser than asked."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest
from hypothesis import given
from hypothesis import strategies as st

from magtiles.schemas.errors import CoverageError, ParameterError
from magtiles.stages.release.plan import plan_lattice

GEOD = pyproj.Geod(ellps="WGS84")


@given(
    south=st.floats(-84.0, 80.0),
    height=st.floats(0.01, 4.0),
    west=st.floats(-180.0, 179.9),
    width=st.floats(0.01, 12.0),
    spacing=st.floats(50.0, 5000.0),
)
def test_covers_its_bounds_in_whole_cells(south, height, west, width, spacing):
    north, east = south + height, west + width
    lattice = plan_lattice((south, north, west, east), spacing)
    step_lat, step_lon = lattice.latitude_spacing, lattice.longitude_spacing
    slack = 1e-6
    for low, high, first, step, count in (
        (south, north, lattice.south, step_lat, lattice.rows),
        (west, east, lattice.west, step_lon, lattice.columns),
    ):
        assert first <= low + slack * step
        assert first + count * step >= high - slack * step
        assert first > low - (1 + slack) * step
        assert first + count * step < high + (1 + slack) * step
    # A tile is the same size in degrees both ways, and that is whole cells.
    assert lattice.tile_rows * step_lat == pytest.approx(lattice.tile_columns * step_lon, rel=1e-9)
    widest = float(np.clip(0.0, south, north))
    assert GEOD.line_length([0, step_lon], [widest, widest]) <= spacing * 1.001
    middle = (south + north) / 2
    assert GEOD.line_length([0, 0], [middle, middle + step_lat]) <= spacing * 1.01


@given(st.floats(0.3, 40.0), st.sampled_from([0.25, 0.5, 1.0]), st.floats(-179.0, 179.0))
def test_a_given_tile_holds_whole_cells(south, tile, west):
    lattice = plan_lattice((south, south + 1.0, west, west + 1.3), 500.0, tile)
    assert lattice.tile_rows * lattice.latitude_spacing == pytest.approx(tile, rel=1e-12)
    assert lattice.tile_columns * lattice.longitude_spacing == pytest.approx(tile, rel=1e-12)


def test_neighbouring_surveys_share_nodes():
    """Cells count from zero degrees: the same tile size makes lattices that fit together."""
    one = plan_lattice((45.0, 46.0, 8.0, 9.0), 1000.0, 0.5)
    two = plan_lattice((45.0, 46.0, 9.0, 10.0), 1000.0, 0.5)
    offset = (two.west - one.west) / one.longitude_spacing
    assert offset == pytest.approx(round(offset), abs=1e-6)


def test_poles_are_refused():
    with pytest.raises(CoverageError, match=r"85 degrees.*region\.latitude"):
        plan_lattice((80.0, 86.0, 0.0, 10.0), 1000.0)


def test_tiles_too_small_for_their_halo_are_refused():
    with pytest.raises(ParameterError, match=r"tile_deg.*24 cells"):
        plan_lattice((45.0, 46.0, 8.0, 9.0), 1000.0, 0.1)
