"""What errors say, and that they reach other processes whole."""

from __future__ import annotations

import pickle
from dataclasses import dataclass

import pytest

from magtiles.schemas import errors
from magtiles.schemas.errors import FormatError, MagtilesError

KINDS = [
    kind
    for kind in vars(errors).values()
    if isinstance(kind, type) and issubclass(kind, MagtilesError)
]


@dataclass(frozen=True)
class Expect:
    parts: dict[str, str]
    text: str
    id: str


@pytest.mark.parametrize(
    "expect",
    [
        Expect({}, "is empty", "what"),
        Expect({"where": "a.tif"}, "a.tif: is empty", "where"),
        Expect({"expected": "a grid"}, "is empty; expected a grid", "expected"),
        Expect({"remedy": "fetch it"}, "is empty; fetch it", "remedy"),
        Expect(
            {"where": "a.tif byte 0", "expected": "a grid", "remedy": "fetch it"},
            "a.tif byte 0: is empty; expected a grid; fetch it",
            "all",
        ),
    ],
    ids=lambda expect: expect.id,
)
def test_message_says_where_what_expected_and_remedy(expect: Expect) -> None:
    assert str(FormatError("is empty", **expect.parts)) == expect.text


def test_there_is_one_tree() -> None:
    assert len(KINDS) >= 10
    for kind in KINDS:
        assert issubclass(kind, MagtilesError)
        assert kind.__doc__


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_errors_pass_between_processes(kind: type[MagtilesError]) -> None:
    """A pool of processes pickles what a worker raises; keyword-only arguments must survive."""
    error = kind("is empty", where="a.tif", expected="a grid", remedy="fetch it")
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is kind
    assert str(copy) == str(error)
    assert (copy.what, copy.where) == ("is empty", "a.tif")
