"""Stage find-features: steel at known places, and what is not to be taken for it."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from roads import CORE, START

from magtiles.catalog.flags import RoadFlag
from magtiles.schemas import contracts
from magtiles.stages.road.features import FindFeaturesParams, find_features
from magtiles.stages.road.road_map import road_dataset

AT = (120.0, 300.0, 301.0, 640.0)
SIZE = (5000.0, -3000.0, 0.0, 1500.0)
AXIS = (0, 2, 0, 1)


def bumps(distance: np.ndarray, scale: float = 1.0) -> np.ndarray:
    field = np.tile(CORE, (len(distance), 1)) + 800.0 * np.sin(distance / 200.0)[:, None]
    for where, size, axis in zip(AT, SIZE, AXIS, strict=True):
        field[:, axis] += scale * size * np.exp(-(((distance - where) / 4.0) ** 2))
    return field


def road(spacing: float = 1.0, *, passes: int = 3, second: float | None = None) -> xr.Dataset:
    """A map of one vehicle, or of two of which the second saw features so much larger."""
    distance = np.arange(0.0, 800.0, spacing)
    means = [bumps(distance)] + ([] if second is None else [bumps(distance, second)])
    n, points = len(means), len(distance)
    values = {
        "distance": distance,
        "latitude": 39.78 + distance / 111e3,
        "longitude": np.full(points, -84.08),
        "height": np.full(points, 250.0),
        "heading": np.zeros(points),
        "field_body": np.mean(means, axis=0),
        "field_body_uncertainty": np.full((points, 3), 100.0),
        "variation_same_vehicle": np.full((points, 3), 100.0 if passes > 1 else np.nan),
        "passes": np.full(points, passes * n, np.int32),
        "samples": np.full(points, 9, np.int32),
        "quality_flag": np.zeros(points, np.uint8),
        "vehicle_name": np.array(["car", "suv"][:n]),
        "vehicle_passes": np.full((n, points), passes, np.int32),
        "vehicle_mean": np.array(means),
        "vehicle_square_sum": np.zeros((n, points, 3)),
        "pass_name": np.array(["first"]),
        "pass_digest": np.array(["0" * 64]),
        "pass_vehicle": np.array(["car"]),
        "pass_start": np.array([START]),
    }
    attrs = {
        "road": "main", "spacing_m": spacing, "calibrated": "true", "direction": "forward",
        "height_reference": "ellipsoid", "source": "made",
    }  # fmt: skip
    return road_dataset(values, attrs)


def find(made: xr.Dataset, **params: object) -> xr.Dataset:
    found = find_features(made, params=FindFeaturesParams(**params))  # type: ignore[arg-type]
    contracts.check(found, "road-map/1")
    return found


@pytest.mark.parametrize("spacing", [0.5, 1.0, 3.0])
def test_features_are_found_with_peak_length_and_axis(spacing: float) -> None:
    found = find(road(spacing))
    np.testing.assert_allclose(found["feature_peak"], [120.0, 300.0, 640.0], atol=spacing)
    np.testing.assert_array_equal(found["feature_axis"], [0, 2, 1])
    np.testing.assert_allclose(found["feature_amplitude"], [5000.0, -3000.0, 1500.0], rtol=0.12)
    # A Gaussian of 4 m and 5000 nT is above 500 nT for 12 m; the slow field takes some.
    length = found["feature_end"] - found["feature_start"]
    assert float(length[0]) == pytest.approx(11.0, abs=2.0 + spacing)


def test_a_feature_must_have_been_met_twice_and_by_every_vehicle() -> None:
    assert "feature_peak" not in find(road(passes=1))
    assert find(road(passes=1), passes=1).sizes["feature"] == 3
    assert find(road(second=0.8)).sizes["feature"] == 3
    assert "feature_peak" not in find(road(second=0.0))


def test_a_feature_must_stand_out() -> None:
    assert find(road(), threshold_nt=2000.0).sizes["feature"] == 2
    assert find(road(), sigma=40.0).sizes["feature"] == 1


def test_what_was_interpolated_is_no_feature() -> None:
    made = road()
    made["quality_flag"].values[115:126] |= np.uint8(RoadFlag.INTERPOLATED)
    np.testing.assert_allclose(find(made)["feature_peak"], [300.0, 640.0], atol=1.0)


def test_finding_again_replaces_what_was_found() -> None:
    once = find(road())
    assert find(once).identical(once)
    assert "feature_peak" not in find(once, threshold_nt=1e4)
