"""How a release was made, as an in-toto statement with a SLSA provenance predicate.

The forms are those of in-toto Statement v1 (https://in-toto.io/Statement/v1) and SLSA
provenance v1 (https://slsa.dev/provenance/v1). Nothing in it depends on place or time but
the date in SOURCE_DATE_EPOCH: the same inputs give the same bytes.
"""

from __future__ import annotations

import datetime
import importlib.metadata
import os
from collections.abc import Mapping, Sequence
from typing import Any

STATEMENT_TYPE = "https://in-toto.io/Statement/v1"
PREDICATE_TYPE = "https://slsa.dev/provenance/v1"
BUILD_TYPE = "magtiles:build-product/1"
BUILDER = "magtiles:pipeline"
CONTRACT = "release-provenance/1"


def build_date() -> str | None:
    """The ISO time in the variable SOURCE_DATE_EPOCH; None where it is not set."""
    if "SOURCE_DATE_EPOCH" not in os.environ:
        return None
    seconds = int(os.environ["SOURCE_DATE_EPOCH"])
    moment = datetime.datetime.fromtimestamp(seconds, tz=datetime.UTC)
    return moment.strftime("%Y-%m-%dT%H:%M:%SZ")


def resource(name: str, sha256: str | None, **annotations: Any) -> dict[str, Any]:
    """An in-toto resource descriptor: a name, the digest if it is known, and what is said of it."""
    found: dict[str, Any] = {"name": name}
    if sha256 is not None:
        found["digest"] = {"sha256": sha256}
    return found | ({"annotations": annotations} if annotations else {})


def slsa_predicate(
    *,
    parameters: Mapping[str, Any],
    internal: Mapping[str, Any],
    inputs: Sequence[Mapping[str, Any]],
    packages: Mapping[str, str],
    byproducts: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """The SLSA provenance of a build.

    Parameters
    ----------
    parameters : what the user chose: resource descriptors of the product and source TOML.
    internal : what the user did not choose but the bytes depend on, such as our code's digest.
    inputs : the sources of data, as in the manifest: id, sha256, licence and role.
    packages : name to version of the libraries whose numbers reach the release.
    byproducts : resource descriptors of what was made on the way, each with its stage.
    """
    data = [resource(i["id"], i["sha256"], licence=i["licence"], role=i["role"]) for i in inputs]
    libraries = [
        {"name": name, "uri": f"pkg:{_KINDS.get(name, 'pypi')}/{name.lower()}@{version}"}
        for name, version in sorted(packages.items())
    ]
    date = build_date()
    return {
        "buildDefinition": {
            "buildType": BUILD_TYPE,
            "externalParameters": dict(parameters),
            "internalParameters": dict(internal),
            "resolvedDependencies": [*data, *libraries],
        },
        "runDetails": {
            "builder": {
                "id": BUILDER,
                "version": {"magtiles": importlib.metadata.version("magtiles")},
            },
            "metadata": {} if date is None else {"startedOn": date, "finishedOn": date},
            "byproducts": [dict(item) for item in byproducts],
        },
    }


_KINDS = {"python": "generic"}


def statement(digests: Mapping[str, str], predicate: Mapping[str, Any]) -> dict[str, Any]:
    """The statement that a predicate holds of files, given as path to sha256."""
    return {
        "_type": STATEMENT_TYPE,
        "subject": [resource(path, digest) for path, digest in sorted(digests.items())],
        "predicateType": PREDICATE_TYPE,
        "predicate": dict(predicate),
    }
