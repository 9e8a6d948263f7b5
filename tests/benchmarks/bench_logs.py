"""MCAP logs against mcap with mcap-ros2-support, in one process, all CRC checks on.

1,000,000 MagneticField messages from zstd chunks into arrays: at least 5 times as fast is asked,
with a peak of memory below 3 times the decoded columns (time and three components). Two logs: the
magnetometer alone, and one whose chunks hold fixes and frame names of varying length between.
"""

from __future__ import annotations

import statistics
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import xarray as xr
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_ros2.decoder import DecoderFactory

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "truth"))

from logs import MAGNETIC_FIELD, NAV_SAT_FIX, SECOND, START

from magtiles.stages.ingest.log.mcap_log import read_mcap
from magtiles.stages.ingest.log.raw import RawLog
from magtiles.stages.ingest.log.source import IngestLogParams
from magtiles.stages.ingest.log.stage import ingest_log

MESSAGES = 1_000_000
ROUNDS = 3


def write_log(path: Path, count: int, *, mixed: bool) -> None:
    """`count` magnetometer messages of noise; with `mixed`, a fix after every fiftieth."""
    rng = np.random.default_rng(0)
    field = rng.normal(0.0, 5e-5, (count, 3))
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD, enable_data_crcs=True)
        writer.start("ros2", "benchmark")
        kinds = [("sensor_msgs/msg/MagneticField", MAGNETIC_FIELD, "/mag")]
        kinds += [("sensor_msgs/msg/NavSatFix", NAV_SAT_FIX, "/fix")] if mixed else []
        channels = [
            writer.register_channel(
                topic, "cdr", writer.register_schema(name, "ros2msg", text.encode())
            )
            for name, text, topic in kinds
        ]
        for row in range(count):
            at = START + row * SECOND // 50
            name = "imu_link"[: 1 + row % 8] if mixed else "imu_link"
            head = headed(at, name)
            head += bytes(-(len(head) - 4) % 8)
            data = head + struct.pack("<12d", *field[row], *[0.0] * 9)
            writer.add_message(channels[0], at, data, at, row)
            if mixed and row % 50 == 0:
                fix = struct.pack("<bHxxxx12dB", 0, 1, 45.0, 7.0, 300.0, *[0.0] * 9, 0)
                writer.add_message(channels[1], at, headed(at, "gnss") + fix, at, row)
        writer.finish()


def headed(at: int, frame: str) -> bytes:
    """Encapsulation and std_msgs/Header."""
    text = frame.encode() + b"\0"
    return struct.pack("<4sIII", b"\0\1\0\0", at // SECOND, at % SECOND, len(text)) + text


def ours(path: Path) -> RawLog:
    """Columns, ready to become a track."""
    return read_mcap(path, IngestLogParams())


def theirs(path: Path) -> np.ndarray:
    """The same columns by one Python object a message."""
    rows = []
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for *_, message in reader.iter_decoded_messages(topics=["/mag"]):
            stamp, field = message.header.stamp, message.magnetic_field
            rows.append((stamp.sec * SECOND + stamp.nanosec, field.x, field.y, field.z))
    return np.array(rows)


def timed(work: object, path: Path) -> float:
    start = time.perf_counter()
    work(path)  # type: ignore[operator]
    return time.perf_counter() - start


def whole(path: Path) -> xr.Dataset:
    """The stage: a track with places."""
    return ingest_log([path], params=IngestLogParams())


def peak_of_a_child(work: str, path: Path, small: Path) -> tuple[float, float]:
    """Bytes that one reading adds to a process that has read a small log, and of its columns."""
    child = subprocess.run(
        [sys.executable, __file__, "--child", work, str(path), str(small)],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    added, columns = map(float, child.stdout.split())
    return added, columns


def report_peak(work: str, path: Path, small: Path) -> None:
    read = ours if work == "ours" else whole
    read(small)
    Path("/proc/self/clear_refs").write_text("5")  # forgets the peak of importing and compiling
    before = highest_resident_kb()
    log = read(path)
    added = 1024 * (highest_resident_kb() - before)
    if isinstance(log, xr.Dataset):
        print(added, log.nbytes)
    else:
        print(added, log.samples.time.nbytes + log.samples.values.nbytes)


def highest_resident_kb() -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))


def bench(folder: Path, *, mixed: bool) -> None:
    path, small = folder / "log.mcap", folder / "small.mcap"
    write_log(path, MESSAGES, mixed=mixed)
    write_log(small, 1000, mixed=mixed)
    expected, found = theirs(small), ours(small).samples
    assert (found.time.astype(np.int64) == expected[:, 0]).all()
    assert (found.values == expected[:, 1:]).all()
    pairs = [(timed(ours, path), timed(theirs, path)) for _ in range(ROUNDS)]
    ratio = statistics.median(b / a for a, b in pairs)
    mine, other = (statistics.median(side) for side in zip(*pairs, strict=True))
    print(
        f"{MESSAGES} messages{' between fixes' if mixed else ''}: {mine:.2f} s, mcap {other:.1f} s"
    )
    print(f"ratio {ratio:.1f} (asked: 5)")
    if sys.platform != "linux":
        print("peak of memory: measured on Linux only")
        return
    for work, made in (("ours", "columns"), ("whole", "the track of the whole stage")):
        added, columns = peak_of_a_child(work, path, small)
        print(f"peak {added / columns:.2f} times the {columns / 1e6:.0f} MB of {made} (asked: 3)")


if __name__ == "__main__":
    if "--child" in sys.argv:
        report_peak(sys.argv[2], *map(Path, sys.argv[3:5]))
    else:
        for is_mixed in (False, True):
            with tempfile.TemporaryDirectory() as name:
                bench(Path(name), mixed=is_mixed)
