"""Drives split into roads: what is cut, and which parts are the same road."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import pytest
from roads import follow

from magtiles.schemas.errors import CoverageError
from magtiles.stages.road.split import DrivePart, SplitParams, split_drive


class Expect(NamedTuple):
    id: str
    corners: list[tuple[float, float]]
    parts: list[tuple[int, str, float]]
    """Road, direction, length in m."""


BLOCK = [(0.0, 0.0), (300.0, 0.0), (300.0, 200.0), (0.0, 200.0), (0.0, 0.0)]
CASES = [
    Expect("straight", [(0, 0), (500, 0)], [(0, "forward", 500)]),
    Expect("corner", [(0, 0), (300, 0), (300, 300)], [(0, "forward", 300), (1, "forward", 300)]),
    Expect("bend", [(0, 0), (300, 0), (500, 60)], [(0, "forward", 509)]),
    Expect(
        "U-turn",
        [(0, 0), (400, 0), (400, 8), (0, 8)],
        [(0, "forward", 396), (0, "backward", 396)],
    ),
    Expect(
        "U-turn, and a fix that wanders at a light",
        [(0, 0), (200, 0), (203, 3), (400, 3), (400, -5), (0, -5)],
        [(0, "forward", 396), (0, "backward", 396)],
    ),
    Expect(
        "two laps",
        BLOCK + BLOCK[1:],
        2 * [(0, "forward", 300), (1, "forward", 200), (2, "forward", 300), (3, "forward", 200)],
    ),
    Expect(
        "crossing",
        [(0, 0), (400, 0), (400, 200), (200, 200), (200, -200)],
        [(i, "forward", 200) for i in range(6)],
    ),
]


def split(track: object) -> list[DrivePart]:
    return split_drive(track, params=SplitParams())  # type: ignore[arg-type]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.id)
def test_a_drive_is_cut_at_junctions_and_named_by_place(case: Expect) -> None:
    parts = split(follow(np.array(case.corners)))
    assert [(p.road, p.direction) for p in parts] == [c[:2] for c in case.parts]
    np.testing.assert_allclose([p.length_m for p in parts], [c[2] for c in case.parts], atol=8.0)
    for before, after in itertools.pairwise(parts):
        assert before.end <= after.start


def test_a_gap_parts_a_drive() -> None:
    track = follow(np.array([(0.0, 0.0), (600.0, 0.0)]))
    track["field_body"].values[400:520] = np.nan  # 60 m
    parts = split(track)
    assert [p.road for p in parts] == [0, 1]
    np.testing.assert_allclose([p.length_m for p in parts], [200.0, 340.0], atol=4.0)


def test_places_lost_part_a_drive() -> None:
    track = follow(np.array([(0.0, 0.0), (900.0, 0.0)]))
    for name in ("latitude", "longitude"):
        track[name].values[400:900] = np.nan  # 25 s, of which the middle is over 5 s from a fix
    assert len(split(track)) == 2


def test_a_drive_that_hardly_moves_is_refused() -> None:
    with pytest.raises(CoverageError, match=r"the drive is \d+\.\d m long"):
        split(follow(np.array([(0.0, 0.0), (15.0, 0.0)])))
