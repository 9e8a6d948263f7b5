"""Tiles, temporal models and road maps against CF-1.11, by the IOOS compliance checker.

The checker depends on an LGPL library, so it is no dependency of ours and stays out of our
environment: install it in one of its own, and name its program in
MAGTILES_COMPLIANCE_CHECKER, or have it on the PATH.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
import xarray as xr
from road_maps import Road, road_map
from temporal import temporal_dataset

from magtiles.pipeline.build import build_product
from magtiles.pipeline.sample import DEMO, synthesize, write_survey
from magtiles.stages.release.road_file import write_road
from magtiles.stages.release.temporal_file import write_temporal
from magtiles.stages.release.tile_file import write_tile

CHECKER = os.environ.get("MAGTILES_COMPLIANCE_CHECKER") or shutil.which("compliance-checker")
pytestmark = pytest.mark.skipif(CHECKER is None, reason="no compliance-checker")

# The checker, since 5.4, asks each coordinate called height for the standard name `height`, which
# the CF table defines as above the surface. That is true above terrain; elsewhere ours says what it
# is above. CF has no such rule, and the checker's authors are about to drop it
# (github.com/ioos/compliance-checker, issue 1245, pull request 1353).
WRONG_RULE = "check_spatiotemporal_dims_have_coordinate_vars"
FOUND = {
    "ellipsoid": {"height_above_reference_ellipsoid"},
    "mean_sea_level": {"altitude"},
    "terrain": set(),
}
# CF 2.4 recommends time before other dimensions, and does not require it.
RECOMMENDED = "spatio-temporal dimensions are not in the recommended order"


def complaints(path: Path, folder: Path, *options: str) -> set[str]:
    """Everything the checker holds against a file, whatever its priority."""
    out = folder / "report.json"
    command = [str(CHECKER), "-t", "cf:1.11", "-c", "strict", "-f", "json", "-o", str(out)]
    subprocess.run([*command, *options, str(path)], capture_output=True, check=False)
    (report,) = json.loads(out.read_text("utf-8")).values()
    assert report["possible_points"] > 100
    kinds = ("high_priorities", "medium_priorities", "low_priorities")
    return {m for kind in kinds for found in report[kind] for m in found["msgs"]}


def test_every_tile_of_a_built_release_keeps_them(tmp_path: Path) -> None:
    spec = replace(DEMO, name="small", width_m=60e3, length_m=50e3, dipoles=50, levels_m=(2500.0,))
    product = write_survey(tmp_path, synthesize(spec))[-1]
    release = build_product(product, store=tmp_path / "store", work=tmp_path / "work").path
    tiles = sorted((release / "tiles").glob("*.nc"))
    assert tiles
    for tile in tiles:
        assert complaints(tile, tmp_path, "-s", WRONG_RULE) == set()
    for reference, names in FOUND.items():
        above = tmp_path / f"{reference}.nc"
        with xr.open_dataset(tiles[0], engine="netcdf4", mask_and_scale=False) as tile_of:
            write_tile(tile_of.load().assign_attrs(height_reference=reference), above, checked=True)
        assert complaints(above, tmp_path) == {
            f"Coordinate variable 'height' should have standard_name='height', found: '{name}'"
            for name in names
        }
        assert complaints(above, tmp_path, "-s", WRONG_RULE) == set()


def test_a_temporal_model_keeps_them(tmp_path: Path) -> None:
    write_temporal(temporal_dataset(), tmp_path / "temporal.nc")
    found = complaints(tmp_path / "temporal.nc", tmp_path)
    assert [text for text in found if RECOMMENDED not in text] == []


def test_a_road_map_keeps_them(tmp_path: Path) -> None:
    write_road(road_map(Road("loop", 300.0, 30)), tmp_path / "loop.nc")
    assert complaints(tmp_path / "loop.nc", tmp_path) == set()
