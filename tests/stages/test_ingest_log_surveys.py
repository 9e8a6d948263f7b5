"""ASEG-GDF2 and the trackline formats, written here by their layouts and read back."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import xarray as xr

from magtiles.catalog.flags import TrackFlag
from magtiles.schemas import contracts
from magtiles.schemas.errors import FormatError, MagtilesError, SourceError
from magtiles.stages.declare import parse_params
from magtiles.stages.ingest.log.aseg import read_definitions
from magtiles.stages.ingest.log.source import IngestLogParams
from magtiles.stages.ingest.log.stage import ingest_log

DEFINITIONS = """DEFN   ST=RECD,RT=COMM;RT:A4;COMMENTS:A80
DEFN 1 ST=RECD,RT=DATA;RT:A4;LINE:I8
DEFN 2 ST=RECD,RT=DATA;DATE:A8
DEFN 3 ST=RECD,RT=;TIME:F10.1:UNIT=s,NULL=-999.9,NAME=UTC, seconds: past midnight
DEFN 4 ST=RECD,RT=;LAT:F12.6:UNITS=degrees;LON:F12.6:UNIT=degrees
DEFN 5 ST=RECD,RT=;HT:F8.2:UNIT=m:NULL=-999.99,NAME=height
DEFN 6 ST=RECD,RT=;MAG:D14.6:UNIT=nT,NULL=-99999.999
DEFN 7 ST=RECD,RT=;WIN:3F6.1:NULL=-9.9
DEFN 8 ST=RECD,RT=;END DEFN
"""
COLUMNS = {
    "time": "TIME", "date": "DATE", "latitude": "LAT", "longitude": "LON", "height": "HT",
    "field_total": "MAG", "line": "LINE", "source": {"window": "WIN[2]"},
}  # fmt: skip


def row(
    second: float, mag: str = "4.8000500D+04", *, kind: str = "DATA", window: float = 1.5
) -> str:
    return (
        f"{kind}{101:8d}20100203{second:10.1f}{-30.5:12.6f}{142.25:12.6f}{120.5:8.2f}"
        f"{mag:>14s}{0.5:6.1f}{window:6.1f}{2.5:6.1f}"
    )


def ingest(*files: Path, **params: Any) -> xr.Dataset:
    track = ingest_log(files, params=parse_params(IngestLogParams, params, where="parameters"))
    contracts.check(track, "track/1")
    return track


def survey(folder: Path, rows: list[str], definitions: str = DEFINITIONS) -> xr.Dataset:
    (folder / "a.dfn").write_text(definitions)
    (folder / "a.dat").write_text("\n".join(rows) + "\n")
    return ingest(
        folder / "a.dat", folder / "a.dfn", height_reference="ellipsoid", columns=COLUMNS,
        column_units={"WIN[2]": "fT"},
    )  # fmt: skip


def test_fixed_widths_units_repeats_and_nulls(tmp_path: Path) -> None:
    rows = [row(3600.5), row(3601.5, "-99999.999"), row(3602.5, window=-9.9), row(-999.9)]
    track = survey(tmp_path, ["COMM a note", *rows])
    assert track.sizes["time"] == 3  # the last has no time
    assert track["time"].values[0] == np.datetime64("2010-02-03T01:00:00.5", "ns")
    np.testing.assert_array_equal(track["field_total"], [48000.5, np.nan, 48000.5])
    np.testing.assert_array_equal(track["source_window"], [1.5, 1.5, np.nan])
    np.testing.assert_array_equal(track["line"], [101] * 3)
    assert track["quality_flag"].values.tolist() == [0, TrackFlag.FIELD_GAP, 0]


def test_definitions_hold_what_they_say(tmp_path: Path) -> None:
    (tmp_path / "a.dfn").write_text(DEFINITIONS)
    found = {column.name: column for column in read_definitions(tmp_path / "a.dfn")}
    assert [*found][:7] == ["RT", "LINE", "DATE", "TIME", "LAT", "LON", "HT"]
    assert [name for name in found if name.startswith("WIN")] == ["WIN[1]", "WIN[2]", "WIN[3]"]
    assert (found["TIME"].unit, found["TIME"].null) == ("s", "-999.9")
    assert (found["HT"].unit, found["LAT"].unit, found["LINE"].unit) == ("m", "degrees", None)


def test_rows_without_the_record_type_that_is_defined(tmp_path: Path) -> None:
    track = survey(tmp_path, [row(1.0, kind=""), row(2.0, kind="")])
    np.testing.assert_array_equal(track["line"], [101, 101])


def test_the_same_values_between_tabs(tmp_path: Path) -> None:
    fields = [
        "101",
        "20100203",
        "3600.5",
        "-30.5",
        "142.25",
        "120.5",
        "48000.5",
        "0.5",
        "1.5",
        "2.5",
    ]
    fixed = survey(tmp_path, [row(3600.5)])
    xr.testing.assert_equal(survey(tmp_path, ["\t".join(fields)]), fixed)


class Bad(NamedTuple):
    rows: list[str]
    definitions: str
    error: type[MagtilesError]
    message: str
    id: str


BAD = [
    Bad([row(1), row(2)[:40], row(3)], DEFINITIONS, FormatError,
        "a.dat line 2: the line is truncated: 40 bytes; expected 94 bytes", "truncated line"),
    Bad([row(1), row(2, "4.8OOO500D+04")], DEFINITIONS, FormatError,
        "a.dat line 2: column 'MAG' holds '4.8OOO500D+04'; expected a number of 14", "letters"),
    Bad([row(1)], DEFINITIONS.replace("F10.1", "Z10.1"), FormatError,
        "a.dfn line 4: the format of 'TIME' is 'Z10.1", "no Fortran"),
    Bad([row(1)], "", FormatError, "a.dfn: the file is empty", "empty definitions"),
    Bad([row(1)], "<html>\n", FormatError, "a.dfn line 1: holds '<html>'; expected DEFN", "HTML"),
    Bad([row(1)], DEFINITIONS.splitlines()[0], FormatError, "a.dfn: defines no columns", "none"),
    Bad(["COMM only"], DEFINITIONS, FormatError, "a.dat: holds no rows of data", "no rows"),
    Bad([""], DEFINITIONS, FormatError, "a.dat: holds no lines", "blank"),
    Bad([row(1)], DEFINITIONS.replace("MAG:D14.6:UNIT=nT,", "MAG:D14.6:"), SourceError,
        "a.dat: the unit of column 'MAG' is not known; state it: column_units", "unit unknown"),
    Bad([row(1)], DEFINITIONS.replace("MAG:D14.6:", "TMI:D14.6:"), SourceError,
        "key 'columns.field_total' names the column 'MAG', which is missing", "column missing"),
    Bad([row(1)], DEFINITIONS.replace("NULL=-999.9,", "NULL=none,"), SourceError,
        "the NULL of column 'TIME' is 'none'", "null"),
]  # fmt: skip


@pytest.mark.parametrize("case", [pytest.param(b, id=b.id) for b in BAD])
def test_bad_surveys_say_where_and_why(tmp_path: Path, case: Bad) -> None:
    with pytest.raises(case.error) as caught:
        survey(tmp_path, case.rows, case.definitions)
    assert case.message in str(caught.value)


def test_a_contradiction_with_the_definition_is_an_error(tmp_path: Path) -> None:
    survey(tmp_path, [row(1)])
    files = tmp_path / "a.dat", tmp_path / "a.dfn"
    for params, message in (
        (
            {"column_units": {"MAG": "gauss", "WIN[2]": "fT"}},
            "'gauss' of column 'MAG'; expected 'nT'",
        ),
        ({"time_unit": "h", "column_units": {"WIN[2]": "fT"}}, "'time_unit' is 'h'; expected 's'"),
    ):
        with pytest.raises(SourceError) as caught:
            ingest(*files, height_reference="ellipsoid", columns=COLUMNS, **params)
        assert message in str(caught.value)


def test_data_alone_ask_for_their_definitions(tmp_path: Path) -> None:
    survey(tmp_path, [row(1)])
    with pytest.raises(FormatError, match=r"text of an unknown kind.*needs its \.dfn file"):
        ingest(tmp_path / "a.dat", columns=COLUMNS)


def mgd77(
    when: str, latitude: str = "+4512345", longitude: str = "-00998765", *, total: str = "481234",
    kind: str = "5", zone: str = "+00", residual: str = "-00123", depth: str = "+00012",
) -> str:  # fmt: skip
    """A data record, by byte positions: 1 type, 2-9 id, 10-12 zone, 13-27 time, 28-44 place, ..."""
    record = (
        f"{kind}TESTID  {zone}{when}{latitude}{longitude}1" + "012345" + "054321" + "99" + "1"
        f"{total}999999{residual}1+9999{depth}9999999+99999+9999" + "99999" + "999999" + "5"
    )
    assert len(record) == 120
    return record


def test_mgd77_records(tmp_path: Path) -> None:
    header = [f"{'4' if n == 1 else '':<78s}{n:02d}" for n in range(1, 25)]
    rows = [
        mgd77("199907152359500"),  # 23:59 and a half
        mgd77("199907152359500", zone="-01"),  # an hour to take off
        mgd77("199907160100000", total="999999"),
        mgd77("199907160101000", latitude="+9999999"),
    ]
    path = tmp_path / "a.mgd77"
    path.write_text("\n".join([*header, *rows]) + "\n")
    track = ingest(path, undulation_m=10.0, columns={"source": {"residual": "MAG_RES"}})
    np.testing.assert_array_equal(
        track["time"].values.astype("datetime64[s]").astype(str),
        [
            "1999-07-15T22:59:30",
            "1999-07-15T23:59:30",
            "1999-07-16T01:00:00",
            "1999-07-16T01:01:00",
        ],
    )
    np.testing.assert_allclose(track["latitude"], [45.12345] * 3 + [np.nan], rtol=1e-12)
    np.testing.assert_allclose(track["longitude"], -9.98765, rtol=1e-12)
    np.testing.assert_allclose(track["field_total"], [48123.4, 48123.4, np.nan, 48123.4])
    np.testing.assert_allclose(track["source_residual"], -12.3)
    np.testing.assert_array_equal(track["height"], -12.0)  # towed
    assert track.attrs["height_reference"] == "mean_sea_level"
    assert track["quality_flag"].values.tolist() == [
        0, TrackFlag.CLOCK_STEP, TrackFlag.FIELD_GAP, TrackFlag.NO_FIX,
    ]  # fmt: skip


def test_mgd77_records_from_before_2000(tmp_path: Path) -> None:
    """Type 3: the zone has two decimals and the year two digits; 1999 is no mark of missing."""
    rows = [mgd77("99" + "0715" + "2359500", kind="3", zone="+0050")]
    (tmp_path / "a.mgd77").write_text(rows[0] + "\n")
    track = ingest(tmp_path / "a.mgd77")
    assert str(track["time"].values[0])[:19] == "1999-07-16T00:29:30"


def test_mgd77_truncated_and_mistaken_records_have_their_number(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path, good = tmp_path / "a.mgd77", mgd77("199907152359500")
    path.write_text("\n".join([good, good[:70], good]))
    with pytest.raises(FormatError, match="line 2: the line is truncated: 70 bytes"):
        ingest(path)
    path.write_text("\n".join([good, good.replace("481234", "48I234")]))
    with pytest.raises(FormatError, match="line 2: bytes 61 to 66 hold '48I234'"):
        ingest(path)
    path.write_text("\n".join([good, "7" + good[1:]]))
    with pytest.raises(FormatError, match="line 2: a record of type '7'"):
        ingest(path)
    path.write_text("\n".join([good, good[:70]]))
    assert ingest(path).sizes["time"] == 1
    assert "truncated: line 2 has 70 bytes of 120 bytes; kept 1 lines before it" in caplog.text


NAMES = (
    "SURVEY_ID TIMEZONE DATE TIME LAT LON POS_TYPE NAV_QUALCO BAT_TTIME CORR_DEPTH BAT_CPCO "
    "BAT_TYPCO BAT_QUALCO MAG_TOT MAG_TOT2 MAG_RES MAG_RESSEN MAG_DICORR MAG_SDEPTH MAG_QUALCO "
    "GRA_OBS EOTVOS FREEAIR GRA_QUALCO LINEID POINTID"
)
MGD77T = NAMES.split(" ")


def mgd77t(**values: str) -> str:
    return "\t".join(values.get(name, "") for name in MGD77T)


def test_mgd77t_rows(tmp_path: Path) -> None:
    place = {"SURVEY_ID": "X1", "TIMEZONE": "-1", "LAT": "45.5", "LON": "-170.25", "LINEID": "A7"}
    rows = [
        mgd77t(DATE="19720530", TIME="2359.6667", MAG_TOT="48123.4", MAG_RES="-3", **place),
        mgd77t(DATE="19720531", TIME="0005", MAG_SDEPTH="-300", **place),
    ]
    (tmp_path / "a.m77t").write_text("\n".join(["\t".join(MGD77T), *rows]) + "\n")
    track = ingest(tmp_path / "a.m77t", columns={"source": {"residual": "MAG_RES"}})
    np.testing.assert_array_equal(
        track["time"].values.astype("datetime64[s]").astype(str),
        ["1972-05-30T22:59:40", "1972-05-30T23:05:00"],
    )
    np.testing.assert_array_equal(track["field_total"], [48123.4, np.nan])
    np.testing.assert_array_equal(track["height"], [np.nan, 300.0])  # an aircraft's
    assert track["line"].values.tolist() == ["A7", "A7"]


TRACKLINE = ",SURVEY_ID,LAT,LON,MAG_TOT,MAG_RES\n"


def test_the_zone_of_the_trackline_service_means_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(TRACKLINE + "2000-07-16 12:35:00-12:00,X1,46.5,-46.6,50395.0,-10.0\n")
    track = ingest(path, height_m=0.0, columns={"source": {"residual": "MAG_RES"}})
    assert str(track["time"].values[0])[:19] == "2000-07-16T12:35:00"
    assert track["field_total"].values[0] == 50395.0
    with pytest.raises(SourceError, match="no column holds the height"):
        ingest(path)
    path.write_text(TRACKLINE + "16 July,X1,46.5,-46.6,50395.0,-10.0\n")
    with pytest.raises(FormatError, match="line 2: the first column holds '16 July'"):
        ingest(path, height_m=0.0)
