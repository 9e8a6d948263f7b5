"""A build's release: overlaps to the bit, the same bytes anywhere, the same again for nothing."""

from __future__ import annotations

import hashlib
import itertools
import shutil
from dataclasses import replace
from pathlib import Path

import netCDF4
import numpy as np
import pytest

from magtiles.pipeline.build import build_product
from magtiles.pipeline.sample import DEMO, synthesize, write_survey
from magtiles.schemas.errors import CoverageError, SourceError, VersionError

SPEC = replace(
    DEMO, name="small", width_m=90e3, length_m=70e3, dipoles=150, levels_m=(2500.0, 4500.0)
)


def build(folder: Path, product: Path):
    return build_product(product, store=folder / "store", work=folder / "work")


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> Path:
    """The folder of survey and product; tiles of 0.25 degrees, so that there are many."""
    folder = tmp_path_factory.mktemp("inputs")
    product = write_survey(folder, synthesize(SPEC))[-1]
    product.write_text(product.read_text() + "tile_deg = 0.25\n")
    return folder


@pytest.fixture(scope="module")
def built(inputs, tmp_path_factory) -> Path:
    return build(tmp_path_factory.mktemp("first"), inputs / "small.toml").path


def read_tiles(release: Path) -> dict[tuple[int, int], dict[str, np.ndarray]]:
    """Every array of every tile, by a plain netCDF reader."""
    tiles = {}
    for path in sorted((release / "tiles").glob("*.nc")):
        with netCDF4.Dataset(path) as file:
            file.set_auto_mask(False)
            arrays = {name: np.asarray(v[...]) for name, v in file.variables.items()}
            tiles[int(file.tile_row), int(file.tile_column)] = arrays
    return tiles


def test_overlaps_are_identical_to_the_bit(built):
    tiles = read_tiles(built)
    assert len(tiles) >= 12
    compared = 0
    for a, b in itertools.combinations(sorted(tiles), 2):
        if max(abs(a[0] - b[0]), abs(a[1] - b[1])) > 1:
            continue
        one, two = tiles[a], tiles[b]
        shared = []
        for axis in ("latitude", "longitude"):
            # The same node must have the same coordinate, to the last bit too.
            common, i, j = np.intersect1d(one[axis], two[axis], return_indices=True)
            step = np.diff(one[axis]).mean()
            overlap = min(one[axis][-1], two[axis][-1]) - max(one[axis][0], two[axis][0])
            assert common.size == round(overlap / step) + 1 >= 24
            shared.append((i, j))
        rows, columns = shared
        for name, values in one.items():
            if values.ndim < 2:
                continue
            left = values[..., rows[0][:, None], columns[0]]
            right = two[name][..., rows[1][:, None], columns[1]]
            assert left.tobytes() == right.tobytes(), (a, b, name)
            compared += 1
    assert compared > 200


def digests(release: Path) -> dict[str, str]:
    return {
        str(path.relative_to(release)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(release.rglob("*"))
        if path.is_file()
    }


def test_the_same_bytes_in_another_folder(inputs, built, tmp_path):
    """Inputs copied elsewhere, other work, other store: every file of the release the same."""
    copied = shutil.copytree(inputs, tmp_path / "elsewhere" / "in")
    again = build(tmp_path, copied / "small.toml")
    first, second = digests(built), digests(again.path)
    assert {"manifest.json", "checks.json", "provenance.json"} <= first.keys()
    assert first == second


def test_building_again_changes_nothing(inputs, built):
    before = digests(built)
    result = build(built.parents[2], inputs / "small.toml")
    assert result.path == built
    assert digests(built) == before


def test_levels_below_the_survey_need_permission(inputs, tmp_path):
    product = tmp_path / "low.toml"
    text = (inputs / "small.toml").read_text().replace("[2500.0, 4500.0]", "[500.0]")
    shutil.copytree(inputs, tmp_path, dirs_exist_ok=True)
    product.write_text(text)
    with pytest.raises(CoverageError, match=r"500.*allow_downward_continuation"):
        build(tmp_path, product)


def test_other_content_under_the_same_version_is_refused(inputs, built, tmp_path):
    copied = shutil.copytree(inputs, tmp_path / "in")
    product = copied / "small.toml"
    product.write_text(product.read_text().replace("4500.0", "5500.0"))
    with pytest.raises(VersionError, match=r"1\.0\.0"):
        build_product(product, store=built.parents[1], work=tmp_path / "work")


def test_a_product_without_its_source_is_refused(inputs, tmp_path):
    product = Path(shutil.copy(inputs / "small.toml", tmp_path))
    with pytest.raises(SourceError, match=r"small-survey\.toml"):
        build(tmp_path, product)
