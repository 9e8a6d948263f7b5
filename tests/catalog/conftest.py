"""Releases that many tests of the reader share."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from synthetic_release import World, small_lattice

from magtiles.catalog import Release, open_release


@pytest.fixture(scope="session")
def world() -> World:
    """Dipoles 2.5 to 12 km down; a block of nodes in the north-east is beyond coverage."""
    return World(beyond=(np.s_[52:60], np.s_[50:58]))


@pytest.fixture(scope="session")
def folder(world: World, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return world.publish(tmp_path_factory.mktemp("store")).path


@pytest.fixture
def release(folder: Path) -> Release:
    return open_release(folder)


@pytest.fixture
def copy(folder: Path, tmp_path: Path) -> Path:
    """A copy of the release that may be written to."""
    target = tmp_path / "1.0.0"
    shutil.copytree(folder, target, copy_function=shutil.copyfile)
    for path in (target, *target.rglob("*")):
        path.chmod(0o755)
    return target


def hills(lat: np.ndarray, lon: np.ndarray) -> np.ndarray:
    """A surface that rises and falls by some 200 m over 10 km."""
    return 900.0 + 200.0 * np.sin(30.0 * lat) * np.cos(40.0 * lon)


@pytest.fixture(scope="session")
def terrain_world() -> World:
    return World(heights=(100.0, 400.0, 1000.0), height_reference="terrain", surface=hills)


@pytest.fixture(scope="session")
def terrain_folder(terrain_world: World, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return terrain_world.publish(tmp_path_factory.mktemp("terrain")).path


@pytest.fixture(scope="session")
def blind_terrain_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A terrain release that does not know its terrain."""
    blind = World(heights=(100.0, 400.0), height_reference="terrain")
    return blind.publish(tmp_path_factory.mktemp("blind")).path


@pytest.fixture(scope="session")
def date_line_world() -> World:
    return World(lattice=small_lattice(south=-18.0, west=179.7), heights=(0.0, 1000.0))


@pytest.fixture(scope="session")
def date_line_folder(date_line_world: World, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return date_line_world.publish(tmp_path_factory.mktemp("fiji")).path
