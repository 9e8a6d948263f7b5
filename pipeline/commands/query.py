"""Ask a release for the anomaly, or a model for the field, at positions.

Heights are metres above the WGS84 ellipsoid.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.flags import QualityFlag
from magtiles.pipeline import model_query
from magtiles.pipeline.output import print_json, print_table
from magtiles.pipeline.temporal_query import print_temporal, temporal_answers
from magtiles.schemas.errors import FormatError, UsageError

if TYPE_CHECKING:
    from magtiles.catalog.releases.expected import ReleaseAnomaly

HELP = "print the anomaly of a release, or the field of a model, at positions"
NEEDS_PIPELINE = False

_CORE = ("north", "east", "down", "horizontal", "total", "declination", "inclination")
_COLUMNS = ("latitude", "longitude", "height")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``magtiles query``."""
    parser.add_argument(
        "release", type=Path, nargs="?", metavar="RELEASE", help="folder of a release"
    )
    parser.add_argument(
        "--model",
        metavar="ID_OR_FILE",
        help="a field model instead: igrf13, igrf14, or a file (SHC, COF, .wmm) or EMM folder",
    )
    parser.add_argument(
        "--date",
        nargs="+",
        action="extend",
        default=[],
        metavar="DATE",
        help="ISO date or decimal year, UTC; one serves all positions. For a release it adds the "
        "whole field: north, east, down of core and anomaly, and as total |core| + anomaly; and "
        "the quiet-day variation, sigma and tau, if it has a temporal model",
    )
    parser.add_argument(
        "--allow-extrapolated",
        action="store_true",
        help="answer for dates beyond the model's validity, and say so",
    )
    for option, meaning in (
        ("--lat", "geodetic latitudes, degrees north"),
        ("--lon", "longitudes, degrees east"),
        ("--height", "heights, metres above the WGS84 ellipsoid"),
    ):
        parser.add_argument(
            option,
            type=_numbers,
            nargs="+",
            action="extend",
            default=[],
            metavar="NUMBER",
            help=f"{meaning}; several by spaces or commas; one serves all positions",
        )
    parser.add_argument(
        "--positions",
        metavar="FILE.csv",
        help="CSV with a header latitude,longitude,height; - reads it from stdin",
    )
    parser.add_argument(
        "--height-above-reference",
        action="store_true",
        help="heights count from the release's own surface (terrain or sea level) instead",
    )
    parser.add_argument(
        "--kp",
        type=float,
        metavar="KP",
        help="Kp at the dates, 0 to 9, by which sigma and tau of the release are chosen",
    )
    parser.add_argument("--json", action="store_true", help="print JSON; missing is null")


def run(arguments: argparse.Namespace) -> int:
    """Answer every position, in order; NaN where the release does not know."""
    if (arguments.release is None) == (arguments.model is None):
        raise UsageError("nothing to ask, or two", expected="either RELEASE or --model ID_OR_FILE")
    positions = _positions(arguments)
    if arguments.model is not None:
        answers, show = _ask_model(arguments, positions), model_query.print_answers
    else:
        answers, show = _ask_release(arguments, positions), _print_answers
    if arguments.json:
        print_json(answers[0] if _is_single(arguments) else answers)
    else:
        show(answers)
    return 0


def _ask_release(
    arguments: argparse.Namespace, positions: NDArray[np.float64]
) -> list[dict[str, Any]]:
    if arguments.allow_extrapolated:
        raise UsageError("given with a release", where="--allow-extrapolated", expected="--model")
    if arguments.date:
        _check_dates(arguments.date, len(positions))
        if arguments.height_above_reference:
            raise UsageError(
                "given with --date",
                where="--height-above-reference",
                expected="heights above the ellipsoid, where a core field can be evaluated",
            )
    elif arguments.kp is not None:
        raise UsageError("given without --date", where="--kp", remedy="give --date")
    return answer(
        arguments.release,
        positions,
        above_reference=arguments.height_above_reference,
        dates=arguments.date,
        kp=arguments.kp,
    )


def _ask_model(
    arguments: argparse.Namespace, positions: NDArray[np.float64]
) -> list[dict[str, Any]]:
    if arguments.height_above_reference:
        raise UsageError("given with a model", where="--height-above-reference")
    if arguments.kp is not None:
        raise UsageError("given with a model", where="--kp")
    _check_dates(arguments.date, len(positions))
    return model_query.answer(
        model_query.find_model(arguments.model),
        positions,
        arguments.date,
        allow_extrapolated=arguments.allow_extrapolated,
    )


def _check_dates(dates: Sequence[str], positions: int) -> None:
    if not dates:
        raise UsageError(
            "a model's field changes in time", where="--date", remedy="give --date 2026-07-01"
        )
    if len(dates) not in (1, positions):
        raise UsageError(
            f"{len(dates)} dates",
            where="--date",
            expected="one" if positions == 1 else f"1 or {positions}",
        )


def answer(
    folder: Path,
    positions: NDArray[np.float64],
    *,
    above_reference: bool,
    dates: Sequence[str] = (),
    kp: float | None = None,
) -> list[dict[str, Any]]:
    """What a release says at positions (n, 3): latitude, longitude (deg) and height (m).

    With one date, or one for each position, the field that is expected there: core and
    anomaly, and what its temporal model says. Without, these keys are None.
    """
    from magtiles.catalog import open_release

    latitude, longitude, height = positions.T
    place: dict[str, Any] = {"latitude": latitude, "longitude": longitude}
    place["height_above_reference" if above_reference else "height"] = height
    release = open_release(folder)
    if not (above_reference or release.manifest.takes_ellipsoidal_height):
        surface = release.manifest.height_reference.replace("_", " ")
        raise UsageError(
            f"heights of this release count from {surface}, whose own height it does not know",
            where="--height",
            remedy="give heights above it, and --height-above-reference",
        )
    anomaly = release.anomaly
    total = anomaly.total(**place)
    vector = anomaly.vector(**place)
    uncertainty = anomaly.uncertainty(**place)
    flags = anomaly.flags(**place)
    expected = _expected(anomaly, positions, dates) if dates else [dict.fromkeys(_CORE)]
    temporal = temporal_answers(release, positions, dates, kp)
    return [
        {
            **dict(zip(_COLUMNS, map(float, positions[i]), strict=True)),
            **expected[i if dates else 0],
            "anomaly": float(total[i]),
            "anomaly_north": float(vector[i, 0]),
            "anomaly_east": float(vector[i, 1]),
            "anomaly_down": float(vector[i, 2]),
            "uncertainty": float(uncertainty[i]),
            "flags": flag_names(int(flags[i])),
            "temporal": temporal[i],
        }
        for i in range(len(positions))
    ]


def _expected(
    anomaly: ReleaseAnomaly, positions: NDArray[np.float64], dates: Sequence[str]
) -> list[dict[str, float]]:
    """Elements of the expected field, nT and degrees; the total is |core| + total anomaly."""
    when = np.broadcast_to(np.array(dates), len(positions))
    lat, lon, h = positions.T
    total = anomaly.expected_total_field(lat, lon, h, when)
    north, east, down = anomaly.expected_vector(lat, lon, h, when).T
    horizontal = np.hypot(north, east)
    declination = np.degrees(np.arctan2(east, north))
    inclination = np.degrees(np.arctan2(down, horizontal))
    rows = zip(north, east, down, horizontal, total, declination, inclination, strict=True)
    return [dict(zip(_CORE, map(float, row), strict=True)) for row in rows]


def flag_names(bits: int) -> list[str]:
    """Names of the bits that are set, as CF writes them."""
    return [str(flag.name).lower() for flag in QualityFlag if flag & bits]


def _is_single(arguments: argparse.Namespace) -> bool:
    values = (arguments.lat, arguments.lon, arguments.height)
    return arguments.positions is None and all(sum(map(len, v)) == 1 for v in values)


def _positions(arguments: argparse.Namespace) -> NDArray[np.float64]:
    given = {
        "--lat": [n for numbers in arguments.lat for n in numbers],
        "--lon": [n for numbers in arguments.lon for n in numbers],
        "--height": [n for numbers in arguments.height for n in numbers],
    }
    if arguments.positions is not None:
        if any(given.values()):
            raise UsageError("given together with --lat, --lon, --height", where="--positions")
        with _opened(arguments.positions) as (file, name):
            return read_positions(file, name)
    for option, numbers in given.items():
        if not numbers:
            raise UsageError("no positions", where=option, remedy="give it, or --positions")
    count = max(len(numbers) for numbers in given.values())
    for option, numbers in given.items():
        if len(numbers) not in (1, count):
            raise UsageError(f"{len(numbers)} numbers", where=option, expected=f"1 or {count}")
    columns = [np.broadcast_to(np.array(numbers), count) for numbers in given.values()]
    return np.column_stack(columns)


@contextlib.contextmanager
def _opened(name: str) -> Iterator[tuple[TextIO, str]]:
    if name == "-":
        yield sys.stdin, "<stdin>"
        return
    with open(name, encoding="utf-8-sig", newline="") as file:
        yield file, name


def read_positions(file: Iterable[str], name: str) -> NDArray[np.float64]:
    """Positions (n, 3) from CSV lines with a header; other columns are passed over.

    Raises FormatError naming file, line and column.
    """
    try:
        return _read_rows(csv.DictReader(file, skipinitialspace=True), name)
    except (UnicodeDecodeError, csv.Error) as caught:
        raise FormatError(f"is no CSV text: {caught}", where=name) from None


def _read_rows(rows: csv.DictReader[str], name: str) -> NDArray[np.float64]:
    missing = [c for c in _COLUMNS if c not in (rows.fieldnames or ())]
    if missing:
        raise FormatError(
            f"no column '{missing[0]}'",
            where=f"{name} line 1",
            expected=f"a header with {', '.join(_COLUMNS)}",
        )
    table = [[_cell(row, column, name, rows.line_num) for column in _COLUMNS] for row in rows]
    if not table:
        raise FormatError("no positions", where=name, expected="a line for each below the header")
    return np.array(table, dtype=np.float64)


def _cell(row: dict[str, str | None], column: str, name: str, line: int) -> float:
    text = row[column]
    try:
        return float(text or "")
    except ValueError:
        raise FormatError(
            f"{column} is {text!r}", where=f"{name} line {line}", expected="a number"
        ) from None


def _numbers(text: str) -> list[float]:
    try:
        return [float(part) for part in text.strip().strip(",").split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number, or a list of them") from None


def _print_answers(answers: list[dict[str, Any]]) -> None:
    header = ["latitude", "longitude", "height m", "anomaly nT", "north", "east", "down"]
    field = ("total", "declination", "inclination") if answers[0]["total"] is not None else ()
    units = {"total": "total field nT", "declination": "declination deg"}
    rows = [
        (
            f"{a['latitude']:.6f}",
            f"{a['longitude']:.6f}",
            f"{a['height']:.1f}",
            *(f"{a[k]:.2f}" for k in ("anomaly", "anomaly_north", "anomaly_east", "anomaly_down")),
            f"{a['uncertainty']:.2f}",
            *(f"{a[k]:.2f}" for k in field),
            " ".join(a["flags"]) or "-",
        )
        for a in answers
    ]
    print_table([*header, "1 sigma", *(units.get(k, k) for k in field), "flags"], rows)
    print_temporal([a["temporal"] for a in answers])
