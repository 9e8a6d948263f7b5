"""What ``magtiles info`` prints of a stage's artifact: contract, stage, attributes, variables."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from magtiles.pipeline.output import print_json, print_table

if TYPE_CHECKING:
    import xarray as xr

_SIGNATURE = b"\x89HDF\r\n\x1a\n"


def run(path: Path, *, as_json: bool) -> bool:
    """Print what an artifact holds; False, and nothing, for a file that is none.

    Raises FormatError for a damaged file.
    """
    with path.open("rb") as file:
        if file.read(len(_SIGNATURE)) != _SIGNATURE:
            return False
    try:
        from magtiles.pipeline.artifacts import open_artifact
    except ModuleNotFoundError:
        return False  # as of a log, whose message names the extra
    with open_artifact(path) as dataset:
        if "contract" not in dataset.attrs:
            return False
        described = describe(dataset, path)
    if as_json:
        print_json(described)
    else:
        _print(described)
    return True


def describe(dataset: xr.Dataset, path: Path) -> dict[str, Any]:
    """Contract, stage and parameters by the receipt, attributes, variables with their ranges."""
    from magtiles.pipeline.receipts import read_receipt

    receipt = read_receipt(path) or {}
    return {
        "contract": dataset.attrs["contract"],
        "stage": receipt.get("stage"),
        "params": receipt.get("params"),
        "sizes": {str(name): size for name, size in dataset.sizes.items()},
        "attributes": {k: v for k, v in sorted(dataset.attrs.items()) if k != "contract"},
        "variables": {str(n): _variable(dataset[n]) for n in sorted(map(str, dataset.variables))},
    }


def _variable(array: xr.DataArray) -> dict[str, Any]:
    values = array.values
    missing = np.isnan(values) if values.dtype.kind in "fM" else np.zeros(values.shape, np.bool_)
    known = values[~missing]
    ranged = known.size > 0 and known.dtype.kind in "fiuM"
    return {
        "dims": list(map(str, array.dims)),
        "dtype": str(values.dtype),
        "units": array.attrs.get("units"),
        "minimum": _plain(known.min()) if ranged else None,
        "maximum": _plain(known.max()) if ranged else None,
        "missing": int(missing.sum()),
    }


def _plain(value: Any) -> Any:
    if isinstance(value, np.datetime64):
        return str(value.astype("datetime64[s]"))
    return value.item()


def _print(about: dict[str, Any]) -> None:
    sizes = ", ".join(f"{name} {size}" for name, size in about["sizes"].items())
    made = {"stage": about["stage"]} if about["stage"] else {}
    lines = {"contract": about["contract"], **made, "sizes": sizes, **about["attributes"]}
    width = max(map(len, lines)) + 2
    for key, value in lines.items():
        print(f"{key:<{width}}{value}")
    print()
    rows = [
        (
            name,
            "(" + ", ".join(v["dims"]) + ")",
            v["units"] or "-",
            _cell(v["minimum"]),
            _cell(v["maximum"]),
            str(v["missing"]),
        )
        for name, v in about["variables"].items()
    ]
    print_table(("variable", "dimensions", "unit", "least", "greatest", "missing"), rows)


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return value if isinstance(value, str) else f"{value:.6g}"
