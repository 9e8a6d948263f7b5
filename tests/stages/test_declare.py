"""Parameters from plain values: what is wrong, in which table, in the words of TOML."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import pytest

from magtiles.schemas.errors import ParameterError, SourceError, UsageError
from magtiles.stages.declare import Params, parse_params, quantity


class Inner(Params):
    depth_m: float = quantity("m", gt=0, doc="How deep.")
    names: tuple[str, ...] = quantity("1", default=(), doc="Some names.")


class Outer(Params):
    inner: Inner = quantity("1", doc="A table.")
    other: Inner | None = quantity("1", default=None, doc="Another table.")
    pair: tuple[float, float] = quantity("km", default=(1.0, 2.0), doc="Two lengths.")
    code: str = quantity("1", default="a", pattern="^[a-z]+$", doc="A code, such as abc.")
    kind: Literal["one", "two"] = quantity("1", default="one", doc="One of two.")
    whether: bool = quantity("1", default=False, doc="Yes or no.")
    lookup: dict[str, str] = quantity("1", default={}, doc="Texts by name.")


_GOOD: dict[str, Any] = {"inner": {"depth_m": 1.0}}
_OUTER = "code, inner, kind, lookup, other, pair, whether"


@dataclass(frozen=True)
class Expect:
    values: dict[str, Any]
    message: str
    id: str


_CASES = [
    Expect(
        {"depth_m": 1.0},
        f"unknown key 'depth_m'; expected one of {_OUTER}; correct or remove it",
        "unknown in the outer table",
    ),
    Expect(
        {"inner": {"deep_m": 1.0}},
        "unknown key 'inner.deep_m'; expected one of depth_m, names; correct or remove it",
        "unknown in an inner table, before what is missing",
    ),
    Expect(
        {"other": {"depth_m": 1.0, "x": 1}},
        "unknown key 'other.x'; expected one of depth_m, names; correct or remove it",
        "unknown in an optional table",
    ),
    Expect(
        {"inner": {}},
        "key 'inner.depth_m' is missing (How deep.); add inner.depth_m = ...",
        "missing in an inner table",
    ),
    Expect(
        {"inner": {"depth_m": float("nan")}},
        "key 'inner.depth_m' is nan; expected a finite number",
        "nan",
    ),
    Expect({"inner": {"depth_m": -1}}, "key 'inner.depth_m' is -1; expected greater than 0", "low"),
    Expect({"inner": {"depth_m": "1"}}, "key 'inner.depth_m' is '1'; expected a valid num", "text"),
    Expect({"inner": {"depth_m": True}}, "key 'inner.depth_m' is True; expected a valid", "bool"),
    Expect({"inner": 5}, "key 'inner' is 5; expected a table", "no table"),
    Expect({"lookup": 5}, "key 'lookup' is 5; expected a table", "no table of texts"),
    Expect({"pair": 5}, "key 'pair' is 5; expected a list", "no list"),
    Expect(
        {"pair": [1.0]}, "key 'pair' is [1.0]; expected a list of another length (Two", "short list"
    ),
    Expect(
        {"pair": [1, 2, 3]}, "key 'pair' is [1, 2, 3]; expected a list of another length", "long"
    ),
    Expect(
        {"pair": [1.0, float("inf")]}, "key 'pair[1]' is inf; expected a finite number", "item inf"
    ),
    Expect(
        {"inner": {"depth_m": 1.0, "names": ["a", 2]}},
        "key 'inner.names[1]' is 2; expected a valid string",
        "item of an inner list",
    ),
    Expect(
        {"code": "A b"},
        "key 'code' is 'A b'; expected text that matches ^[a-z]+$ (A code, such as abc.)",
        "pattern",
    ),
    Expect({"kind": "three"}, "key 'kind' is 'three'; expected 'one' or 'two'", "choice"),
    Expect({"whether": 1}, "key 'whether' is 1; expected true or false", "number for bool"),
]


@pytest.mark.parametrize("expect", _CASES, ids=lambda expect: expect.id)
def test_message(expect: Expect) -> None:
    with pytest.raises(ParameterError) as caught:
        parse_params(Outer, _GOOD | expect.values, where="a.toml")
    assert str(caught.value).startswith(f"a.toml: {expect.message}")


def test_lists_become_tuples_and_integers_serve_as_floats() -> None:
    parsed = parse_params(Outer, _GOOD | {"pair": [1, 2.5]}, where="a.toml")
    assert parsed.pair == (1.0, 2.5)
    assert isinstance(parsed.pair[0], float)


@pytest.mark.parametrize("error", [SourceError, UsageError])
def test_the_caller_chooses_the_kind_of_error(error: type[Exception]) -> None:
    with pytest.raises(error):
        parse_params(Outer, {}, where="a.toml", error=error)  # type: ignore[arg-type]


def test_parameters_do_not_change() -> None:
    parsed = parse_params(Inner, {"depth_m": 1.0}, where="a.toml")
    with pytest.raises(ValueError, match="frozen"):
        parsed.depth_m = 2.0
