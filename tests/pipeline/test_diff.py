"""What changed between two releases is found where it was made, and sized as it was made."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from magtiles.catalog.flags import QualityFlag
from magtiles.catalog.kernels.bspline import HALO
from magtiles.catalog.releases.manifest import read_manifest
from magtiles.pipeline.difference import compare_releases
from magtiles.pipeline.main import main

QUANTITIES = ["total", "north", "east", "down", "nn", "ne", "nd", "ee", "ed"]


def test_a_release_does_not_differ_from_itself(exact_release: Path) -> None:
    found = compare_releases(exact_release, exact_release)
    assert (found.bump, found.enough, found.reason) == (None, True, "nothing changed")
    assert [one.quantity for one in found.levels[:9]] == QUANTITIES
    assert len(found.levels) == 9 * len(read_manifest(exact_release).heights_m)
    assert not any(one.changed or one.largest for one in found.levels)
    assert (found.gained, found.lost, found.interpolated) == (0, 0, False)


def test_one_changed_node_is_found(exact_release: Path, spoilt_release: Callable) -> None:
    def change(row, column, arrays):
        if (row, column) == (0, 0):
            arrays["magnetic_anomaly"][1, HALO + 3, HALO + 4] += np.float32(5.0)

    new = spoilt_release(change)
    found = compare_releases(exact_release, new)
    assert (found.bump, found.enough) == ("minor", False)  # both are 1.2.3
    (one,) = [one for one in found.levels if one.changed]
    manifest = read_manifest(exact_release)
    assert (one.quantity, one.height_m) == ("total", manifest.heights_m[1])
    assert one.changed == 1
    assert one.largest == pytest.approx(5.0, abs=1e-4)  # f4 of some hundred nT
    assert one.rms == pytest.approx(5.0 / np.sqrt(one.nodes), rel=1e-4)
    assert one.sigmas == pytest.approx(2.5, rel=1e-4)
    lattice = manifest.lattice
    assert one.latitude == pytest.approx(lattice.south + 3 * lattice.latitude_spacing)
    assert one.longitude == pytest.approx(lattice.west + 4 * lattice.longitude_spacing)


def test_coverage_gained(exact_release: Path, spoilt_release: Callable) -> None:
    """The eastern edge, one column of nodes, is beyond coverage in the old release only."""

    def change(row, column, arrays):
        arrays["quality_flag"] &= np.uint8(~QualityFlag.BEYOND_COVERAGE & 0xFF)

    new = spoilt_release(change)
    rows = read_manifest(exact_release).lattice.rows
    found = compare_releases(exact_release, new)
    assert (found.gained, found.lost) == (rows + 1, 0)
    back = compare_releases(new, exact_release)
    assert (back.gained, back.lost) == (0, rows + 1)


def test_what_changed_in_sigma_and_flags_is_told(
    exact_release: Path, spoilt_release: Callable, capsys: pytest.CaptureFixture[str]
) -> None:
    """The values are the same, and the bump would be without a reason in nT."""

    def change(row, column, arrays):
        arrays["vector_uncertainty"][0] *= np.float32(2.0)
        if (row, column) == (0, 0):
            arrays["quality_flag"][1, HALO + 3, HALO + 4] |= QualityFlag.POORLY_LEVELLED

    new = spoilt_release(change)
    found = compare_releases(exact_release, new)
    low, high = read_manifest(exact_release).heights_m[:2]
    (one,) = [one for one in found.sigmas if one.changed]
    assert (one.of, one.height_m, one.changed) == ("vector", low, one.nodes)
    assert (one.median, one.smallest, one.largest) == (2.0, 2.0, 2.0)
    assert {height: count for height, count in found.flags.items() if count} == {high: 1}
    assert main(["diff", str(exact_release), str(new)]) == 1
    printed = capsys.readouterr().out
    assert "total, vector and tensor: no value changed" in printed
    assert f"flags changed at 1 nodes of level {high:g}" in printed
    assert "new/old" in printed


def test_heights_from_another_surface_are_named(
    exact_release: Path, terrain_release: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["diff", str(exact_release), str(terrain_release)]) == 1
    assert "heights count from ellipsoid in the old, terrain in the new" in capsys.readouterr().out


def test_coverage_beyond_the_old_lattice_is_gained(
    exact_release: Path, wider_release: Path
) -> None:
    """Two columns of cells more in the east; the old release has no nodes there."""
    found = compare_releases(exact_release, wider_release)
    lattice = read_manifest(exact_release).lattice
    assert found.lost == 0
    assert found.gained >= 2 * (lattice.rows + 1)
    assert not found.interpolated


def test_another_lattice_is_interpolated(exact_release: Path, finer_release: Path) -> None:
    """The same field on both: what is left is the interpolation's error, 0.01 % of the rms."""
    found = compare_releases(exact_release, finer_release)
    assert found.interpolated
    assert found.bump == "major"
    lowest = {one.quantity: one for one in found.levels[:9]}
    assert lowest["total"].nodes > 1000
    rms = np.sqrt(np.mean([t.statistics["magnetic_anomaly"]["rms"][0] ** 2
                           for t in read_manifest(exact_release).tiles.values()]))  # fmt: skip
    # Measured 0.00010 and 0.0014; 0.0012 and 0.014, at the border, where the halo was not used.
    assert lowest["total"].rms < 0.0003 * rms
    assert abs(lowest["total"].largest) < 0.004 * rms


def test_the_command(
    exact_release: Path, finer_release: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "change.png"
    arguments = ["diff", str(exact_release), str(finer_release)]
    assert main([*arguments, "--map", str(picture)]) == 1
    printed = capsys.readouterr().out
    assert "exact 1.2.3 to exact 1.2.3: the grid changed from" in printed
    assert "due a MAJOR bump, and has NOT got it" in printed
    assert "the lattices differ" in printed
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert main([*arguments, "--json"]) == 1
    document = json.loads(capsys.readouterr().out)
    assert document["bump"] == "major"
    assert len(document["levels"]) % 9 == 0
    assert main(["diff", str(exact_release), str(exact_release)]) == 0
    assert "nothing changed" in capsys.readouterr().out
    assert main([*arguments, "--map", str(picture), "--level", "7"]) == 2
    assert "no such level in both releases" in capsys.readouterr().err
