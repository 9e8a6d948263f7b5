"""The sample's observatories are what their truth says, in the formats of the real ones."""

from __future__ import annotations

import gzip
from dataclasses import replace
from pathlib import Path

import numpy as np
import ppigrf
import pytest

from magtiles.catalog.kernels.activity_classes import kp_class
from magtiles.pipeline.sample_observatories import write_observatories, write_truth
from magtiles.pipeline.synthetic_observatories import (
    DEMO_TEMPORAL,
    EQUATOR,
    MIDDLE,
    TemporalSample,
    quiet_curve,
    truth_dataset,
)


@pytest.fixture(scope="module")
def sample() -> TemporalSample:
    return TemporalSample()


@pytest.fixture(scope="module")
def folder(sample: TemporalSample, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("observatories")
    write_observatories(path, "demo", sample)
    return path


@pytest.mark.parametrize("number", [0, 1])
def test_a_record_is_level_curve_noise_and_storm(sample: TemporalSample, number: int) -> None:
    station = sample.station(number)
    spec = station.spec
    noise = station.record - station.level - sample.sq(spec, sample.time)
    noise -= sample.storm(sample.time)[:, None] * np.array(spec.storm)
    by_slot = noise.reshape(len(sample.slots), 180, 3)
    classes = kp_class(sample.kp)
    for stormy in (0, 1):
        values = by_slot[classes == stormy]
        known = np.isfinite(values)
        for axis in range(3):
            x = np.where(known[..., axis], values[..., axis], 0.0)
            variance = (x**2).sum() / known[..., axis].sum()
            pairs = known[:, 1:, axis] & known[:, :-1, axis]
            decay = (x[:, 1:] * x[:, :-1])[pairs].mean() / variance
            # Some 70 stormy intervals hold 200 to 500 independent values: 4 % to 6 % of sigma.
            assert np.sqrt(variance) == pytest.approx(spec.sigma_nt[stormy][axis], rel=0.2)
            assert -60.0 / np.log(decay) == pytest.approx(spec.tau_s[stormy][axis], rel=0.4)
    assert np.isnan(station.record).any(axis=1).sum() == sum(count for _, count in spec.gaps)
    storm = sample.storm(sample.time)
    assert storm.min() == pytest.approx(-DEMO_TEMPORAL.storm_nt, rel=0.02)
    assert np.abs(storm[~sample.in_storm(sample.time)]).max() == 0.0


def test_the_level_is_igrf_and_a_crust(sample: TemporalSample) -> None:
    import datetime

    when = sample.time[len(sample.time) // 2].astype("datetime64[s]").astype(datetime.datetime)
    east, north, up = ppigrf.igrf(EQUATOR.longitude, EQUATOR.latitude, 3.3, when)
    core = np.array([north, east, -up]).ravel()
    assert sample.station(1).level == pytest.approx(core + EQUATOR.crust_nt, abs=1e-6)
    inclination = np.degrees(np.arctan2(core[2], np.hypot(*core[:2])))
    assert abs(inclination) < 3.0  # on the dip equator


def test_noon_is_a_dip_at_middle_latitude_and_a_crest_at_the_equator() -> None:
    minute = np.arange(1440.0)
    assert np.argmin(quiet_curve(MIDDLE, minute)[:, 0]) == 11 * 60
    assert np.argmax(quiet_curve(EQUATOR, minute)[:, 0]) == pytest.approx(11.2 * 60, abs=1)
    for spec in (MIDDLE, EQUATOR):
        near_midnight = quiet_curve(spec, np.r_[0:60, 1380:1440])
        assert np.abs(near_midnight).max() < 0.02


def test_kp_is_quiet_and_stormy_as_in_a_real_year(sample: TemporalSample) -> None:
    assert np.abs(np.round(3 * sample.kp) - 3 * sample.kp).max() < 1e-12
    assert 0.1 < np.mean(sample.kp >= 3.0) < 0.2  # the paper's year: 13 %
    slots = sample.in_storm(sample.slots)
    assert (sample.kp[slots] >= 3.0).all()
    for month in sample.months:
        quiet, disturbed = sample.ranked_days(month)
        assert len(set(quiet)) == 10
        assert len(set(disturbed)) == 5
        assert not set(quiet[:5]) & set(disturbed)


def test_files_are_iaga_2002_with_the_record_in_them(sample: TemporalSample, folder: Path) -> None:
    text = gzip.decompress((folder / "xmd202403dmin.min.gz").read_bytes()).decode("ascii")
    lines = text.splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("DATE"))
    assert all(len(line) == 70 and line.endswith("|") for line in lines[: first + 1])
    rows = lines[first + 1 :]
    assert len(rows) == 31 * 1440
    assert {len(row) for row in rows} == {70}
    assert rows[0][:30] == "2024-03-01 00:00:00.000 061   "
    values = np.array([row[30:].split() for row in rows], float)
    record = sample.station(0).record[sample.time >= np.datetime64("2024-03-01")]
    known = np.isfinite(record[:, 0])
    assert np.abs(values[known, :3] - record[known]).max() <= 0.005 + 1e-9
    assert (values[~known] == 99999.0).all()
    assert values[known, 3] == pytest.approx(np.linalg.norm(record[known], axis=1), abs=0.0051)


def test_declination_is_in_minutes_of_arc(sample: TemporalSample, folder: Path) -> None:
    text = gzip.decompress((folder / "xeq202402dmin.min.gz").read_bytes()).decode("ascii")
    h, d, z, _ = (float(word) for word in text.splitlines()[-1].split()[3:])
    north, east, down = sample.station(1).record[29 * 1440 - 1]
    assert h * np.cos(np.radians(d / 60)) == pytest.approx(north, abs=0.05)
    assert h * np.sin(np.radians(d / 60)) == pytest.approx(east, abs=0.05)  # 0.01' is 0.07 nT
    assert z == pytest.approx(down, abs=0.005)


def test_the_same_spec_gives_the_same_bytes(sample: TemporalSample, tmp_path: Path) -> None:
    one_day = TemporalSample(replace(DEMO_TEMPORAL, stations=(MIDDLE,), months=("2024-02",)))
    again = TemporalSample(one_day.spec)
    paths = write_observatories(tmp_path / "a", "x", one_day)
    for path in paths:
        path.rename(path.with_suffix(path.suffix + ".first"))
    assert write_observatories(tmp_path / "a", "x", again) == paths
    for path in paths:
        assert path.read_bytes() == path.with_suffix(path.suffix + ".first").read_bytes()
    other = TemporalSample(replace(one_day.spec, seed=4))
    write_observatories(tmp_path / "a", "x", other)
    assert paths[2].read_bytes() != paths[2].with_suffix(".gz.first").read_bytes()


def test_truth_is_beside_the_records(sample: TemporalSample, tmp_path: Path) -> None:
    import xarray as xr

    write_truth(tmp_path / "truth.nc", sample)
    with xr.open_dataset(tmp_path / "truth.nc", engine="netcdf4") as truth:
        assert truth.equals(truth_dataset(sample))
        month = truth["baseline"].sel(month="2024-03-01").values
        assert (
            pytest.approx(
                quiet_curve(MIDDLE, np.arange(1440.0)) * (1.0 + 0.08 * 30.0 / 30.0), abs=1e-9
            )
            == month[0].T
        )
        assert truth["sigma"].values[1, :, 1].tolist() == list(EQUATOR.sigma_nt[1])
