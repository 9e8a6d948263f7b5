"""Publishing: whole or not at all, once or never, and the same bytes each time."""

from __future__ import annotations

import json
import os
import shutil
import socket
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic_release import World, made_in_a_test, small_lattice

from magtiles.catalog import open_release
from magtiles.catalog.releases.digest import canonical_json
from magtiles.schemas import contracts
from magtiles.schemas.errors import (
    ContractError,
    FormatError,
    IntegrityError,
    MagtilesError,
    SourceError,
    VersionError,
)
from magtiles.stages.release import publish as publish_module
from magtiles.stages.release.checks import make_checks, replay_checks
from magtiles.stages.release.lock import locked
from magtiles.stages.release.publish import published_versions
from magtiles.stages.release.records import measure_tile

LATTICE = replace(small_lattice(), rows=30, columns=34)
"""Two by two tiles."""


@pytest.fixture(scope="module")
def world() -> World:
    return World(lattice=LATTICE, heights=(0.0, 1000.0))


@pytest.fixture(scope="module")
def tiles(world: World, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return world.write_tiles(tmp_path_factory.mktemp("work"))


@pytest.fixture
def other_tiles(world: World, tiles: list[Path], tmp_path: Path) -> list[Path]:
    """The same tiles, but one value in one of them."""
    import netCDF4

    copies = [Path(shutil.copy(tile, tmp_path / tile.name)) for tile in tiles]
    with netCDF4.Dataset(copies[3], "a") as file:
        file["magnetic_anomaly"][0, 20, 20] += 1.0
    return copies


def contents(folder: Path) -> dict[str, bytes]:
    return {
        p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()
    }


def test_a_release_holds_what_the_design_says(
    world: World, tiles: list[Path], tmp_path: Path
) -> None:
    picture = tmp_path / "map.png"
    picture.write_bytes(b"png")
    result = world.publish(
        tmp_path, tiles=tiles, identity={"wavelength": "full"},
        extra_files={"preview/map.png": picture, "core_field.shc": picture},
    )  # fmt: skip
    assert result.changed
    assert result.path == tmp_path / "demo" / "1.0.0"
    names = set(contents(result.path))
    assert {"manifest.json", "checks.json", "provenance.json", "core_field.shc"} < names
    assert {"preview/map.png", "tiles/r000c000.nc", "tiles/r001c001.nc"} < names
    manifest = open_release(result.path).manifest
    assert manifest.lattice == world.lattice
    assert manifest.identity["wavelength"] == "full"
    assert manifest.created is None
    contracts.check_document(dict(manifest.document), "release-manifest/1")
    latest = json.loads((tmp_path / "demo" / "latest.json").read_bytes())
    assert latest == {
        "product": "demo", "version": "1.0.0", "manifest_digest": manifest.manifest_digest,
    }  # fmt: skip


def test_statistics_are_those_of_the_core(world: World, tiles: list[Path], tmp_path: Path) -> None:
    release = open_release(world.publish(tmp_path, tiles=tiles).path)
    tile = next(t for t in release.tiles() if (t.record.row, t.record.column) == (1, 0))
    core = tile.variables["gradient_nd"][:, 12:-12, 12:-12].astype(float)
    found = tile.record.statistics["gradient_nd"]
    np.testing.assert_allclose(found["maximum"], core.max(axis=(1, 2)), rtol=1e-5)
    np.testing.assert_allclose(found["rms"], np.sqrt((core**2).mean(axis=(1, 2))), rtol=1e-5)
    assert tile.record.bounds["latitude"] == pytest.approx((44.162, 44.27))


def test_a_published_release_is_read_only(world: World, tiles: list[Path], tmp_path: Path) -> None:
    path = world.publish(tmp_path, tiles=tiles).path
    for item in (path, *path.rglob("*")):
        assert not stat.S_IMODE(item.stat().st_mode) & 0o222, item


def test_the_same_content_in_another_folder_has_the_same_bytes(
    world: World, tmp_path: Path
) -> None:
    one = world.publish(tmp_path / "a").path
    two = world.publish(tmp_path / "deeper" / "b").path
    assert contents(one) == contents(two)


def test_dates_come_from_source_date_epoch_only(
    world: World, tiles: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "0")
    path = world.publish(tmp_path, tiles=tiles).path
    assert open_release(path).manifest.created == "1970-01-01T00:00:00Z"
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    assert not world.publish(tmp_path, tiles=tiles).changed


def test_publishing_again_changes_nothing(world: World, tiles: list[Path], tmp_path: Path) -> None:
    path = world.publish(tmp_path, tiles=tiles).path
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "demo").rglob("*")}
    again = world.publish(tmp_path, tiles=tiles, provenance=made_in_a_test(day="another"))
    assert (again.path, again.changed) == (path, False)
    after = {p: p.stat().st_mtime_ns for p in (tmp_path / "demo").rglob("*")}
    assert after == before


def test_other_content_needs_another_version(
    world: World, tiles: list[Path], other_tiles: list[Path], tmp_path: Path
) -> None:
    first = world.publish(tmp_path, tiles=tiles).path
    kept = contents(first)
    for version in ("1.0.0", "1.0.1"):
        with pytest.raises(VersionError, match=r"arrays changed in tiles/r001c001\.nc") as caught:
            world.publish(tmp_path, version, tiles=other_tiles)
        assert caught.value.remedy == 'set version = "1.1.0"'
    assert contents(first) == kept
    assert world.publish(tmp_path, "1.1.0", tiles=other_tiles).changed
    home = tmp_path / "demo"
    assert [m.version for m in published_versions(home)] == ["1.0.0", "1.1.0"]
    assert json.loads((home / "latest.json").read_bytes())["version"] == "1.1.0"


def test_latest_is_the_highest_version_not_the_last_built(
    world: World, tiles: list[Path], tmp_path: Path
) -> None:
    for version in ("1.9.0", "1.10.0", "1.2.0"):
        world.publish(tmp_path, version, tiles=tiles)
    assert json.loads((tmp_path / "demo/latest.json").read_bytes())["version"] == "1.10.0"


CRASH = """
import os, sys
sys.path.insert(0, sys.argv[1])
from pathlib import Path
from synthetic_release import World
from magtiles.stages.release import publish
setattr(publish, sys.argv[3], lambda *arguments: os._exit(9))
tiles = sorted(Path(sys.argv[4]).glob("*.nc"))
World(heights=(0.0, 1000.0)).publish(Path(sys.argv[2]), tiles=tiles)
"""


@pytest.mark.parametrize("step", ["_complete", "_rename", "_point_to_latest"])
def test_a_crash_leaves_no_half_release_and_the_next_build_cleans_up(
    world: World, tiles: list[Path], tmp_path: Path, step: str
) -> None:
    truth = Path(sys.modules["synthetic_release"].__file__ or "").parent
    arguments = [str(truth), str(tmp_path), step, str(tiles[0].parent)]
    died = subprocess.run([sys.executable, "-c", CRASH, *arguments], check=False)
    assert died.returncode == 9
    home = tmp_path / "demo"
    assert (home / "1.0.0").exists() == (step == "_point_to_latest")
    assert not (home / "latest.json").exists()
    assert world.publish(tmp_path, tiles=tiles).changed == (step != "_point_to_latest")
    assert sorted(p.name for p in home.iterdir()) == ["1.0.0", "latest.json"]
    replay_checks(open_release(home / "1.0.0"))


def test_an_error_on_the_way_leaves_nothing(
    world: World, tiles: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full_disk(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(publish_module, "_protect", full_disk)
    with pytest.raises(MagtilesError, match=r"1\.0\.0: cannot be written \(No space left.*free"):
        world.publish(tmp_path, tiles=tiles)
    assert list((tmp_path / "demo").iterdir()) == []


def test_the_staging_of_a_living_build_is_left_alone(
    world: World, tiles: list[Path], tmp_path: Path
) -> None:
    home = tmp_path / "demo"
    alive = home / f".staging.{socket.gethostname()}.{os.getppid()}"
    elsewhere = home / ".staging.another-machine.1"
    for folder in (alive, elsewhere):
        folder.mkdir(parents=True)
    world.publish(tmp_path, tiles=tiles)
    assert alive.is_dir()
    assert elsewhere.is_dir()
    os.utime(elsewhere, (0, 0))
    world.publish(tmp_path, tiles=tiles)
    assert alive.is_dir()
    assert not elsewhere.exists()


PUBLISH = """
import sys
sys.path.insert(0, sys.argv[1])
from pathlib import Path
from synthetic_release import World
tiles = sorted(Path(sys.argv[3]).glob("*.nc"))
print(World(heights=(0.0, 1000.0)).publish(Path(sys.argv[2]), tiles=tiles).changed)
"""


def test_of_two_at_once_one_publishes_and_the_other_waits(
    world: World, tiles: list[Path], tmp_path: Path
) -> None:
    truth = Path(sys.modules["synthetic_release"].__file__ or "").parent
    home = tmp_path / "demo"
    command = [sys.executable, "-c", PUBLISH, str(truth), str(tmp_path), str(tiles[0].parent)]
    with locked(home, ".publish.lock", doing="publishing"):
        both = [
            subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
            for _ in range(2)
        ]
        for process in both:
            assert process.stderr is not None
            told = process.stderr.readline()
            assert told == f"another process is publishing in {home}: waiting for it\n"
        assert [path.name for path in home.iterdir()] == [".publish.lock"]
    assert sorted(process.communicate()[0] for process in both) == ["False\n", "True\n"]
    assert sorted(p.name for p in home.iterdir()) == ["1.0.0", "latest.json"]


def test_losing_a_race_is_an_error_that_says_so(
    world: World, tiles: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def overtaken(staging: Path) -> None:
        (tmp_path / "demo/1.0.0/tiles").mkdir(parents=True)

    monkeypatch.setattr(publish_module, "_protect", overtaken)
    with pytest.raises(VersionError, match="by another process meanwhile"):
        world.publish(tmp_path, tiles=tiles)


def test_tiles_that_do_not_fit_together_are_refused(
    world: World, tiles: list[Path], tmp_path: Path
) -> None:
    with pytest.raises(ContractError, match=r"missing \[\(1, 1\)\]"):
        world.publish(tmp_path, tiles=tiles[:3])
    with pytest.raises(ContractError, match="5 tiles at 4 places"):
        world.publish(tmp_path, tiles=[*tiles, tiles[0]])
    with pytest.raises(ContractError, match="expected at least one tile"):
        world.publish(tmp_path, tiles=[])
    strange = World(lattice=LATTICE, heights=(0.0, 2000.0)).write_tiles(tmp_path / "strange")
    with pytest.raises(ContractError, match="height is"):
        world.publish(tmp_path, tiles=[*tiles[:-1], strange[-1]])
    assert not (tmp_path / "demo").exists()


def test_a_tile_off_the_lattice_is_refused(world: World, tiles: list[Path], tmp_path: Path) -> None:
    import netCDF4

    moved = Path(shutil.copy(tiles[3], tmp_path / "moved.nc"))
    with netCDF4.Dataset(moved, "a") as file:
        file["longitude"][:] += 1e-5
    with pytest.raises(ContractError, match=r"moved\.nc: longitude is not on the lattice"):
        world.publish(tmp_path, tiles=[*tiles[:3], moved])


@pytest.mark.parametrize("data", [b"", b"\x89HDF\r\n\x1a\n"], ids=["empty", "truncated"])
def test_a_file_that_is_no_tile_is_refused(
    world: World, tiles: list[Path], tmp_path: Path, data: bytes
) -> None:
    broken = tmp_path / "broken.nc"
    broken.write_bytes(data)
    with pytest.raises(FormatError, match=r"broken\.nc: is no readable tile"):
        world.publish(tmp_path, tiles=[*tiles, broken])


def test_what_contradicts_the_tiles_or_has_no_place_is_refused(
    world: World, tiles: list[Path], tmp_path: Path
) -> None:
    with pytest.raises(ContractError, match="expected 'none' as in the tiles"):
        world.publish(tmp_path, tiles=tiles, identity={"reference_field": "IGRF-13"})
    with pytest.raises(ContractError, match=r"\.\./x: has no place in a release"):
        world.publish(tmp_path, tiles=tiles, extra_files={"../x": tiles[0]})
    with pytest.raises(SourceError, match="is no product name"):
        world.publish(tmp_path, tiles=tiles, product="../demo")
    with pytest.raises(VersionError, match="is no version"):
        world.publish(tmp_path, "one", tiles=tiles)
    with pytest.raises(IntegrityError, match=r"inputs\[0\]\.licence is missing"):
        world.publish(
            tmp_path, tiles=tiles, inputs=[{"id": "x", "sha256": "0" * 64, "role": "grid"}]
        )


def test_checks_lie_in_several_tiles_on_seams_and_between_levels(
    world: World, tiles: list[Path], tmp_path: Path
) -> None:
    release = open_release(world.publish(tmp_path, tiles=tiles).path)
    at = make_checks(release)["positions"]
    y, x, inside = world.lattice.locate(np.array(at["latitude"]), np.array(at["longitude"]))
    assert inside.all()
    rows, columns = world.lattice.cells(y, x)
    places = set(
        zip(rows // world.lattice.tile_rows, columns // world.lattice.tile_columns, strict=True)
    )
    assert len(places) == 4
    near_seam = np.abs(y / world.lattice.tile_rows - np.round(y / world.lattice.tile_rows)) < 1e-8
    assert near_seam.sum() >= 12
    heights = np.array(at["height"])
    assert 0.2 < np.isin(heights, world.heights).mean() < 0.5


def test_checks_that_others_make_are_the_same(
    world: World, tiles: list[Path], tmp_path: Path
) -> None:
    """Each part is answered by itself, as a worker does; the order is that of the positions."""
    release = open_release(world.publish(tmp_path, tiles=tiles).path)
    asked: list[Path] = []

    def spread(answer: Callable[[Any], Any], questions: Sequence[Any]) -> Iterator[Any]:
        for question in questions:
            asked.append(question[0])
            yield answer(question)

    assert make_checks(release, spread) == make_checks(release)
    assert replay_checks(release, spread) == replay_checks(release)
    assert asked == 8 * [release.path.absolute()]


def test_a_tile_that_changes_meanwhile_is_not_published(
    world: World, tiles: list[Path], tmp_path: Path
) -> None:
    copies = [Path(shutil.copy(tile, tmp_path / tile.name)) for tile in tiles]
    measured = [measure_tile(tile) for tile in copies]
    data = copies[2].read_bytes()
    copies[2].write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(ContractError, match=f"{copies[2].name}: changed while it was being publ"):
        world.publish(tmp_path / "store", tiles=measured)
    assert [p.name for p in (tmp_path / "store" / "demo").iterdir()] == []


def test_replayed_checks_see_a_release_that_answers_otherwise(
    world: World, tiles: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    release = open_release(world.publish(tmp_path, tiles=tiles).path)
    assert replay_checks(release) < 0.01
    checks = json.loads(release.file("checks.json"))
    checks["expected"]["tensor"][7][3] += 1e-5
    monkeypatch.setattr(release, "file", lambda _: canonical_json(checks))
    with pytest.raises(IntegrityError, match=r"tensor\[7\] is"):
        replay_checks(release)


@pytest.mark.parametrize(
    "world_of_heights",
    [
        World(lattice=LATTICE, heights=(100.0, 400.0), height_reference="terrain"),
        World(LATTICE, (100.0,), "terrain", surface=lambda a, b: 300.0 + 0 * a * b),
    ],
    ids=["unknown terrain", "one level above known terrain"],
)
def test_terrain_releases_have_checks_too(world_of_heights: World, tmp_path: Path) -> None:
    release = open_release(world_of_heights.publish(tmp_path).path)
    expected = json.loads(release.file("checks.json"))["expected"]
    assert all(np.isfinite(np.array(v, float)).all() for v in expected.values())
