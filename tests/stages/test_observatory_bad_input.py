"""Bad records and indices: an error that names the place, or a flag that names the fault."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import iaga
import numpy as np
import pytest

from magtiles.catalog.flags import RecordFlag
from magtiles.schemas.errors import FormatError, MagtilesError, SourceError
from magtiles.stages.ingest.index import IngestIndexParams, ingest_index
from magtiles.stages.ingest.observatory.stage import IngestObservatoryParams, ingest_observatory
from magtiles.stages.temporal.check import CheckObservatoryParams, check_observatory

GOOD = iaga.header() + iaga.rows(iaga.minutes(count=120), iaga.field(120))
FIRST = len(iaga.header())  # index of the first row


def text(lines: list[str]) -> bytes:
    return ("\n".join(lines) + "\n").encode()


def changed(row: int, old: str, new: str) -> bytes:
    assert old in GOOD[FIRST + row]
    lines = list(GOOD)
    lines[FIRST + row] = lines[FIRST + row].replace(old, new)
    return text(lines)


def mixed(step_s: int) -> bytes:
    """An hour of minutes, then rows of another cadence."""
    time = np.concatenate([iaga.minutes(count=60), iaga.minutes("2016-01-01T01:00", 60, step_s)])
    return text(iaga.header() + iaga.rows(time, iaga.field(120)))


class Expect(NamedTuple):
    id: str
    files: dict[str, bytes]
    error: type[MagtilesError]
    says: tuple[str, ...]
    keys: dict[str, Any] = {}  # noqa: RUF012


HTML = b"<!DOCTYPE html>\n<html><body>404 Not Found</body></html>"
UVW = text(iaga.header("UVWF") + GOOD[FIRST:])
HERE = {"latitude": 40.1, "longitude": -105.2, "elevation_m": 1682.0}
WDC = "BOU1310X01    20 206" + "4505" * 24 + "4505"
IMF = "BOU MAR1516 075 00 XYZF A GOL 04992548 000000 " + "R" * 16
IMF_ROW = " 205730   31110  480480 523600   205730   31110  480480 523600"

BAD = [
    Expect("missing", {}, FormatError, ("f.min", "does not exist")),
    Expect("empty", {"f.min": b" \n"}, FormatError, ("f.min", "empty")),
    Expect("html", {"f.min": HTML}, FormatError, ("f.min line 1", "HTML", "fetch it again")),
    Expect("html gz", {"f": gzip.compress(HTML)}, FormatError, ("HTML",)),
    Expect("zip", {"f": b"PK\x03\x04" + bytes(60)}, FormatError, ("zip archive", "unpack")),
    Expect("other", {"f": b"year,month\n"}, FormatError, ("line 1", "unknown format", "IAGA")),
    Expect("cut gz", {"f": gzip.compress(text(GOOD))[:-20]}, FormatError, ("unpacked", "trunc")),
    Expect("cdf", {"f": b"\xcd\xf3\x00\x01" + bytes(99)}, FormatError, ("cannot be read as CDF",)),
    Expect("no rows", {"f": text(GOOD[:FIRST])}, FormatError, ("has no data",)),
    Expect("header only", {"f": text(GOOD[:5])}, FormatError, ("DATE TIME DOY", "missing")),
    Expect(
        "truncated line", {"f": text(GOOD)[:-20]}, FormatError,
        (f"line {len(GOOD)}", "truncated", "4 values"),
    ),
    Expect(
        "truncated number", {"f": text(GOOD)[:-4]}, FormatError, (f"line {len(GOOD)}", "truncated")
    ),
    Expect(
        "no number", {"f": changed(7, "  2057", "  2O57")}, FormatError,
        (f"line {FIRST + 8}", "numbers", "2O57"),
    ),
    Expect("nan", {"f": changed(7, GOOD[FIRST + 7][31:40], "      nan")}, FormatError, ("99999",)),
    Expect("no day", {"f": changed(3, "01-01", "02-30")}, FormatError, ("no such time", "02-30")),
    Expect("doy", {"f": changed(3, " 001 ", " 002 ")}, FormatError, (f"line {FIRST + 4}", "002")),
    Expect("hour", {"f": changed(3, " 00:03", " 24:03")}, FormatError, ("no such time", "24:03")),
    Expect(
        "backwards", {"f": changed(9, "00:09", "00:04")}, FormatError,
        (f"line {FIRST + 10}", "time goes backwards: 2016-01-01T00:04:00 follows", "sort"),
    ),
    Expect(
        "repeated", {"f": changed(9, "00:09", "00:08")}, FormatError,
        (f"line {FIRST + 10}", "time goes backwards", "is repeated"),
    ),
    Expect(
        "mixed to seconds", {"f": mixed(1)}, FormatError, (f"line {FIRST + 62}", "mixed cadence")
    ),
    Expect(
        "mixed to hours", {"f": mixed(3600)}, FormatError, (f"line {FIRST + 62}", "mixed cadence")
    ),
    Expect(
        "odd second", {"f": changed(9, "00:09:00", "00:09:01")}, FormatError,
        (f"line {FIRST + 10}", "mixed cadence", "61 s"),
    ),
    Expect(
        "mixed files",
        {"a": text(GOOD), "b": text(GOOD[:FIRST] + iaga.rows(iaga.minutes(count=9, step_s=1),
                                                             iaga.field(9)))},
        FormatError, ("b", "mixed cadence", "1 s", "60 s"),
    ),
    Expect(
        "off the grid",
        {"a": text(GOOD), "b": text(GOOD[:FIRST] + iaga.rows(iaga.minutes("2016-01-02T00:00:30", 9),
                                                             iaga.field(9)))},
        FormatError, ("b", "mixed cadence", "00:30"),
    ),
    Expect("one row", {"f": text(GOOD[: FIRST + 1])}, FormatError, ("single row",)),
    Expect("sensor axes", {"f": UVW}, SourceError, ("wrong element set", "sensor_axes")),
    Expect("no vector", {"f": text(iaga.header("XYIF") + GOOD[FIRST:])}, FormatError,
           ("wrong element set", "X Y I F", "XYZ, HDZ")),
    Expect(
        "columns not reported", {"f": text(iaga.header(Reported="HDZF") + GOOD[FIRST:])},
        FormatError, (f"line {FIRST}", "wrong element set", "X Y Z F", "H D Z F"),
    ),
    Expect(
        "code clash of files",
        {"a": text(GOOD), "b": text(iaga.header(IAGA_CODE="FRD") + GOOD[FIRST:])},
        SourceError, ("b", "station code clash", "FRD", "BOU"),
    ),
    Expect(
        "code clash in a file", {"f": text(GOOD).replace(b"BOUZ", b"FRDZ")}, SourceError,
        (f"line {FIRST}", "FRDZ", "BOU"),
    ),
    Expect("code clash of key", {"f": text(GOOD)}, SourceError, ("code clash",),
           {"iaga_code": "FRD"}),
    Expect("position clash", {"f": text(GOOD)}, SourceError, ("latitude is 40.137", "-40.137"),
           {"latitude": -40.137}),
    Expect(
        "no position", {"f": text(iaga.header(Elevation="") + GOOD[FIRST:])}, SourceError,
        ("elevation_m", "[series]", "f"),
    ),
    Expect("bad header", {"f": text(iaga.header(Elevation="high") + GOOD[FIRST:])}, FormatError,
           ("elevation", "high", "a number")),
    Expect("wdc position", {"f": (WDC + "\r\n").encode()}, SourceError, ("latitude", "parameter")),
    Expect("wdc truncated", {"f": f"{WDC}\n{WDC[:100]}\n".encode()}, FormatError,
           ("line 2", "truncated"), HERE),
    Expect("wdc duplicated day", {"f": f"{WDC}\n{WDC}\n".encode()}, FormatError,
           ("line 2", "duplicated day", "2013-10-01"), HERE),
    Expect("wdc two stations", {"f": f"{WDC}\nFRD{WDC[3:]}\n".encode()}, SourceError,
           ("line 2", "FRD", "one station"), HERE),
    Expect("wdc no number", {"f": WDC.replace("4505", "45 5", 1).encode()}, FormatError,
           ("line 1", "malformed"), HERE),
    Expect("imf truncated", {"f": text([IMF, *[IMF_ROW] * 29])}, FormatError,
           ("line 30", "truncated", "30 lines"), HERE),
    Expect("imf bad row", {"f": text([IMF, *[IMF_ROW] * 29, IMF_ROW[:-9]])}, FormatError,
           ("line 31", "two minutes"), HERE),
    Expect("imf no hour", {"f": text([IMF.replace("075", "076"), *[IMF_ROW] * 30])}, FormatError,
           ("line 1", "no such hour"), HERE),
    Expect("imf repeated hour", {"f": text([IMF, *[IMF_ROW] * 30] * 2)}, FormatError,
           ("line 33", "time goes backwards"), HERE),
]  # fmt: skip


@pytest.mark.parametrize("case", BAD, ids=lambda case: case.id)
def test_a_bad_record_is_named(case: Expect, tmp_path: Path) -> None:
    for name, content in case.files.items():
        (tmp_path / name).write_bytes(content)
    paths = [tmp_path / name for name in case.files or ("f.min",)]
    with pytest.raises(case.error) as caught:
        ingest_observatory(paths, params=IngestObservatoryParams(**case.keys))
    assert type(caught.value) is case.error
    for words in case.says:
        assert words in str(caught.value)


class Fault(NamedTuple):
    id: str
    spoil: Callable[[Any], None]
    flag: RecordFlag
    check: str
    element: str


def add(element: int, part: slice, size: float) -> Callable[[Any], None]:
    def spoil(field: Any) -> None:
        field[element, part] += size

    return spoil


def hold(element: int, part: slice) -> Callable[[Any], None]:
    def spoil(field: Any) -> None:
        field[element, part] = field[element, part.start]

    return spoil


def mark(element: int, value: float) -> Callable[[Any], None]:
    def spoil(field: Any) -> None:
        field[element, 500:510] = value

    return spoil


FAULTS = [
    Fault("99999", mark(0, 99999.0), RecordFlag.MISSING_MARK, "missing", "field_north"),
    Fault("88888 now and then", mark(3, 88888.0), RecordFlag.MISSING_MARK, "missing",
          "field_total"),
    Fault("spike", add(1, slice(500, 502), 5.0), RecordFlag.SPIKE, "spike", "field_east"),
    Fault("step", add(0, slice(500, None), 8.0), RecordFlag.STEP, "step", "field_north"),
    Fault("stuck", hold(0, slice(400, 500)), RecordFlag.STUCK, "stuck", "field_north"),
    Fault("total", add(3, slice(500, 560), 6.0), RecordFlag.TOTAL_MISMATCH, "total_mismatch",
          "field_total"),
    Fault("level", add(2, slice(0, None), 1500.0), RecordFlag.LEVEL_MISMATCH, "level_mismatch",
          "vector"),
]  # fmt: skip


@pytest.mark.parametrize("case", FAULTS, ids=lambda case: case.id)
def test_a_fault_of_a_record_is_flagged_and_reported_and_not_repaired(
    case: Fault, tmp_path: Path
) -> None:
    field = iaga.field(1440)
    case.spoil(field)
    lines = iaga.header() + iaga.rows(iaga.minutes(), field)
    series = ingest_observatory(
        [iaga.write(tmp_path / "f", lines)], params=IngestObservatoryParams()
    )
    checked = check_observatory(series, params=CheckObservatoryParams())
    findings = {(f["check"], f["element"]) for f in json.loads(checked.attrs["findings"])}
    assert (case.check, case.element) in findings
    flagged = (checked.quality_flag.values & case.flag) != 0
    touched = (field != iaga.field(1440)).any(axis=0)
    assert flagged.any()
    assert not (flagged & ~touched & ~np.roll(touched, -1)).any()  # a held run begins as it was
    for name in ("field_north", "field_east", "field_down", "field_total"):
        np.testing.assert_array_equal(checked[name].values, series[name].values)


KP_CSV = b"Date,K_00,K_03,K_06,K_09,K_12,K_15,K_18,K_21,Kp_Sum\n2016-01-01,1,1,1,1,1,1,1,1,8\n"
KP_WDC = b" 9 1 12394 1172327202317 717150  6  9 12  7  9  6  3  6  70.42\n"
QUIET = b"   Quietest Days\n  Month\n Jan 2010   17   7   9   2   8    27   6  16  19   1    20*"
DST = b"DST1310*01RRX220   0" + b"  -9" * 24 + b"  -9\n"
INTERVAL = b"2016 01 01 00.0 01.50 30681.00000 30681.06250  3.333   18 1\n"


@pytest.mark.parametrize(
    "case",
    [
        Expect("html", {"k": HTML}, FormatError, ("HTML",)),
        Expect("other", {"k": b"no index"}, FormatError, ("line 1", "unknown format")),
        Expect("csv no third", {"k": KP_CSV.replace(b"1,1,8", b"1,1.5,8")}, FormatError,
               ("line 2", "1.5", "third")),
        Expect("csv short", {"k": KP_CSV[:-15]}, FormatError, ("line 2", "eight Kp")),
        Expect("csv twice", {"k": KP_CSV + KP_CSV.splitlines()[1]}, FormatError,
               ("line 3", "duplicated day")),
        Expect("wdc short", {"k": KP_WDC + KP_WDC[:40]}, FormatError, ("line 2", "truncated")),
        Expect("wdc no third", {"k": KP_WDC.replace(b"1723", b"1823")}, FormatError,
               ("line 1", "18")),
        Expect("wdc twice", {"k": KP_WDC * 2}, FormatError, ("line 2", "duplicated day")),
        Expect("gfz short", {"k": INTERVAL + INTERVAL[:30]}, FormatError, ("line 2", "10 col")),
        Expect("gfz back", {"k": INTERVAL * 2}, FormatError, ("line 2", "time goes backwards")),
        Expect("days short", {"k": QUIET}, FormatError, ("line 3", "truncated", "ten quiet")),
        Expect("days 32", {"k": QUIET.replace(b"17   7", b"32   7") + b" 1 2 3 4"}, FormatError,
               ("line 3", "day 32", "31")),
        Expect("dst short", {"k": DST + DST[:90]}, FormatError, ("line 2", "truncated")),
        Expect("dst no number", {"k": DST.replace(b"  -9", b"  x9", 1)}, FormatError,
               ("line 1", "malformed")),
    ],
    ids=lambda case: case.id,
)  # fmt: skip
def test_a_bad_index_is_named(case: Expect, tmp_path: Path) -> None:
    for name, content in case.files.items():
        (tmp_path / name).write_bytes(content)
    with pytest.raises(case.error) as caught:
        ingest_index([tmp_path / name for name in case.files], params=IngestIndexParams())
    for words in case.says:
        assert words in str(caught.value)
