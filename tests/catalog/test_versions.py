from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from magtiles.catalog.releases.digest import canonical_json, manifest_digest
from magtiles.catalog.releases.manifest import Manifest, parse_manifest
from magtiles.catalog.releases.versions import (
    check_same,
    check_successor,
    parse_version,
    required_bump,
)
from magtiles.schemas.errors import VersionError


@pytest.fixture(scope="module")
def document(folder: Path) -> dict[str, Any]:
    plain: dict[str, Any] = json.loads((folder / "manifest.json").read_bytes())
    return plain


def edited(document: dict[str, Any], change: Callable[[dict[str, Any]], Any]) -> Manifest:
    plain = copy.deepcopy(document)
    change(plain)
    plain["manifest_digest"] = manifest_digest(plain)
    return parse_manifest(canonical_json(plain))


def version(document: dict[str, Any], number: str, change: Any = None) -> Manifest:
    def both(plain: dict[str, Any]) -> None:
        plain["version"] = number
        if change is not None:
            change(plain)

    return edited(document, both)


def new_arrays(d: dict[str, Any]) -> None:
    d["files"][4]["array_digest"] = "1" * 64


def add_core_field(d: dict[str, Any]) -> None:
    d["files"].append(
        {"path": "core_field.shc", "size": 1, "sha256": "2" * 64, "role": "core_field"}
    )


def add_temporal(d: dict[str, Any], digest: str = "3" * 64, sha256: str = "4" * 64) -> None:
    d["files"].append(
        {"path": "temporal.nc", "size": 1, "sha256": sha256, "role": "temporal",
         "contract": "temporal-model/1.0.0", "array_digest": digest}
    )  # fmt: skip


class Expect(NamedTuple):
    change: Callable[[dict[str, Any]], Any]
    bump: str | None
    reason: str
    id: str


CASES = [
    Expect(lambda d: None, None, "nothing changed", "same"),
    Expect(lambda d: d.update(magtiles="9", created="2020"), None, "nothing", "another builder"),
    Expect(lambda d: d["identity"].update(reference_field="X"), "major", "reference_f", "field"),
    Expect(lambda d: d["identity"]["units"].update(gradient_nn="pT m-1"), "major", "units", "unit"),
    Expect(lambda d: d.update(height_reference="terrain"), "major", "height_reference", "height"),
    Expect(lambda d: d["lattice"].update(south=44.001), "major", "the grid", "shifted grid"),
    Expect(
        lambda d: d["lattice"].update(longitude_spacing=0.01250001), "major", "the grid", "spacing"
    ),
    Expect(lambda d: d["lattice"].update(south=44.009), "minor", "the coverage", "moved by a cell"),
    Expect(lambda d: d["lattice"].update(rows=45), "minor", "the coverage", "smaller"),
    Expect(lambda d: d.update(heights_m=[0, 1000, 2000, 4000, 8001]), "minor", "heights", "level"),
    Expect(new_arrays, "minor", "arrays changed in tiles/r001c001.nc", "values"),
    Expect(add_core_field, "minor", "core field", "core field"),
    Expect(add_temporal, "minor", "temporal model came", "temporal model"),
    Expect(lambda d: d["files"][4].update(sha256="3" * 64), "patch", "arrays did not", "text"),
    Expect(lambda d: d["inputs"][0].update(licence="MIT"), "patch", "inputs", "licence"),
]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.id)
def test_each_change_is_due_its_bump(document: dict[str, Any], case: Expect) -> None:
    change = required_bump(edited(document, lambda d: None), edited(document, case.change))
    assert change.bump == case.bump
    assert case.reason in change.reason


def test_a_temporal_models_arrays_are_minor_and_its_words_a_patch(document: dict[str, Any]) -> None:
    old = edited(document, add_temporal)
    words = edited(document, lambda d: add_temporal(d, sha256="5" * 64))
    assert required_bump(old, words).bump == "patch"
    assert required_bump(old, words).reason == "temporal.nc changed, its arrays did not"
    values = edited(document, lambda d: add_temporal(d, digest="6" * 64, sha256="5" * 64))
    assert required_bump(old, values).bump == "minor"
    assert required_bump(old, values).reason == "the temporal model changed"


class Step(NamedTuple):
    number: str
    allowed: bool
    remedy: str


@pytest.mark.parametrize(
    "case",
    [
        Step("1.3.0", True, ""),
        Step("2.0.0", True, ""),
        Step("1.2.4", False, 'set version = "1.3.0"'),
        Step("0.9.0", True, ""),  # below every version: nothing to compare with
        Step("1.0.1", False, 'set version = "1.3.0"'),
    ],
)
def test_new_values_need_a_minor_step_from_the_next_lower_version(
    document: dict[str, Any], case: Step
) -> None:
    existing = [version(document, "1.0.0"), version(document, "1.2.3")]
    new = version(document, case.number, new_arrays)
    if case.allowed:
        check_successor(existing, new)
        return
    with pytest.raises(VersionError, match=r"arrays changed in tiles/r001c001\.nc") as caught:
        check_successor(existing, new)
    assert caught.value.remedy == case.remedy
    assert caught.value.expected == "a MINOR bump"


def test_the_same_version_with_other_content_is_refused(document: dict[str, Any]) -> None:
    old = version(document, "1.0.0")
    check_same(old, version(document, "1.0.0"), (1, 0, 0))
    with pytest.raises(VersionError, match=r"demo 1\.0\.0: other content under the same version"):
        check_same(old, version(document, "1.0.0", new_arrays), (1, 0, 0))


@pytest.mark.parametrize("text", ["1.0", "1.0.0.0", "01.0.0", "1.0.0-rc1", "v1.0.0", ""])
def test_what_is_no_version_is_refused(text: str) -> None:
    with pytest.raises(VersionError, match="is no version"):
        parse_version(text)
