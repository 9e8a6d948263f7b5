"""Messages decoded by the column are what mcap_ros2 and protobuf decode one by one."""

from __future__ import annotations

import struct
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from logs import SCHEMAS, START, Bag, drive, header, location_fix_type, tesla, vector
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap_ros2._dynamic import generate_dynamic
from mcap_ros2.decoder import DecoderFactory

from magtiles.schemas.errors import FormatError
from magtiles.stages.ingest.log.cdr import CdrDecoder
from magtiles.stages.ingest.log.decoders import decoder
from magtiles.stages.ingest.log.mcap_file import McapFile
from magtiles.stages.ingest.log.protobuf_messages import ProtobufDecoder
from magtiles.stages.ingest.log.rosmsg import PRIMITIVES, leaves


def get(message: Any, path: str) -> Any:
    """What mcap_ros2 decoded at a path, array items by number."""
    return reduce(
        lambda value, part: value[int(part)] if part.isdigit() else getattr(value, part),
        path.split("."),
        message,
    )


def random_message(kind: str, rng: np.random.Generator) -> dict[str, Any]:
    """Any values, and frame names of any length so that alignment varies."""
    frame = "f" * int(rng.integers(0, 9))
    draw = rng.normal
    whole: dict[str, Any] = {"header": header(int(rng.integers(0, 2**60)), frame)}
    quaternion = vector(draw(size=4), "xyzw")
    twist = {"linear": vector(draw(size=3)), "angular": vector(draw(size=3))}
    return (
        whole
        | {
            "MagneticField": {
                "magnetic_field": vector(draw(size=3)),
                "magnetic_field_covariance": list(draw(size=9)),
            },
            "NavSatFix": {
                "status": {"status": int(rng.integers(-1, 3)), "service": 15},
                "latitude": draw(),
                "longitude": draw(),
                "altitude": draw(),
                "position_covariance": list(draw(size=9)),
                "position_covariance_type": int(rng.integers(0, 4)),
            },
            "Imu": {
                "orientation": quaternion,
                "orientation_covariance": list(draw(size=9)),
                "angular_velocity": vector(draw(size=3)),
                "angular_velocity_covariance": list(draw(size=9)),
                "linear_acceleration": vector(draw(size=3)),
                "linear_acceleration_covariance": list(draw(size=9)),
            },
            "Odometry": {
                "child_frame_id": "c" * int(rng.integers(0, 6)),
                "pose": {
                    "pose": {"position": vector(draw(size=3)), "orientation": quaternion},
                    "covariance": list(draw(size=36)),
                },
                "twist": {"twist": twist, "covariance": list(draw(size=36))},
            },
            "TwistStamped": {"twist": twist},
        }[kind.rpartition("/")[2]]
    )


@pytest.mark.parametrize("kind", SCHEMAS)
def test_every_number_of_every_known_type_is_that_of_mcap_ros2(kind: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    bag = Bag(chunk_size=8192)
    for row in range(100):
        bag.ros("/topic", kind, random_message(kind, rng), START + row)
    path = bag.save(tmp_path / "log.mcap")
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        expected = [decoded for *_, decoded in reader.iter_decoded_messages()]
    layout = leaves(kind, SCHEMAS[kind], where="here")
    paths = [leaf.path for leaf in layout if leaf.type in PRIMITIVES]
    log = McapFile(path)
    parts: dict[str, list[Any]] = {name: [] for name in paths}
    for batch in log.batches():
        decode = decoder(log.channels[1], log.schemas[1], paths, "here")
        for name, values in decode(batch.data, batch.start, batch.stop).items():
            parts[name].append(values)
    assert len(expected) == 100
    for name in paths:
        found = np.concatenate(parts[name])
        np.testing.assert_array_equal(found, [get(message, name) for message in expected])


@pytest.mark.parametrize("order", ["<", ">"])
def test_both_orders_of_bytes_strings_and_sequences(order: str) -> None:
    layout = leaves(
        "p/A",
        "uint8 a\nstring[] names\nfloat64[] many\nstring<=9 word\nint16[3] three\n"
        "string[2] pair\nuint32[<=4] few\nB[2] inner\nfloat64 last\n"
        + "=" * 80 + "\nMSG: p/B\nint64 b\n",
        where="here",
    )  # fmt: skip
    rng = np.random.default_rng(2)
    payloads, truth = [], []
    for row in range(50):
        names = ["n" * int(rng.integers(0, 5)) for _ in range(int(rng.integers(0, 4)))]
        many = rng.normal(size=int(rng.integers(0, 3)))
        few = rng.integers(0, 9, size=int(rng.integers(0, 5)))
        out = _Cdr(order)
        out.put("B", row)
        out.put("I", len(names))
        for name in names:
            out.text(name)
        out.put("I", many.size)
        for value in many:
            out.put("d", value)
        out.text("w" * (row % 7))
        for value in (row, -row, 7):
            out.put("h", value)
        out.text("left"), out.text("right" * (row % 3))
        out.put("I", few.size)
        for value in few:
            out.put("I", int(value))
        for value in (row * 10**12, -5):
            out.put("q", value)
        out.put("d", row / 3)
        payloads.append(out.data)
        truth.append(row)
    data = np.frombuffer(b"".join(payloads), dtype=np.uint8)
    stop = np.cumsum([len(p) for p in payloads])
    start = np.concatenate([[0], stop[:-1]])
    wanted = ["a", "three", "inner.0.b", "last"]
    found = CdrDecoder(layout, wanted, "here")(data, start, stop)
    rows = np.array(truth)
    np.testing.assert_array_equal(found["a"], rows)
    np.testing.assert_array_equal(found["three"], np.stack([rows, -rows, 0 * rows + 7], axis=1))
    np.testing.assert_array_equal(found["inner.0.b"], rows * 10**12)
    np.testing.assert_array_equal(found["last"], rows / 3)


class _Cdr:
    """Plain CDR, written one value at a time."""

    def __init__(self, order: str) -> None:
        self.order = order
        self.data = b"\0\1\0\0" if order == "<" else b"\0\0\0\0"

    def put(self, code: str, value: Any) -> None:
        size = struct.calcsize(code)
        self.data += bytes(-(len(self.data) - 4) % size) + struct.pack(self.order + code, value)

    def text(self, value: str) -> None:
        self.put("I", len(value) + 1)
        self.data += value.encode() + b"\0"


def test_real_containers_decode_as_mcap_ros2_decodes_them(real_data: Path) -> None:
    compared = 0
    for path in sorted((real_data / "mcap_ros2").glob("*.mcap")):
        log = McapFile(path)
        for batch in log.batches():
            for number in np.unique(batch.channel):
                schema = log.schemas[log.channels[number].schema_id]
                if "/msg/" not in schema.name and "/srv/" in schema.name:
                    continue
                layout = leaves(schema.name, schema.data.decode(), where=str(path))
                fixed = [f.path for f in layout if f.type in PRIMITIVES and f.count == 1]
                names = [name for name in fixed if not name.startswith("structure_")][:8]
                rows = batch.channel == number
                decode = CdrDecoder(layout, names[:3], str(path))
                columns = decode(batch.data, batch.start[rows], batch.stop[rows])
                one = generate_dynamic(schema.name, schema.data.decode())[schema.name]
                for row, (a, b) in enumerate(zip(batch.start[rows], batch.stop[rows], strict=True)):
                    message = one(batch.data[a:b].tobytes())
                    for name in names[:3]:
                        assert columns[name][row] == get(message, name)
                        compared += 1
    assert compared > 200


class Container(NamedTuple):
    how: dict[str, Any]
    id: str


@pytest.mark.parametrize(
    "case",
    [
        Container({"compression": CompressionType.NONE}, "uncompressed"),
        Container({"compression": CompressionType.LZ4}, "lz4"),
        Container({"compression": CompressionType.ZSTD}, "zstd"),
        Container({"options": {"use_chunking": False}}, "no chunks"),
        Container({"options": {"enable_data_crcs": True}}, "CRC of the data section"),
        Container({"options": {"repeat_channels": False, "use_statistics": False}}, "bare summary"),
    ],
    ids=lambda case: case.id,
)
def test_containers_hold_the_same_messages(case: Container, tmp_path: Path) -> None:
    path = drive(**case.how).save(tmp_path / "log.mcap")
    log = McapFile(path)
    rows = 0
    for batch in log.batches():
        of = batch.channel == next(n for n, c in log.channels.items() if c.topic == "/mag")
        decode = decoder(log.channels[1], log.schemas[1], ["magnetic_field.x"], "here")
        found = decode(batch.data, batch.start[of], batch.stop[of])["magnetic_field.x"]
        np.testing.assert_array_equal(found, [tesla(rows + i)[0] for i in range(found.size)])
        rows += found.size
    assert (rows, log.truncated) == (200, None)


def test_protobuf_is_decoded_as_its_own_file_describes_it() -> None:
    kind, schema = location_fix_type()
    messages = [
        kind(latitude=row / 7, position_covariance=[row] * 9).SerializeToString()
        for row in range(1, 6)
    ]
    data = np.frombuffer(b"".join(messages), dtype=np.uint8)
    stop = np.cumsum([len(m) for m in messages])
    start = np.concatenate([[0], stop[:-1]])
    decode = ProtobufDecoder(
        "foxglove.LocationFix", schema, ["latitude", "position_covariance"], "here"
    )
    found = decode(data, start, stop)
    np.testing.assert_array_equal(found["latitude"], np.arange(1, 6) / 7)
    assert found["position_covariance"].shape == (5, 9)
    with pytest.raises(FormatError, match="message 1 of its chunk: does not parse"):
        decode(data, start, stop - np.array([0, 3, 0, 0, 0]))
    with pytest.raises(FormatError, match="no field 'longtitude'"):
        ProtobufDecoder("foxglove.LocationFix", schema, ["longtitude"], "here")
    with pytest.raises(FormatError, match=r"does not describe 'foxglove\.Pose'"):
        ProtobufDecoder("foxglove.Pose", schema, ["x"], "here")


class Bad(NamedTuple):
    text: str
    says: str


@pytest.mark.parametrize(
    "case",
    [
        Bad("Thing x", "uses the type 'Thing'"),
        Bad("p/A again", "nests without end"),
        Bad("float64[3", "has the line"),
        Bad("B[9999] b\n" + "=" * 80 + "\nMSG: p/B\nint8[2] a\nint8 b\n", "nests without end"),
        Bad("int8 a\n" + "=" * 80 + "\nfloat64 b", "the schema's part starts with"),
    ],
    ids=lambda case: case.says,
)
def test_definitions_that_cannot_be_are_refused(case: Bad) -> None:
    with pytest.raises(FormatError, match=case.says):
        leaves("p/A", case.text, where="log.mcap topic /a")


def test_fields_behind_a_sequence_of_messages_are_refused_and_those_before_it_are_not() -> None:
    layout = leaves(
        "p/A", "int32 a\nB[] many\nint32 z\n" + "=" * 80 + "\nMSG: p/B\nint8 b\n", where="here"
    )
    data = np.frombuffer(b"\0\1\0\0" + struct.pack("<iIbxxxi", 7, 1, 1, 9), dtype=np.uint8)
    limits = np.array([0]), np.array([data.size])
    assert CdrDecoder(layout, ["a"], "here")(data, *limits)["a"].tolist() == [7]
    with pytest.raises(FormatError, match="'z' stands behind 'many'"):
        CdrDecoder(layout, ["z"], "here")(data, *limits)
