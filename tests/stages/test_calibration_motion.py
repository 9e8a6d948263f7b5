"""Finding circles in a drive, by heading or by the field alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from magtiles.stages.vehicle.calibration.motion import (
    find_circles,
    revolutions_of,
    tangent_angle,
)

CENTRE = np.array([5.0, -3.0])  # far outside the unit circle: the angle about zero never turns


class Expect(NamedTuple):
    revolutions: float
    noise: float
    id: str


@pytest.mark.parametrize(
    "case",
    [
        Expect(3.0, 0.0, "three to the right"),
        Expect(-2.5, 0.0, "two and a half to the left"),
        Expect(3.0, 0.02, "as noisy as a car's"),
        Expect(0.0, 0.02, "standing still"),
    ],
    ids=lambda c: c.id,
)
def test_an_ellipse_about_any_centre_turns_with_the_vehicle(case: Expect) -> None:
    phase = np.linspace(0.0, 2.0 * np.pi * case.revolutions, 2000)
    points = np.column_stack([1.3 * np.cos(phase), 0.8 * np.sin(phase)]) + CENTRE
    points += np.random.default_rng(0).normal(0.0, case.noise, points.shape)
    angle = tangent_angle(points, step=0.3)
    # Half a chord is lost at the start and up to one and a half at the end: measured 0.17.
    turned = np.sign(angle[-1] - angle[0]) * revolutions_of(angle)
    assert turned == pytest.approx(case.revolutions, abs=0.18)


def test_a_straight_path_does_not_turn() -> None:
    along = np.linspace(0.0, 100.0, 500)
    points = np.column_stack([along, 0.5 * along])
    points += np.random.default_rng(0).normal(0.0, 0.1, points.shape)
    assert revolutions_of(tangent_angle(points, step=3.0)) < 0.05


def drive() -> tuple[np.ndarray, np.ndarray, tuple[float, float]]:
    """Ten minutes with a block driven round in four minutes, and circles from 400 to 460 s."""
    seconds = np.arange(0.0, 600.0, 0.02)
    heading = np.interp(seconds, [0, 60, 300, 400, 460, 600], [0, 0, 1.0, 1.0, 4.0, 4.0])
    return seconds, 2.0 * np.pi * heading, (400.0, 460.0)


def test_tight_circles_are_found_and_a_drive_round_the_block_is_not() -> None:
    seconds, heading, (start, end) = drive()
    stretch, driven = find_circles(seconds, heading, slowest_s=120.0)
    assert driven == pytest.approx(3.0, abs=0.03)
    assert seconds[stretch][0] == pytest.approx(start, abs=1.0)
    assert seconds[stretch][-1] == pytest.approx(end, abs=1.0)


def test_the_longest_of_several_stretches_either_way_round() -> None:
    seconds = np.arange(0.0, 600.0, 0.1)
    heading = 2 * np.pi * np.interp(seconds, [0, 40, 200, 300, 600], [0, 1.5, 1.5, -3.0, -3.0])
    stretch, driven = find_circles(seconds, heading, slowest_s=120.0)
    assert driven == pytest.approx(4.5, abs=0.05)
    assert seconds[stretch][0] == pytest.approx(200.0, abs=1.0)


def test_without_a_whole_revolution_all_that_was_turned_is_told() -> None:
    seconds = np.arange(0.0, 60.0, 0.1)
    stretch, driven = find_circles(seconds, np.radians(0.02 * seconds), slowest_s=120.0)
    assert stretch == slice(0, len(seconds))
    assert 360.0 * driven == pytest.approx(1.2, abs=0.01)


def test_a_fast_turntable_and_a_record_of_few_samples() -> None:
    seconds = np.arange(0.0, 10.0, 0.01)
    _, driven = find_circles(seconds, 2.0 * np.pi * seconds, slowest_s=120.0)
    assert driven == pytest.approx(10.0, abs=0.02)
    stretch, driven = find_circles(np.array([0.0, 0.1]), np.array([0.0, 1.0]), slowest_s=120.0)
    assert stretch == slice(0, 2)
    assert driven == pytest.approx(0.5 / np.pi)
