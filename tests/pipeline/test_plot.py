"""Pictures: what they show is what the arrays hold, in true shape, the same bytes every time."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure
from numpy.typing import NDArray

from magtiles.catalog import open_release
from magtiles.catalog.flags import QualityFlag
from magtiles.catalog.kernels.bspline import HALO
from magtiles.pipeline.main import main
from magtiles.pipeline.plotting import QUANTITIES, hillshade, preview_figure, save_png
from magtiles.pipeline.preview import assemble_level, release_figure, write_preview

LATITUDE = 60.0 + 0.01 * np.arange(50)
LONGITUDE = 179.5 + 0.02 * np.arange(60)


def figure(flags: NDArray[np.uint8] | None = None, **changes: Any) -> Figure:
    x, y = np.meshgrid(LONGITUDE - 180.0, LATITUDE - 60.25)
    values = 100.0 * np.exp(-(x**2 + y**2) / 0.02) - 30.0 * np.exp(-((x - 0.3) ** 2 + y**2) / 0.02)
    given: dict[str, Any] = {
        "latitude": LATITUDE,
        "longitude": LONGITUDE,
        "values": values,
        "uncertainty": 2.0 + np.abs(y),
        "flags": np.zeros(values.shape, np.uint8) if flags is None else flags,
        "quantity": "total",
        "title": "a title",
        "note": "a note",
    }
    return preview_figure(**(given | changes))


def partly_flagged() -> NDArray[np.uint8]:
    flags = np.zeros((50, 60), np.uint8)
    flags[:10] = QualityFlag.BEYOND_COVERAGE | QualityFlag.VOID_FILLED
    flags[20:25, 20:30] = QualityFlag.VOID_FILLED
    return flags


def test_panels_have_the_true_shape() -> None:
    """At 60 N a degree of longitude is half as long as one of latitude."""
    drawn = figure()
    drawn.canvas.draw()
    width, height = 60 * 0.02 * np.cos(np.radians(LATITUDE.mean())), 50 * 0.01
    for panel in (drawn.axes[0], drawn.axes[2], drawn.axes[4]):
        box = panel.get_window_extent()
        assert box.height / box.width == pytest.approx(height / width, rel=0.03)


def test_labels_units_ticks_and_legend_say_what_is_drawn() -> None:
    drawn = figure(partly_flagged())
    drawn.canvas.draw()
    main_map, bar, _, side_bar, flag_map = drawn.axes
    assert bar.get_xlabel() == "total-field anomaly (nT)"
    assert side_bar.get_ylabel() == "nT"
    assert [t.get_text() for t in drawn.texts] == ["a title", "a note"]
    ticks = {label.get_text() for label in main_map.get_xticklabels()}
    assert "180\N{DEGREE SIGN}W" in ticks  # east of the date line longitudes are west
    legend = [text.get_text() for text in flag_map.get_legend().get_texts()]
    assert legend == ["none, 78.3%", "beyond coverage, 20.0%", "void filled, 1.7%"]


def test_colours_are_symmetric_about_zero_and_nothing_lies_beyond_coverage() -> None:
    drawn = figure(partly_flagged())
    main_map, bar, *_ = drawn.axes
    low, high = bar.get_xlim()
    assert low == -high
    assert 50.0 < high <= 100.0
    picture = np.asarray(main_map.images[0].get_array())
    assert np.all(picture[:10, :, 3] == 0.0)
    assert np.all(picture[10:, :, 3] == 1.0)
    # The maximum is red, the minimum blue.
    assert picture[25, 25, 0] > picture[25, 25, 2]
    assert picture[25, 40, 2] > picture[25, 40, 0]


def test_light_comes_from_the_north_west() -> None:
    x, y = np.meshgrid(LONGITUDE - LONGITUDE.mean(), LATITUDE - LATITUDE.mean())
    hill = np.exp(-((0.5 * x) ** 2 + y**2) / 0.01)
    shade = hillshade(LATITUDE, LONGITUDE, hill)
    # Row 35 is north of the top, column 20 west of it.
    assert shade[35, 20] > 0.7
    assert shade[15, 40] < 0.3
    assert hillshade(LATITUDE, LONGITUDE, np.ones((50, 60))) == pytest.approx(0.5)


@pytest.mark.parametrize(
    "changes",
    [
        pytest.param({"values": np.zeros((50, 60))}, id="all zero"),
        pytest.param({"flags": np.full((50, 60), 2, np.uint8)}, id="no coverage"),
        pytest.param({"uncertainty": np.full((50, 60), 5.0)}, id="even uncertainty"),
        pytest.param({"uncertainty": np.geomspace(1, 900, 3000).reshape(50, 60)}, id="wide"),
        pytest.param({"flags": np.full((50, 60), 31, np.uint8)}, id="all flags"),
        pytest.param({"quantity": "nd"}, id="tensor"),
    ],
)
def test_odd_maps_are_drawn(changes: dict[str, Any], tmp_path: Path) -> None:
    save_png(figure(**changes), tmp_path / "odd.png")
    picture = matplotlib.image.imread(tmp_path / "odd.png")
    assert picture.shape[1] == 1400
    assert picture[..., :3].std() > 0.05


def test_same_arrays_give_the_same_bytes(tmp_path: Path) -> None:
    digests = set()
    for name in ("a.png", "b.png"):
        save_png(figure(partly_flagged()), tmp_path / name)
        digests.add(hashlib.sha256((tmp_path / name).read_bytes()).hexdigest())
    assert len(digests) == 1
    assert b"matplotlib" not in (tmp_path / "a.png").read_bytes().lower()


def test_level_is_assembled_from_tiles_without_a_seam(exact_release: Path) -> None:
    release = open_release(exact_release)
    names = [kind.variable for kind in QUANTITIES.values()]
    arrays = assemble_level(release.tiles(), release.manifest.lattice, 1, names)
    lattice = release.manifest.lattice
    latitude = lattice.latitudes(np.arange(lattice.rows + 1))[:, None]
    longitude = lattice.longitudes(np.arange(lattice.columns + 1))[None, :]
    covered = (release.anomaly.flags(latitude, longitude, 1500.0) & 2) == 0
    total = release.anomaly.total(latitude, longitude, 1500.0)
    assert arrays[0].shape == (37, 29)
    # A spline passes through its nodes: 3e-11 nT measured, of 193 nT.
    assert np.abs(arrays[0] - total)[covered].max() < 1e-9


def test_preview_of_a_level_is_the_picture_of_the_release(
    exact_release: Path, tmp_path: Path
) -> None:
    """The same bytes, whether drawn from the level before cutting or from the tiles after."""
    release = open_release(exact_release)
    lattice, tile = release.manifest.lattice, next(iter(release.tiles()))
    names = ("magnetic_anomaly", "magnetic_anomaly_uncertainty", "quality_flag")
    whole = assemble_level(release.tiles(), lattice, 0, names)
    dims = ("latitude", "longitude")
    level = xr.Dataset(
        {n: (dims, np.pad(array, HALO)) for n, array in zip(names, whole, strict=True)},
        coords={
            "latitude": lattice.latitudes(np.arange(-HALO, lattice.rows + HALO + 1)),
            "longitude": lattice.longitudes(np.arange(-HALO, lattice.columns + HALO + 1)),
            "height": 500.0,
        },
        attrs=tile.attributes,
    )
    write_preview(level, tmp_path / "preview.png", "exact", "1.2.3")
    save_png(release_figure(exact_release, height=500.0, quantity="total"), tmp_path / "plot.png")
    assert (tmp_path / "preview.png").read_bytes() == (tmp_path / "plot.png").read_bytes()


def test_command_draws_any_level_and_quantity(
    exact_release: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new" / "map.png"
    argv = ["plot", str(exact_release), "--out", str(out)]
    assert main([*argv, "--level", "1500", "--quantity", "ne"]) == 0
    assert out.read_bytes().startswith(b"\x89PNG")
    drawn = release_figure(exact_release, height=1500.0, quantity="ne")
    title, note = (text.get_text() for text in drawn.texts)
    assert title == "exact 1.2.3: gradient ne 1500 m above the WGS84 ellipsoid"
    assert "IGRF-13 at 2015-07-01" in note
    assert main([*argv, "--level", "900"]) == 2
    assert "no level at 900 m; expected one of 500, 1500" in capsys.readouterr().err
    assert main([*argv, "--quantity", "dd"]) == 2
