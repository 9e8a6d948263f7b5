"""The sample is what it says: exact, deterministic, in the formats that ingest reads."""

from __future__ import annotations

import datetime
from dataclasses import replace
from pathlib import Path

import numpy as np
import ppigrf
import pyproj
import pytest
import scipy.ndimage
import xarray as xr

from magtiles.catalog.kernels.geodesy import metres_per_degree
from magtiles.pipeline.sample import (
    DEMO,
    ConstantField,
    Sample,
    SampleSpec,
    synthesize,
    write_sample,
    write_survey,
)
from magtiles.schemas import contracts
from magtiles.stages.ingest.grid import ingest_grid
from magtiles.stages.ingest.source import IngestGridParams

_EPOCH = datetime.datetime.fromisoformat(DEMO.epoch)
_SMALL = replace(DEMO, name="small", width_m=40e3, length_m=30e3, dipoles=60, levels_m=(2500.0,))


@pytest.fixture(scope="module")
def demo() -> Sample:
    return synthesize(DEMO)


def test_demo_is_a_survey_as_asked(demo):
    assert demo.exact.shape == (180, 240)
    assert float(np.std(demo.exact)) == pytest.approx(70.0, abs=0.1)
    north, east, _ = demo.ambient(demo.latitude, demo.longitude, 1500.0).T
    declination = np.degrees(np.arctan2(east, north))
    assert declination.min() > 17.0
    assert declination.max() < 21.0


def test_every_depth_shows(demo):
    """Dipoles of the shallow, middle and deep third each carry a good part of the anomaly."""
    rows = np.s_[::4, ::4]
    place = demo.latitude[rows], demo.longitude[rows], 1500.0
    geodetic = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    depth = 1500.0 - geodetic.transform(*demo.positions.T)[2]
    assert 1500.0 <= depth.min() < 1600.0
    assert 11500.0 < depth.max() <= 12000.0
    depth_order = np.argsort(depth)
    share = []
    for third in np.array_split(depth_order, 3):
        part = replace(demo, positions=demo.positions[third], moments=demo.moments[third])
        share.append(np.std(part.truth(*place)[0]))
    assert min(share) > 0.2 * DEMO.rms_nt


def test_noise_and_missing_parts(demo):
    error = (demo.anomaly - demo.exact)[np.isfinite(demo.anomaly)]
    # The standard deviation of 40,000 normal errors is within 1.5 % (4 sigma) of theirs.
    assert np.std(error) == pytest.approx(DEMO.noise_nt, rel=0.015)
    parts, count = scipy.ndimage.label(np.isnan(demo.anomaly))
    assert count == 2
    border = {*parts[0], *parts[-1], *parts[:, 0], *parts[:, -1]} - {0}
    assert len(border) == 1  # the sea reaches the border, the void does not
    void = parts == ({1, 2} - border).pop()
    assert void.sum() == pytest.approx(np.pi * 6 * 4, abs=4)  # cells of 1 km2


def test_total_is_the_difference_of_magnitudes(demo):
    rng = np.random.default_rng(0)
    latitude, longitude = rng.uniform(45.5, 46.5, 20), rng.uniform(-122.5, -120.5, 20)
    height = rng.uniform(1500.0, 9500.0, 20)
    total, vector, _ = demo.truth(latitude, longitude, height)
    east, north, up = ppigrf.igrf(longitude, latitude, height / 1e3, _EPOCH)
    ambient = np.stack([north[0], east[0], -up[0]], axis=-1)
    magnitudes = np.linalg.norm(ambient + vector, axis=1) - np.linalg.norm(ambient, axis=1)
    # 3e-11 nT measured, the rounding of the difference itself.
    np.testing.assert_allclose(total, magnitudes, rtol=0, atol=1e-9)


def test_interpolated_core_field_is_igrf(demo):
    rows = np.s_[::29, ::31]
    place = demo.latitude[rows], demo.longitude[rows]
    found = demo.ambient(*place, np.full_like(place[0], 5500.0) + np.arange(7)[:, None])
    east, north, up = ppigrf.igrf(place[1], place[0], 5.5 + 1e-3 * np.arange(7)[:, None], _EPOCH)
    # 1e-10 nT measured.
    np.testing.assert_allclose(found, np.stack([north[0], east[0], -up[0]], -1), atol=1e-8)


def test_tensor_is_the_gradient_of_the_vector(demo):
    """Along north, east and down |B|^2 changes by 2 B.(T e), whatever the frames do."""
    rng = np.random.default_rng(1)
    place = rng.uniform((45.5, -122.5, 1500.0), (46.5, -120.5, 9500.0), (30, 3)).T
    _, vector, five = demo.truth(*place)
    nn, ne, nd, ee, ed = five.T
    tensor = np.array([[nn, ne, nd], [ne, ee, ed], [nd, ed, -(nn + ee)]]).transpose(2, 0, 1)
    expected = 2.0 * np.einsum("pi,pij->pj", vector, tensor)
    per_degree = metres_per_degree(place[0], place[2])
    for axis, step in enumerate((1.0 / per_degree[0], 1.0 / per_degree[1], -np.ones(30))):
        shift = np.zeros((3, 30))
        shift[axis] = 10.0 * step
        ahead, behind = (demo.truth(*(place + s))[1] for s in (shift, -shift))
        slope = ((ahead**2).sum(axis=1) - (behind**2).sum(axis=1)) / 20.0 * 1e3
        # The difference over 20 m errs by some 2e-5 of the largest.
        np.testing.assert_allclose(
            slope, expected[:, axis], rtol=0, atol=1e-4 * np.abs(expected).max()
        )


def test_written_survey_comes_back_through_ingest(demo, tmp_path):
    survey, source, product = write_survey(tmp_path, demo)
    assert [p.name for p in (survey, source, product)] == [
        "demo-survey.tif",
        "demo-survey.toml",
        "demo.toml",
    ]
    grid = ingest_grid([source], params=IngestGridParams())
    contracts.check(grid, "anomaly-grid/1")
    np.testing.assert_array_equal(grid.x, demo.x)
    np.testing.assert_array_equal(grid.y, demo.y)
    np.testing.assert_array_equal(grid.magnetic_anomaly, demo.anomaly.astype(np.float32))
    assert grid.attrs["source_distance_m"] == 1500.0
    assert float(grid.magnetic_anomaly_uncertainty) == 1.0


def test_same_bytes_every_time(tmp_path: Path):
    first = [path.read_bytes() for path in write_sample(tmp_path, _SMALL)]
    again = [path.read_bytes() for path in write_sample(tmp_path, _SMALL)]
    assert first == again
    assert len(list(tmp_path.iterdir())) == len(first)
    other = [path.read_bytes() for path in write_sample(tmp_path, replace(_SMALL, seed=1))]
    assert other[0] != first[0]


def test_truth_file_holds_every_level(tmp_path: Path):
    path = write_sample(tmp_path, _SMALL)[3]
    sample = synthesize(_SMALL)
    with xr.open_dataset(path, engine="netcdf4") as truth:
        np.testing.assert_array_equal(truth.height, [1500.0, 2500.0])
        np.testing.assert_array_equal(truth.magnetic_anomaly[0], sample.exact.astype(np.float32))
        _, vector, tensor = sample.truth(sample.latitude, sample.longitude, 2500.0)
        np.testing.assert_array_equal(truth.anomaly_east[1], vector[..., 1].astype(np.float32))
        np.testing.assert_array_equal(truth.gradient_ed[1], tensor[..., 4].astype(np.float32))
        assert truth.latitude.dtype == np.float64


@pytest.mark.parametrize(
    ("spec", "inclination"),
    [
        (replace(_SMALL, latitude=-33.0, longitude=147.0, crs="EPSG:32755"), (-67, -62)),
        (replace(_SMALL, longitude=-111.0), (69, 72)),  # two zones east of UTM zone 10
        (replace(_SMALL, ambient=ConstantField(56000.0, -60.0, 17.0)), (-60.001, -59.999)),
        (replace(_SMALL, noise_nt=0.0, void=False, coast=False), (67, 70)),
    ],
    ids=["south", "far-zone", "constant", "noise-free"],
)
def test_other_places(spec: SampleSpec, inclination: tuple[float, float]):
    sample = synthesize(spec)
    assert abs(sample.latitude.mean() - spec.latitude) < 0.02
    assert abs(sample.longitude.mean() - spec.longitude) < 0.02
    north, east, down = sample.ambient(spec.latitude, spec.longitude, 1500.0)
    dip = np.degrees(np.arctan2(down, np.hypot(north, east)))
    assert inclination[0] < dip < inclination[1]
    total, _, _ = sample.truth(sample.latitude, sample.longitude, spec.height_m)
    np.testing.assert_allclose(total, sample.exact, rtol=0, atol=1e-9)
    if spec.noise_nt == 0.0:
        np.testing.assert_array_equal(sample.anomaly, sample.exact)
