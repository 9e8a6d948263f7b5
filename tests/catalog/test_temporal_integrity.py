"""A temporal.nc that is not what the manifest or the contract says must be refused."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import ppigrf
import pytest
from contract_tables import assert_tabulated
from synthetic_release import World
from tampering import (
    Bomb,
    Edit,
    Seal,
    assert_whole_or_refused,
    flipped_bits,
    forge,
    put,
    reseal,
    unwritten,
)
from temporal import temporal_dataset

from magtiles.catalog import open_release
from magtiles.catalog.releases.temporal_file import read_temporal
from magtiles.catalog.releases.temporal_table import (
    ALWAYS,
    BASELINE,
    DAYS,
    FOGM,
    SECONDS,
    TEMPORAL_VARIABLES,
)
from magtiles.schemas.errors import ContractError, IntegrityError
from magtiles.stages.release.temporal_file import write_temporal

COEFFICIENTS = Path(ppigrf.__file__).with_name("IGRF14.shc")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole") / "temporal.nc"
    write_temporal(temporal_dataset(), path)
    return path


@pytest.fixture(scope="module")
def folder(whole: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    extra = {"temporal.nc": whole, "core_field.shc": COEFFICIENTS}
    small = World(heights=(0.0, 1000.0))
    return small.publish(tmp_path_factory.mktemp("store"), extra_files=extra).path


def record(document: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = next(f for f in document["files"] if f["role"] == "temporal")
    return found


def test_no_flipped_bit_is_accepted(copy: Path) -> None:
    path = copy / "temporal.nc"
    data = path.read_bytes()
    accepted = 0
    for flipped in flipped_bits(data, 200):
        path.write_bytes(flipped)
        with contextlib.suppress(IntegrityError):
            _ = open_release(copy).temporal
            accepted += 1
    assert accepted == 0
    path.write_bytes(data)
    assert open_release(copy).temporal.observatories


def test_damaged_bytes_that_the_manifest_lists_are_an_error_or_whole(whole: Path) -> None:
    """Whatever a forged digest lets through is parsed or refused, never a crash."""
    data = whole.read_bytes()
    read = partial(read_temporal, where="temporal.nc")
    # Measured: 101 of 150; the rest is padding and long names.
    assert assert_whole_or_refused(read, data, 150) > 50


SEALS = [
    Seal(lambda d: record(d).update(path="t.nc"), "temporal model elsewhere", "another path"),
    Seal(lambda d: record(d).pop("array_digest"), "array_digest is missing", "no array digest"),
    Seal(lambda d: record(d).update(row=1), "row is unknown", "a tile's key"),
    Seal(lambda d: record(d).update(role="preview") or record_gone(d), "elsewhere", "other role"),
    Seal(lambda d: d["files"].append(dict(record(d))), "name a path twice", "twice"),
    Seal(lambda d: record(d).update(size=5 << 30), "size is 5368709120", "oversize"),
    Seal(lambda d: record(d).update(size=record(d)["size"] - 1), "as in manifest", "smaller"),
]


def record_gone(document: dict[str, Any]) -> None:
    for file in document["files"]:
        if file["path"] == "temporal.nc":
            file.pop("array_digest")


@pytest.mark.parametrize("case", SEALS, ids=lambda c: c.id)
def test_a_manifest_that_misplaces_it_is_refused(copy: Path, case: Seal) -> None:
    reseal(copy, case.change)
    with pytest.raises(IntegrityError, match=case.message):
        open_release(copy)


def grow(name: str, **options: Any) -> Callable[[Any], Any]:
    def edit(file: Any) -> None:
        file.createVariable(name, "f4", ("class",), **options)

    return edit


EDITS = [
    Edit(lambda f: f.setncattr("contract", "anomaly-tile/1.0.0"), "attribute contract", "other"),
    Edit(lambda f: f.delncattr("contract"), "contract is None", "no contract"),
    Edit(grow("payload"), "holds payload", "foreign variable"),
    Edit(lambda f: f.createGroup("hidden"), "holds hidden", "a group"),
    Edit(lambda f: f.renameVariable("class_tau", "class_tau_low"), "no variable class_tau", "part"),
    Edit(lambda f: f.renameVariable("kp", "tau_about_mean"), "no variable kp", "no Kp"),
    Edit(lambda f: f.renameDimension("class", "kind"), "dimension kind is 4", "dimension"),
    Edit(lambda f: f["sigma"].setncattr("units", "gauss"), "sigma has units 'gauss'", "units"),
    Edit(put("element", "up"), "other elements", "elements"),
    Edit(put("iaga_code", "SOU"), "each once", "one code twice"),
    Edit(put("iaga_code", "../x"), "each once", "no code"),
    Edit(put("latitude", 91.0), "latitude holds 91", "latitude"),
    Edit(put("dip_latitude", np.nan), "dip_latitude holds nan", "no dip latitude"),
    Edit(put("month", 1_900_000_000), "month does not ascend", "months"),
    Edit(put("segment_start", -(2**62)), "segment_start holds", "before time"),
    Edit(put("minute", 700.0), "minute is no day", "minutes"),
    Edit(put("baseline", np.inf, (0, 0, 0, 5)), "baseline holds inf", "infinite baseline"),
    Edit(put("class_sigma", -1.0, (0, 0, 0)), "class_sigma holds -1", "negative sigma"),
    Edit(put("class_kp", 7), "class_kp holds 7", "class"),
]


@pytest.mark.parametrize("case", EDITS, ids=lambda c: c.id)
def test_a_listed_file_that_breaks_the_contract_is_refused(copy: Path, case: Edit) -> None:
    told = forge(copy / "temporal.nc", case.edit)
    reseal(copy, lambda d: record(d).update(told))
    with pytest.raises(IntegrityError, match=case.message) as caught:
        _ = open_release(copy).temporal
    assert "temporal.nc" in str(caught.value)


def rebuilt(tmp_path: Path, sizes: dict[str, int], **options: Any) -> bytes:
    """A file of the right names with dimensions of other sizes, nothing written in it."""
    sizes = {"observatory": 1, "element": 4, "class": 1, "segment": 1, **sizes}
    rules = {name: TEMPORAL_VARIABLES[name] for name in (*ALWAYS, *FOGM)}
    return unwritten(tmp_path / "bomb.nc", "temporal-model/1.0.0", sizes, rules, **options)


BOMBS = [
    Bomb({"segment": 9_000_000}, {"zlib": True}, "declares .* bytes of arrays", "never written"),
    Bomb({"segment": 2_000_000_000}, {"zlib": True}, "dimension segment", "too many"),
    Bomb({"element": 3}, {"zlib": True}, "other elements", "three elements"),
    Bomb({}, {"contiguous": True}, "stored contiguously", "data that may lie elsewhere"),
]


@pytest.mark.parametrize("case", BOMBS, ids=lambda c: c.id)
def test_sizes_and_storage_are_checked_before_anything_is_read(tmp_path: Path, case: Bomb) -> None:
    with pytest.raises(IntegrityError, match=case.message):
        read_temporal(rebuilt(tmp_path, case.sizes, **case.options), "temporal.nc")


def test_a_variable_without_a_place_is_not_published(tmp_path: Path) -> None:
    dataset = temporal_dataset()
    dataset["skill"] = ("observatory", np.ones(2))
    with pytest.raises(ContractError, match="variable skill has no place"):
        write_temporal(dataset, tmp_path / "t.nc")
    assert not list(tmp_path.iterdir())


def test_the_same_dataset_gives_the_same_bytes(whole: Path, tmp_path: Path) -> None:
    write_temporal(temporal_dataset(), tmp_path / "again.nc")
    assert (tmp_path / "again.nc").read_bytes() == whole.read_bytes()


def test_the_table_is_the_contract() -> None:
    """Dimensions, dtypes and units of the reader's table are those of temporal-model/1."""
    schema = assert_tabulated("temporal-model/1", TEMPORAL_VARIABLES, [SECONDS, DAYS])
    assert set(TEMPORAL_VARIABLES) == set(schema["properties"])
    assert set(schema["required"]) == set(ALWAYS)
    groups = [set(choice["required"]) for choice in schema["anyOf"]]
    assert groups == [set(BASELINE), set(FOGM)]
