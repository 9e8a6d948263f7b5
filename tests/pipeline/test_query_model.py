"""``magtiles query --model``: the field of a model, from an id or a file."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from magtiles.catalog.models import evaluate, load_igrf
from magtiles.pipeline.main import main

Capture = pytest.CaptureFixture[str]

PLACE = ["--lat", "45", "--lon", "-104", "--height", "1000"]


@pytest.mark.parametrize(("name", "generation"), [("igrf14", 14), ("IGRF-13", 13)])
def test_elements_of_the_field(name: str, generation: int, capsys: Capture) -> None:
    assert main(["query", "--model", name, *PLACE, "--date", "2020-07-02", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    north, east, down = evaluate(load_igrf(generation), 45.0, -104.0, 1000.0, 2020.5)
    expected = {
        "model": f"IGRF{generation}",
        "latitude": 45.0,
        "longitude": -104.0,
        "height": 1000.0,
        "decimal_year": 2020.5,
        "north": north,
        "east": east,
        "down": down,
        "horizontal": np.hypot(north, east),
        "total": np.sqrt(north**2 + east**2 + down**2),
        "declination": np.degrees(np.arctan2(east, north)),
        "inclination": np.degrees(np.arctan2(down, np.hypot(north, east))),
        "extrapolated": False,
    }
    assert answer == pytest.approx(expected)
    assert 7.0 < answer["declination"] < 8.0  # east of north in South Dakota


def test_official_value_of_a_file(real_data: Path, capsys: Capture) -> None:
    model = str(real_data / "harmonics" / "WMM_2020.COF")
    argv = ["query", "--model", model, "--lat", "89", "--lon", "-121", "--height", "28000"]
    assert main([*argv, "--date", "2020.0", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    official = {
        "declination": -112.41, "inclination": 88.46, "horizontal": 1510.0, "north": -575.7,
        "east": -1396.0, "down": 56082.3, "total": 56102.7,
    }  # fmt: skip
    assert {key: answer[key] for key in official} == pytest.approx(official, abs=0.05)


def test_several_positions_and_dates(capsys: Capture) -> None:
    argv = ["query", "--model", "igrf14", "--lat", "45", "46", "--lon", "-104", "--height", "0"]
    assert main([*argv, "--date", "2020.0", "2036-01-01", "--allow-extrapolated"]) == 0
    header, first, second = capsys.readouterr().out.splitlines()
    assert header.split()[:4] == ["latitude", "longitude", "height", "m"]
    assert first.split()[-1] == "-"
    assert second.split()[-1] == "extrapolated"


@pytest.mark.parametrize(
    ("argv", "status", "parts"),
    [
        (["--model", "igrf14", *PLACE, "--date", "2031-01-01"], 1,
         ["validity of IGRF14; expected 1900 to 2030", "--allow-extrapolated"]),
        (["--model", "igrf14", *PLACE], 2, ["--date: a model's field changes", "give --date"]),
        (["--model", "igrf14", *PLACE, "--date", "June"], 1, ["date is 'June'"]),
        (["--model", "igrf12", *PLACE, "--date", "2000"], 1, ["expected 13 or 14"]),
        (["--model", "none.cof", *PLACE, "--date", "2000"], 2, ["no model 'none.cof'"]),
        (["--model", "igrf14", "--lat", "91", *PLACE[2:], "--date", "2000"], 1, ["latitude 91"]),
        (["--model", "igrf14", *PLACE[:-1], "-20000", "--date", "2000"], 1, ["inside the Earth"]),
        (["--model", "igrf14", *PLACE, "--height-above-reference", "--date", "2000"], 2,
         ["--height-above-reference: given with a model"]),
        (["release", "--model", "igrf14", *PLACE], 2, ["either RELEASE or --model"]),
        (PLACE, 2, ["either RELEASE or --model"]),
    ],
    ids=["validity", "no-date", "word", "generation", "no-file", "latitude", "inside",
         "above-reference", "both", "neither"],
)  # fmt: skip
def test_what_cannot_be_answered(
    argv: list[str], status: int, parts: list[str], capsys: Capture
) -> None:
    assert main(["query", *argv]) == status
    error = capsys.readouterr().err
    assert all(part in error for part in parts), error
