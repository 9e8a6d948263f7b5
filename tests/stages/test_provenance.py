"""provenance.json: an in-toto statement that other libraries read, of exactly these files."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from google.protobuf import json_format
from in_toto_attestation.predicates.provenance.v1 import provenance_pb2
from in_toto_attestation.v1 import statement_pb2
from in_toto_attestation.v1.statement import Statement
from synthetic_release import World, made_in_a_test

from magtiles.catalog import open_release
from magtiles.schemas import contracts
from magtiles.schemas.errors import ContractError
from magtiles.stages.release.provenance import resource, slsa_predicate, statement

CONTRACT = "release-provenance/1"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return World(heights=(0.0, 1000.0)).publish(tmp_path_factory.mktemp("made")).path


def test_every_file_but_manifest_and_provenance_is_a_subject(folder: Path) -> None:
    found = json.loads((folder / "provenance.json").read_bytes())
    listed = {f.path: f.sha256 for f in open_release(folder).manifest.files}
    del listed["provenance.json"]
    assert {s["name"]: s["digest"]["sha256"] for s in found["subject"]} == listed
    assert "checks.json" in listed
    contracts.check_document(found, CONTRACT)


def test_the_reference_library_reads_statement_and_predicate(folder: Path) -> None:
    """Protobuf's JSON parser refuses unknown keys and wrong types."""
    text = (folder / "provenance.json").read_text("utf-8")
    parsed = json_format.Parse(text, statement_pb2.Statement())
    Statement.copy_from_pb(parsed).validate()
    predicate = json_format.MessageToJson(parsed.predicate)
    made = json_format.Parse(predicate, provenance_pb2.Provenance())
    assert made.build_definition.build_type == "magtiles:build-product/1"
    (data,) = made.build_definition.resolved_dependencies
    assert (data.name, data.digest["sha256"]) == ("dipoles", "0" * 64)
    assert data.annotations["licence"] == "CC0"


def test_all_that_a_build_states_keeps_the_forms(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    made = slsa_predicate(
        parameters={"product": resource("a.toml", "1" * 64), "sources": [resource("b", "2" * 64)]},
        internal={"code": "3" * 64},
        inputs=[{"id": "b", "sha256": "4" * 64, "licence": "CC0", "role": "survey"}],
        packages={"python": "3.11", "netCDF4": "1.7.2"},
        byproducts=[resource("c.nc", "5" * 64, stage="fill-voids", version=1, params={"a": None})],
    )
    contracts.check_document(statement({"tiles/a.nc": "6" * 64}, made), CONTRACT)
    parsed = json_format.ParseDict(made, provenance_pb2.Provenance())
    assert parsed.run_details.metadata.finished_on.ToJsonString() == "1970-01-02T00:00:00Z"
    uris = [one.uri for one in parsed.build_definition.resolved_dependencies]
    assert uris == ["", "pkg:pypi/netcdf4@1.7.2", "pkg:generic/python@3.11"]
    assert parsed.run_details.byproducts[0].annotations["stage"] == "fill-voids"


class Spoilt(NamedTuple):
    change: Callable[[dict[str, Any]], Any]
    message: str


SPOILT = [
    Spoilt(lambda d: d.update(_type="https://in-toto.io/Statement/v0.1"), "_type: found"),
    Spoilt(lambda d: d.update(subject=[]), "subject"),
    Spoilt(lambda d: d["subject"][0].pop("digest"), "'digest' is missing"),
    Spoilt(lambda d: d["subject"][0]["digest"].update(sha256="0"), r"subject\.0\.digest\.sha256"),
    Spoilt(lambda d: d["predicate"].pop("runDetails"), "'runDetails' is missing"),
    Spoilt(lambda d: d["predicate"].update(made="by hand"), "made"),
]


@pytest.mark.parametrize("case", SPOILT, ids=lambda case: case.message)
def test_the_contract_refuses(case: Spoilt) -> None:
    made = statement({"tiles/a.nc": "6" * 64}, made_in_a_test())
    contracts.check_document(made, CONTRACT)
    spoilt = copy.deepcopy(made)
    case.change(spoilt)
    with pytest.raises(ContractError, match=case.message):
        contracts.check_document(spoilt, CONTRACT, where="provenance.json")


def test_nothing_is_published_with_a_provenance_that_is_none(tmp_path: Path) -> None:
    with pytest.raises(ContractError, match=r"provenance\.json predicate"):
        World(heights=(0.0,)).publish(tmp_path, provenance={"made": "in a test"})
    assert list((tmp_path / "demo").iterdir()) == []
