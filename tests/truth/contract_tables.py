"""A reader's table of variables against the schema of the contract it reads."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from magtiles.schemas import contracts


def assert_tabulated(
    contract: str, table: Mapping[str, Any], times: Collection[str]
) -> dict[str, Any]:
    """Dimensions, dtypes and units are the schema's, of times in one of the units `times`.

    Gives what the schema says of variables.
    """
    schema: dict[str, Any] = contracts.load_schema(contract)["properties"]["variables"]
    for name, variable in schema["properties"].items():
        rule, stated = table[name], variable["properties"]
        assert stated["dims"]["enum"] == [list(rule.dims)], name
        dtype = stated.get("dtype", {"const": "str"})
        kinds = tuple(dtype.get("enum", [dtype.get("const")]))
        if kinds == ("datetime64[ns]",):
            assert rule.units in times
        else:
            assert kinds == rule.dtypes, name
            assert stated.get("units", {"const": None})["const"] == rule.units, name
    return schema
