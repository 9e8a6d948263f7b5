"""``magtiles query RELEASE --date``: the whole field that is expected."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import ppigrf
import pytest
from synthetic_release import World

from magtiles.catalog import open_release
from magtiles.pipeline.main import main

PLACE = ["--lat", "44.2", "--lon", "10.3", "--height", "500"]
CORE_KEYS = ("north", "east", "down", "horizontal", "total", "declination", "inclination")

Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def release(tmp_path_factory: pytest.TempPathFactory) -> Path:
    coefficients = Path(ppigrf.__file__).with_name("IGRF14.shc")
    world = World(heights=(0.0, 1000.0))
    store = tmp_path_factory.mktemp("store")
    return world.publish(store, extra_files={"core_field.shc": coefficients}).path


def asked(capsys: Capture, *argv: str) -> dict[str, float]:
    assert main(["query", *argv, "--json"]) == 0
    answer: dict[str, float] = json.loads(capsys.readouterr().out)
    return answer


def test_a_date_adds_the_expected_field(release: Path, capsys: Capture) -> None:
    found = asked(capsys, str(release), *PLACE, "--date", "2024-03-01")
    an = open_release(release).anomaly
    place = 44.2, 10.3, 500.0, "2024-03-01"
    vector = an.expected_vector(*place)
    assert [found[k] for k in ("north", "east", "down")] == pytest.approx(vector, abs=1e-9)
    assert found["total"] == pytest.approx(an.expected_total_field(*place), abs=1e-9)
    assert found["total"] == pytest.approx(np.linalg.norm(vector), abs=1.0)
    assert found["horizontal"] == pytest.approx(np.hypot(*vector[:2]))
    assert found["horizontal"] * np.tan(np.radians(found["inclination"])) == pytest.approx(
        vector[2]
    )
    assert found["horizontal"] * np.sin(np.radians(found["declination"])) == pytest.approx(
        vector[1]
    )
    assert found["anomaly"] == an.total(*place[:3])


def test_without_a_date_and_where_nothing_is_known(release: Path, capsys: Capture) -> None:
    assert {asked(capsys, str(release), *PLACE)[k] for k in CORE_KEYS} == {None}
    away = ["--lat", "10", "--lon", "10", "--height", "500", "--date", "2024.5"]
    assert {asked(capsys, str(release), *away)[k] for k in CORE_KEYS} == {None}


def test_dates_are_one_or_as_many_as_positions(release: Path, capsys: Capture) -> None:
    argv = ["query", str(release), *PLACE, "--lat", "44.3", "--date", "2000-01-01", "2024-01-01"]
    assert main(argv) == 0
    table = capsys.readouterr().out
    assert "total field nT" in table
    assert len(table.splitlines()) >= 3
    assert main([*argv, "2025-01-01"]) == 2
    assert "--date: 3 dates; expected 1 or 2" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        (["--date", "2050"], 1, "outside the validity"),
        (["--date", "soon"], 1, "'soon'"),
        (["--date", "2020", "--allow-extrapolated"], 2, "--allow-extrapolated: given with a"),
        (["--date", "2020", "--height-above-reference"], 2, "heights above the ellipsoid"),
    ],
    ids=["far future", "no date", "extrapolated", "above reference"],
)
def test_bad_dates(
    release: Path, capsys: Capture, words: list[str], status: int, message: str
) -> None:
    assert main(["query", str(release), *PLACE, *words]) == status
    assert message in capsys.readouterr().err
