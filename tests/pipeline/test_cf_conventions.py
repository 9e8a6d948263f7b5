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
from road_maps import Road, road_map
from temporal import temporal_dataset

from magtiles.pipeline.build import build_product
from magtiles.pipeline.sample import DEMO, synthesize, write_survey
from magtiles.stages.release.road_file import write_road
from magtiles.stages.release.temporal_file import write_temporal

CHECKER = os.environ.get("MAGTILES_COMPLIANCE_CHECKER") or shutil.which("compliance-checker")
pytestmark = pytest.mark.skipif(CHECKER is None, reason="no compliance-checker")

# The checker (5.4 and 6.1) asks each variable called height for the standard name `height`,
# which the CF table defines as above the surface. Ours says what it is above.
WRONG_RULE = (
    "Coordinate variable 'height' should have standard_name='height', "
    "found: 'height_above_reference_ellipsoid'"
)
# CF 2.4 recommends time before other dimensions, and does not require it.
RECOMMENDED = "spatio-temporal dimensions are not in the recommended order"


def complaints(path: Path, folder: Path) -> set[str]:
    """Everything the checker holds against a file, whatever its priority."""
    out = folder / "report.json"
    command = [str(CHECKER), "-t", "cf:1.11", "-c", "strict", "-f", "json", "-o", str(out)]
    subprocess.run([*command, str(path)], capture_output=True, check=False)
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
        assert complaints(tile, tmp_path) <= {WRONG_RULE}


def test_a_temporal_model_keeps_them(tmp_path: Path) -> None:
    write_temporal(temporal_dataset(), tmp_path / "temporal.nc")
    found = complaints(tmp_path / "temporal.nc", tmp_path)
    assert [text for text in found if RECOMMENDED not in text] == []


def test_a_road_map_keeps_them(tmp_path: Path) -> None:
    write_road(road_map(Road("loop", 300.0, 30)), tmp_path / "loop.nc")
    assert complaints(tmp_path / "loop.nc", tmp_path) == set()
