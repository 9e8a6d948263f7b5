"""Tolles-Lawson compensation against its own linear model, closed identities and other solvers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import xarray as xr
from cloverleaf import (
    COEFFICIENTS,
    EARTH_NT,
    SCALE,
    STEP_S,
    STRAIGHT,
    TERMS,
    angles,
    body_field,
    flight,
)

from magtiles.catalog.flags import TrackFlag, flag_attributes
from magtiles.schemas import contracts
from magtiles.schemas.errors import ContractError, CoverageError, MagtilesError, ParameterError
from magtiles.stages.vehicle.tolles_lawson.apply import ApplyTollesLawsonParams, apply_tolles_lawson
from magtiles.stages.vehicle.tolles_lawson.filter import Filter
from magtiles.stages.vehicle.tolles_lawson.fit import FitTollesLawsonParams, fit_tolles_lawson
from magtiles.stages.vehicle.tolles_lawson.manoeuvres import find_manoeuvres, heading_groups
from magtiles.stages.vehicle.tolles_lawson.merit import measure
from magtiles.stages.vehicle.tolles_lawson.runs import Run, find_runs
from magtiles.stages.vehicle.tolles_lawson.solve import Regularisation, solve
from magtiles.stages.vehicle.tolles_lawson.terms import (
    derivative,
    null_directions,
    term_columns,
    term_names,
    term_units,
)


def fit(track: xr.Dataset, **params: Any) -> xr.Dataset:
    return fit_tolles_lawson(track, params=FitTollesLawsonParams(**params))


def compensate(track: xr.Dataset, calibration: xr.Dataset, **params: Any) -> xr.Dataset:
    return apply_tolles_lawson(track, calibration, params=ApplyTollesLawsonParams(**params))


@pytest.fixture(scope="module")
def cloverleaf() -> xr.Dataset:
    return flight(angles())


# Terms


def test_columns_are_those_of_the_paper():
    body = body_field(angles())
    columns = dict(zip(TERMS, term_columns(body, STEP_S, TERMS, span_s=0.0).T, strict=True))
    length = np.linalg.norm(body, axis=1)
    u = body / length[:, None]
    x, y, z = u.T
    rate = (u[:-4] - 8.0 * u[1:-3] + 8.0 * u[3:-1] - u[4:]) / (12.0 * STEP_S)
    rate -= u[2:-2] * np.sum(u[2:-2] * rate, axis=1, keepdims=True)
    expected = {
        "permanent_y": y,
        "induced_xz": length * x * z,
        "induced_yy": length * y * y,
    }
    for name, values in expected.items():
        np.testing.assert_allclose(columns[name], values, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(columns["eddy_zy"][2:-2], (length * z)[2:-2] * rate[:, 1], atol=1e-6)
    assert term_units(("permanent_x", "induced_xx", "eddy_xx")) == ["nT", "1", "s"]
    assert [len(term_names(i, e)) for i, e in ((5, 8), (6, 9))] == [16, 18]


def test_derivative_has_the_error_of_fourth_order_differences():
    t = np.arange(200) * STEP_S
    for span in (0.0, 0.8):
        found = derivative(t**4, STEP_S, span)
        np.testing.assert_allclose(found, 4.0 * t**3, rtol=1e-9, atol=1e-7)
    for hz in (0.25, 0.5):
        exact = 2.0 * np.pi * hz * np.cos(2.0 * np.pi * hz * t)
        for span, relative in (
            (0.0, (2.0 * np.pi * hz * STEP_S) ** 4 / 30.0),
            (0.8, 0.098 * hz**4),
        ):
            found = derivative(np.sin(2.0 * np.pi * hz * t), STEP_S, span)
            error = np.abs(found - exact)[4:-4].max() / exact.max()
            assert error == pytest.approx(relative, rel=0.1)


def test_a_wider_span_passes_less_noise():
    """At the same span the noise falls with the sampling rate, as it should."""
    rng = np.random.default_rng(0)
    passed = {
        (step, span): np.std(derivative(rng.normal(size=20_000), step, span))
        for step in (0.1, 0.05, 0.5)
        for span in (0.0, 0.8)
    }
    assert passed[0.1, 0.8] == pytest.approx(3.38, rel=0.03)
    assert passed[0.1, 0.0] == pytest.approx(9.50, rel=0.03)
    assert passed[0.05, 0.8] < 0.85 * passed[0.1, 0.8] < 0.2 * passed[0.05, 0.0]
    assert passed[0.5, 0.8] == pytest.approx(passed[0.5, 0.0], rel=0.05)  # five samples either way
    assert np.isfinite(derivative(np.arange(6.0), 0.1)).all()  # a run shorter than the span


@pytest.mark.parametrize("of", ["direction_cosines", "field_components"])
def test_null_directions_change_the_field_by_nothing_an_attitude_can(of):
    body = body_field(angles())
    columns = term_columns(body, STEP_S, TERMS, of)
    induced, eddy = (columns @ null_directions(TERMS).T).T
    np.testing.assert_allclose(induced, np.linalg.norm(EARTH_NT), rtol=1e-12)
    assert np.abs(eddy).max() < 1e-13 * np.linalg.norm(EARTH_NT) / STEP_S
    assert null_directions(term_names(5, 8)).shape == (0, 16)


# The fit on the linear model


def distance_modulo_null(found: xr.Dataset) -> float:
    """Largest error of a coefficient, relative to the largest, null directions taken out."""
    full = dict.fromkeys(TERMS, 0.0) | dict(
        zip(found["term"].values.tolist(), found["coefficient"].values.tolist(), strict=True)
    )
    error = (np.array(list(full.values())) - COEFFICIENTS) * SCALE
    for row in null_directions(TERMS) * SCALE:
        error -= row * (row @ error) / (row @ row)
    return float(np.abs(error).max() / np.abs(COEFFICIENTS * SCALE).max())


@pytest.mark.parametrize("form", ["map_less", "map_based"])
@pytest.mark.parametrize("of", ["direction_cosines", "field_components"])
@pytest.mark.parametrize(("induced", "eddy"), [(5, 8), (6, 9), (5, 9), (6, 8)])
def test_linear_truth_is_found_modulo_null_directions(induced, eddy, of, form):
    """Measured: coefficients within 8e-11 of the largest, compensation within 3e-10 nT."""
    track = flight(angles(), of)
    found = fit(track, induced_terms=induced, eddy_terms=eddy, derivative_of=of, form=form)
    contracts.check(found, "sensor-calibration/1")
    assert distance_modulo_null(found) < 1e-8
    assert found.sizes.get("null", 0) == (induced == 6) + (eddy == 9)
    compensated = compensate(track, found)
    contracts.check(compensated, "track/1")
    assert np.ptp(track["field_total"].values) > 70.0
    assert np.ptp(compensated["field_total"].values) < 1e-8
    assert found.attrs["figure_of_merit_manoeuvres"] == 12
    assert found.attrs["figure_of_merit_after_nt"] < 1e-8


def test_solution_is_that_of_other_least_squares(cloverleaf):
    """Without and with damping, against LAPACK's gelsd on the augmented system."""
    rng = np.random.default_rng(3)
    columns, response = rng.normal(size=(400, 6)) * np.arange(1, 7), rng.normal(size=400)
    scale, none = np.linspace(1.0, 3.0, 6), np.zeros((0, 6))
    plain = solve(columns, response, scale, none, Regularisation(1e-9, 0.0), 1.0)
    expected = np.linalg.lstsq(columns, response)[0]
    np.testing.assert_allclose(plain.coefficient, expected, rtol=1e-12)
    ridge = 0.4
    damped = solve(columns, response, scale, none, Regularisation(1e-9, ridge), 1.0)
    augmented = np.vstack([columns, ridge * np.sqrt(400) * np.diag(scale)])
    expected = np.linalg.lstsq(augmented, np.concatenate([response, np.zeros(6)]))[0]
    np.testing.assert_allclose(damped.coefficient, expected, rtol=1e-12)
    bound = np.eye(6)[:1] * 1.0  # the first coefficient stated as undetermined
    without = solve(columns, response, scale, bound, Regularisation(1e-9, 0.0), 1.0)
    assert without.coefficient[0] == pytest.approx(0.0, abs=1e-15)
    expected = np.linalg.lstsq(columns[:, 1:], response)[0]
    np.testing.assert_allclose(without.coefficient[1:], expected, rtol=1e-12)


@pytest.mark.parametrize("form", ["map_less", "map_based"])
def test_covariance_is_the_scatter_of_fits_to_white_noise(form):
    """60 fits of 16 coefficients: variances 1.03 and 1.07 times those stated, on average."""
    clean = flight(angles())
    rng = np.random.default_rng(7)
    found, stated = [], []
    for _ in range(60):
        noise = rng.normal(0.0, 0.5, clean.sizes["time"])
        noisy = clean.assign(field_total=clean["field_total"] + noise)
        calibration = fit(noisy, form=form)
        found.append(calibration["coefficient"].values)
        stated.append(np.diag(calibration["covariance"].values))
    ratio = np.var(found, axis=0, ddof=1) / np.mean(stated, axis=0)
    assert ratio.mean() == pytest.approx(1.0, abs=0.15), ratio
    assert ratio.max() < 1.8


def test_residual_is_the_noise_of_the_band():
    calibration = fit(flight(angles(), noise_nt=0.5))
    gain = Filter(0.1, 0.9).noise_gain(STEP_S)
    assert float(calibration["residual_rms"]) == pytest.approx(0.5 * np.sqrt(gain), rel=0.05)
    # An ideal band of 0.8 Hz out of 5 Hz would pass 16 %.
    assert gain == pytest.approx(0.16, rel=0.1)


# Filters and runs


def test_filter_has_no_delay_and_settles_where_it_says():
    band = Filter(0.1, 0.9)
    impulse = np.zeros(2001)
    impulse[1000] = 1.0
    response = band.apply(impulse, STEP_S)
    np.testing.assert_allclose(response, response[::-1], atol=1e-6 * response.max())
    far = np.abs(response[: 1000 - band.edge(STEP_S)]).max()
    assert far < 0.02 * response.max()
    assert np.sum(response**2) == pytest.approx(band.noise_gain(STEP_S), rel=1e-3)
    assert Filter(None, None).apply(impulse, STEP_S) is impulse
    assert (Filter(None, None).edge(STEP_S), Filter(None, None).noise_gain(STEP_S)) == (0, 1.0)


def test_runs_end_at_gaps_flags_and_missing_values(cloverleaf):
    track = cloverleaf.isel(time=slice(0, 100))
    flags = np.zeros(100, np.uint16)
    flags[70] = TrackFlag.FIELD_SPIKE
    flags[80] = TrackFlag.STATIONARY
    flagged = track.assign(quality_flag=("time", flags)).isel(time=np.r_[0:40, 43:100])
    usable = np.ones(97, bool)
    usable[10] = False
    found = find_runs(flagged, usable, 5)
    assert found == [Run(0, 10, 0.1), Run(11, 40, 0.1), Run(40, 67, 0.1), Run(68, 97, 0.1)]
    assert [len(run) for run in find_runs(flagged, usable, 28)] == [29, 29]
    assert find_runs(flagged, np.zeros(97, bool), 5) == []


# Manoeuvres and merits


@pytest.mark.parametrize("attitude", [True, False])
def test_manoeuvres_are_found_by_kind_and_heading(cloverleaf, attitude):
    track = cloverleaf if attitude else cloverleaf.drop_vars("attitude")
    runs = [Run(0, track.sizes["time"], STEP_S)]
    found = find_manoeuvres(track, runs, 1.0)
    starts = [STRAIGHT + leg * 1800 + axis * 350 + 100 for leg in range(4) for axis in range(3)]
    if attitude:
        assert [one.kind for one in found] == ["roll", "pitch", "yaw"] * 4
        turned = np.repeat([20.0, 110.0, 200.0, 290.0], 3)
    else:  # the sensor's axes point where the field says: magnetic headings, which
        # 2 degrees of pitch turn by up to 2 tan(68), 5 degrees
        assert {one.kind for one in found} == {"unknown"}
        turned = np.repeat([20.0, 110.0, 200.0, 290.0], 3) - np.degrees(np.arctan2(0.08, 0.36))
    assert heading_groups(found) == np.repeat(range(4), 3).tolist()
    for one, start, heading in zip(found, starts, turned, strict=True):
        assert abs((one.heading_deg - heading + 180.0) % 360.0 - 180.0) < (1.0 if attitude else 6.0)
        assert start - 30 < one.start < start + 80
        assert start + 170 < one.stop < start + 280


def test_gusts_and_turns_are_no_manoeuvres():
    t = np.arange(6000) * STEP_S
    quiet = np.stack([np.sin(0.9 * t), 0.7 * np.sin(1.3 * t), 0.0 * t], axis=1)
    turn = quiet + np.stack([25.0 * (np.abs(t - 300) < 60), 0.0 * t, 3.0 * t], axis=1)
    for degrees in (quiet, turn):
        track = flight(degrees)
        assert find_manoeuvres(track, [Run(0, 6000, STEP_S)], 1.5) == []


def test_figure_of_merit_is_the_sum_of_twelve_peaks_to_peaks(cloverleaf):
    found = find_manoeuvres(cloverleaf, [Run(0, cloverleaf.sizes["time"], STEP_S)], 1.0)
    signal = np.zeros(cloverleaf.sizes["time"])
    for number, one in enumerate(found):
        signal[one.start : one.stop] = np.linspace(0.0, number + 1.0, one.stop - one.start)
    merit = measure(signal, found)
    assert (merit.manoeuvres, merit.figure_nt) == (12, pytest.approx(sum(range(1, 13))))
    twice = measure(signal, [*found, found[0]])  # a repetition counts by the average
    assert twice.figure_nt == pytest.approx(merit.figure_nt)


# Applying


def test_a_gap_is_missing_and_flagged_and_the_rest_compensated(cloverleaf):
    calibration = fit(cloverleaf)
    broken = cloverleaf.copy(deep=True)
    broken["field_body"][1000, 1] = np.nan
    broken["field_body"][1003] = 0.0
    broken["quality_flag"] = (
        "time",
        np.full(broken.sizes["time"], TrackFlag.STATIONARY, np.uint16),
        flag_attributes(TrackFlag, np.uint16),
    )
    compensated = compensate(broken, calibration)
    contracts.check(compensated, "track/1")
    missing = np.isnan(compensated["field_total"].values)
    np.testing.assert_array_equal(np.flatnonzero(missing), range(1000, 1004))
    flags = compensated["quality_flag"].values
    np.testing.assert_array_equal((flags & TrackFlag.FIELD_GAP) != 0, missing)
    assert ((flags & TrackFlag.STATIONARY) != 0).all()
    # Differences at the edges of the gap are one-sided: 2e-4 nT rms, 0.02 at most.
    assert np.nanstd(compensated["field_total"]) < 5e-4
    swinging = (flags & TrackFlag.MANOEUVRE) != 0
    assert 0.3 < swinging.mean() < 0.5
    np.testing.assert_array_equal(compensated["field_total_raw"], broken["field_total"])


def test_attitudes_beyond_the_calibration_are_flagged(cloverleaf):
    calibration = fit(cloverleaf)
    rolled = flight(angles() + np.array([40.0, 0.0, 0.0]))
    flags = compensate(rolled, calibration)["quality_flag"].values
    assert ((flags & TrackFlag.EXTRAPOLATED_CALIBRATION) != 0).mean() > 0.6
    flags = compensate(cloverleaf, calibration)["quality_flag"].values
    assert not (flags & TrackFlag.EXTRAPOLATED_CALIBRATION).any()


# What is refused

STRAIGHT_FLIGHT = np.tile([0.0, 2.0, 20.0], (3000, 1))


def without(name: str) -> xr.Dataset:
    return flight(angles()).drop_vars(name)


def scaled(name: str, factor: float) -> xr.Dataset:
    track = flight(angles())
    return track.assign({name: track[name] * factor})


def uneven() -> xr.Dataset:
    track = flight(angles())
    rng = np.random.default_rng(0)
    jitter = (1e9 * rng.uniform(-0.04, 0.04, track.sizes["time"])).astype("timedelta64[ns]")
    return track.assign_coords(time=track["time"].values + jitter)


REFUSED = {
    "straight flight": (
        lambda: flight(STRAIGHT_FLIGHT), {}, CoverageError, "no oscillation of 1.5",
    ),
    "straight flight, all samples": (
        lambda: flight(STRAIGHT_FLIGHT),
        {"samples": "all", "allow_unobserved": True},
        CoverageError,
        "does not observe 16 of 16 directions, mostly of .*permanent_",
    ),
    "rolls alone": (
        lambda: flight(angles() * np.array([1.0, 0.0, 0.0])),
        {"samples": "all"},
        CoverageError,
        "does not observe [0-9]+ of 16 directions",
    ),
    "one heading": (
        lambda: flight(angles((20.0,))),
        {"samples": "all"},
        CoverageError,
        r"mostly of (permanent|induced|eddy).*four headings",
    ),
    "one heading, mapped": (
        lambda: flight(angles((20.0,))),
        {"form": "map_based", "samples": "all"},
        CoverageError,
        "does not observe",
    ),
    "nothing finite": (lambda: scaled("field_total", np.nan), {}, CoverageError, "no oscillation"),
    "no vector": (
        lambda: without("field_body"), {}, ContractError, "'field_body' is missing",
    ),
    "no scalar": (lambda: without("field_total"), {}, ContractError, "'field_total' is missing"),
    "no map": (
        lambda: without("expected_total"),
        {"form": "map_based"},
        ContractError,
        "run expect-total-field",
    ),
    "vector in other units": (
        lambda: scaled("field_body", 0.1), {}, ContractError, "0.0999 times as long",
    ),
    "uneven times": (uneven, {}, ContractError, "run align-log"),
    "band beyond the sampling": (
        lambda: flight(angles()), {"band_hz": (0.1, 6.0)}, ParameterError, "less than 5 Hz",
    ),
    "low-pass without a map": (
        lambda: flight(angles()), {"low_pass_hz": 1.0}, ParameterError, "map_based",
    ),
    "no time": (
        lambda: flight(angles()), {"span": ("now", "then")}, ParameterError, "'now' is no time",
    ),
    "no time in the span": (
        lambda: flight(angles()),
        {"span": ("2030-01-01T00:00:00Z", "2030-01-01T01:00:00+01:00")},
        CoverageError,
        "no oscillation",
    ),
    "compensated already": (
        lambda: flight(angles()).assign_attrs(compensation="by hand"),
        {},
        ContractError,
        "compensated already",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_fitted_is_refused(case):
    make, params, kind, message = REFUSED[case]
    with pytest.raises(kind, match=message) as caught:
        fit(make(), **params)
    assert isinstance(caught.value, MagtilesError)
    assert caught.value.where is not None


def test_the_span_limits_what_is_fitted(cloverleaf):
    """The same flight twice, its second half with another aircraft: only the first is asked for."""
    other = cloverleaf.assign(
        field_total=cloverleaf["field_total"] + 5.0 * cloverleaf["attitude"][:, 2]
    )
    later = other.assign_coords(time=other["time"] + np.timedelta64(3600, "s"))
    both = xr.concat([cloverleaf, later], "time")
    found = fit(both, span=("2024-05-01T10:00:00", "2024-05-01T13:00:00+02:00"))
    assert distance_modulo_null(found) < 1e-8
    assert found.attrs["last_time"] < "2024-05-01T11"
    assert distance_modulo_null(fit(both)) > 1e-4


def test_unobserved_directions_are_left_at_zero_on_request():
    """A roll, pitch and yaw on one heading compensate that heading, and say nothing of others."""
    leg = flight(angles((20.0,)))
    found = fit(leg, samples="all", allow_unobserved=True)
    seen = compensate(leg, found)["field_total"].values
    assert np.std(seen) < 0.05 * np.std(leg["field_total"].values)
    whole = compensate(flight(angles()), found)["field_total"].values
    assert np.std(whole) > 1.0


REFUSED_CALIBRATIONS = {
    "of a vector magnetometer": (
        lambda c, t: (xr.Dataset(attrs={"method": "ellipsoid"}), t),
        "run apply-calibration",
    ),
    "unknown term": (
        lambda c, t: (c.assign_coords(term=["gravity", *c["term"].values[1:]]), t),
        "unknown term 'gravity'",
    ),
    "no vector": (lambda c, t: (c, t.drop_vars("field_body")), "'field_body' is missing"),
    "twice": (lambda c, t: (c, compensate(t, c)), "compensated already"),
}


@pytest.mark.parametrize("case", REFUSED_CALIBRATIONS)
def test_what_cannot_be_applied_is_refused(case, cloverleaf):
    make, message = REFUSED_CALIBRATIONS[case]
    calibration, track = make(fit(cloverleaf), cloverleaf)
    with pytest.raises(ContractError, match=message):
        compensate(track, calibration)
