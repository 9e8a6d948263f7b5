"""Logs from the command line: what they hold, made into tracks once, truncated ones kept."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from logs import SECOND, START, drive, tesla

from magtiles.pipeline.main import main


def told(capsys: pytest.CaptureFixture[str], *arguments: object) -> Any:
    capsys.readouterr()
    assert main([*map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_info_lists_topics_with_rates_spans_and_first_values(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = drive().save(tmp_path / "drive.mcap")
    whole = told(capsys, "info", path)
    assert (whole["format"], whole["truncated_at_byte"]) == ("mcap", None)
    fix, mag = whole["topics"]
    assert (fix["topic"], fix["role"], fix["messages"]) == ("/gnss/fix", "fix", 4)
    assert (mag["schema"], mag["messages"]) == ("sensor_msgs/msg/MagneticField", 200)
    assert mag["rate_hz"] == pytest.approx(50.0)
    assert mag["start"] == "2023-11-14T22:13:20.003000000"
    assert [v["value"] for v in mag["first"]] == list(tesla(0))
    assert {v["unit"] for v in mag["first"]} == {"T"}
    assert [(v["value"], v["unit"]) for v in fix["first"]] == [
        (45.0, "deg"), (7.0, "deg"), (300.0, "m"),
    ]  # fmt: skip
    assert main(["info", str(path)]) == 0
    shown = capsys.readouterr().out
    assert "x 2e-05, y 0, z 4.5e-05 T" in shown
    assert "latitude 45 deg, longitude 7 deg, altitude 300 m" in shown
    assert f"magtiles run ingest-log --in files={path}" in shown


def test_info_of_a_truncated_and_of_a_foreign_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = drive().save(tmp_path / "drive.mcap")
    path.write_bytes(path.read_bytes()[:-3000])
    assert told(capsys, "info", path)["truncated_at_byte"] > 0
    path.write_bytes(b"\x89MCAP0\r\n\x06\x05" + bytes(12))
    assert main(["info", str(path)]) == 1
    assert "byte 8: the record cannot be read" in capsys.readouterr().err
    path.write_bytes(b"")
    assert main(["info", str(path)]) == 1
    assert "the file is empty" in capsys.readouterr().err


def test_a_log_is_converted_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drive().save(tmp_path / "drive.mcap")
    toml = tmp_path / "drive.toml"
    toml.write_text(
        '[source]\nid = "drive"\nkind = "track"\nfiles = ["drive.mcap"]\nlicence = "own"\n'
        '[log]\nsensor_to_body = "forward,left,up"\n'
    )
    run = ("run", "ingest-log", "--in", f"files={toml}", "--out", tmp_path / "track.nc")
    assert told(capsys, *run)["rebuilt"] is True
    assert told(capsys, *run)["rebuilt"] is False
    with xr.open_dataset(tmp_path / "track.nc", engine="netcdf4") as track:
        assert track.attrs["source"] == "drive"
        np.testing.assert_allclose(track["field_body"][0], tesla(0) * [1e9, -1e9, -1e9])
    bag = drive(201)
    bag.field(START + 9 * SECOND, tesla(0))
    bag.save(tmp_path / "drive.mcap")
    again = told(capsys, *run)
    assert again["rebuilt"] is True
    assert "drive.mcap" in again["reason"] or "input" in again["reason"]


def test_a_truncated_log_ends_well_and_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = drive().save(tmp_path / "drive.mcap")
    path.write_bytes(path.read_bytes()[:-5000])
    out = tmp_path / "track.nc"
    assert main(["run", "ingest-log", "--in", f"files={path}", "--out", str(out)]) == 0
    warning = capsys.readouterr().err
    assert "truncated after byte" in warning
    assert "messages, recorded until 2023-11-14T22:13:2" in warning
    assert out.exists()


def test_a_bad_log_leaves_nothing_behind(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = drive().save(tmp_path / "drive.mcap")
    data = bytearray(path.read_bytes())
    data[200] ^= 1
    path.write_bytes(data)
    out = tmp_path / "out" / "track.nc"
    out.parent.mkdir()
    assert main(["run", "ingest-log", "--in", f"files={path}", "--out", str(out)]) == 1
    assert f"magtiles: error: {path} byte " in capsys.readouterr().err
    assert list(out.parent.iterdir()) == []


def test_real_logs_are_shown(real_data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for path in sorted((real_data / "mcap_ros2").glob("*.mcap")):
        assert told(capsys, "info", path)["topics"]
    flight = told(capsys, "info", real_data / "ulog_px4" / "sample_log_small.ulg")
    topics = {topic["topic"]: topic for topic in flight["topics"]}
    assert topics["vehicle_magnetometer"]["rate_hz"] == pytest.approx(48.9, abs=0.1)
    assert topics["sensor_mag/1"]["first"][0] == {
        "name": "x", "value": pytest.approx(0.4262049), "unit": "gauss",
    }  # fmt: skip
