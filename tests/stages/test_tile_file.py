from __future__ import annotations

import time
from pathlib import Path

import netCDF4
import numpy as np
import pytest
import xarray as xr
from synthetic_release import World

from magtiles.catalog.releases.tile_table import LEVELS, TILE_VARIABLES
from magtiles.schemas import contracts
from magtiles.schemas.errors import ContractError
from magtiles.stages.release.tile_file import write_tile


@pytest.fixture(scope="module")
def tile() -> xr.Dataset:
    world = World(heights=(0.0, 500.0), surface=lambda lat, lon: 100.0 + 0.0 * lat * lon)
    return world.tile(1, 2, world.level_wide())


def test_what_is_written_is_read_back(tile: xr.Dataset, tmp_path: Path) -> None:
    write_tile(tile, tmp_path / "t.nc")
    with xr.open_dataset(tmp_path / "t.nc", engine="netcdf4", decode_cf=False) as back:
        contracts.check(back.load(), "anomaly-tile/1")
        for name, variable in tile.variables.items():
            np.testing.assert_array_equal(back[name].values, variable.values)
            assert back[name].dtype.name == TILE_VARIABLES[str(name)].dtype
        assert back.attrs.pop("title") == "magnetic anomaly tile, row 1, column 2"
        assert "provenance.json" in back.attrs.pop("history")
        assert back.attrs == tile.attrs


def test_the_same_tile_gives_the_same_bytes_later_and_elsewhere(
    tile: xr.Dataset, tmp_path: Path
) -> None:
    (tmp_path / "elsewhere").mkdir()
    write_tile(tile, tmp_path / "a.nc")
    time.sleep(1.1)  # HDF5 counts object times in whole seconds
    shuffled = tile[sorted(tile.variables, reverse=True)]
    shuffled.attrs = dict(reversed(list(tile.attrs.items())))
    write_tile(shuffled, tmp_path / "elsewhere" / "b.nc")
    assert (tmp_path / "a.nc").read_bytes() == (tmp_path / "elsewhere" / "b.nc").read_bytes()


def test_variables_are_packed_checked_and_described(tile: xr.Dataset, tmp_path: Path) -> None:
    write_tile(tile, tmp_path / "t.nc")
    with netCDF4.Dataset(tmp_path / "t.nc") as file:
        assert list(file.variables) == sorted(file.variables)
        assert file.ncattrs() == sorted(file.ncattrs())
        for name, rule in TILE_VARIABLES.items():
            variable = file[name]
            if not rule.dims:
                continue
            filters = variable.filters()
            assert filters["zlib"], name
            assert filters["shuffle"], name
            assert filters["fletcher32"], name
            assert variable.chunking()[0] == 1 or rule.dims != LEVELS
            assert variable.long_name == rule.long_name
            assert "_FillValue" not in variable.ncattrs()
        assert file["magnetic_anomaly"].grid_mapping == "crs"
        assert file["height"].standard_name == "height_above_reference_ellipsoid"
        assert file["quality_flag"].flag_meanings.split()[1] == "beyond_coverage"


def test_what_is_no_tile_is_refused_and_leaves_no_file(tile: xr.Dataset, tmp_path: Path) -> None:
    with pytest.raises(ContractError, match="'anomaly_east' is missing"):
        write_tile(tile.drop_vars("anomaly_east"), tmp_path / "t.nc")
    hole = tile.copy(deep=True)
    hole["gradient_nn"][0, 0, 0] = np.nan
    with pytest.raises(ContractError, match=r"gradient_nn\.finite"):
        write_tile(hole, tmp_path / "t.nc")
    assert list(tmp_path.iterdir()) == []
