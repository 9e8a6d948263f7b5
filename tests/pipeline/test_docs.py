"""README and docs hold: their Python runs, their commands parse, their tables are the models'."""

from __future__ import annotations

import json
import re
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from magtiles.catalog.flags import QualityFlag, RecordFlag
from magtiles.catalog.releases.temporal_table import TEMPORAL_VARIABLES
from magtiles.catalog.releases.tile_table import TILE_VARIABLES
from magtiles.pipeline import main as command_line
from magtiles.pipeline.main import main
from magtiles.pipeline.product import (
    AnomalyTable,
    ModelTable,
    ProductTable,
    ProductTables,
    RegionTable,
)
from magtiles.pipeline.road_sources import RoadsTable
from magtiles.pipeline.sample import DEMO, synthesize, write_survey
from magtiles.pipeline.synthetic_observatories import TemporalSample
from magtiles.pipeline.temporal_part import TemporalTable
from magtiles.schemas import contracts
from magtiles.stages.declare import Params, parse_params
from magtiles.stages.ingest.field_model import FIELD_MODEL, CoefficientsParams
from magtiles.stages.ingest.log.source import TRACK, Columns, IngestLogParams
from magtiles.stages.ingest.observatory.stage import OBSERVATORY_SERIES, IngestObservatoryParams
from magtiles.stages.ingest.source import (
    ANOMALY_GRID,
    SURFACE_GRID,
    IngestGridParams,
    IngestSurfaceParams,
    SourceKind,
    SourceParams,
    load_source,
)

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
TABLES = {
    "[source]": SourceParams,
    "[grid]": IngestGridParams,
    "[surface]": IngestSurfaceParams,
    "[product]": ProductTable,
    "[anomaly]": AnomalyTable,
    "[coefficients]": CoefficientsParams,
    "[series]": IngestObservatoryParams,
    "[log]": IngestLogParams,
    "[log.columns]": Columns,
    "[model]": ModelTable,
    "[temporal]": TemporalTable,
    "[[roads]]": RoadsTable,
    "region": RegionTable,
}
KINDS: dict[str, SourceKind[Any]] = {
    kind.name: kind for kind in (ANOMALY_GRID, FIELD_MODEL, OBSERVATORY_SERIES, SURFACE_GRID, TRACK)
}


def blocks(language: str) -> list[object]:
    parameters = []
    for page in PAGES:
        found = re.findall(rf"^```{language}\n(.*?)^```", page.read_text("utf-8"), re.M | re.S)
        if found:
            parameters.append(pytest.param(page, found, id=str(page.relative_to(ROOT))))
    return parameters


@pytest.fixture(scope="module")
def beside_the_demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that holds a small stand-in for what `make` builds."""
    folder = tmp_path_factory.mktemp("checkout")
    spec = replace(DEMO, width_m=50e3, length_m=40e3, dipoles=60)
    write_survey(folder / "build/sample", synthesize(spec), TemporalSample())
    product, store, work = (
        str(folder / f"build/{n}") for n in ("sample/demo.toml", "releases", "w")
    )
    assert main(["build", product, "--store", store, "--work", work]) == 0
    return folder


@pytest.mark.parametrize(("page", "found"), blocks("python"))
def test_python_examples_run_in_order(
    page: Path, found: list[str], beside_the_demo: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(beside_the_demo)
    names: dict[str, object] = {}
    for block in found:
        if "STAGE = Stage(" in block:  # how to write a stage: imports are left out there
            continue
        exec(compile(block, str(page), "exec"), names)


@pytest.mark.parametrize(("page", "found"), blocks("console"))
def test_commands_in_examples_exist(page: Path, found: list[str]) -> None:
    commands = re.findall(r"^\$ (?:\S*/)?magtiles (.*?)(?:\s+#.*)?$", "".join(found), re.M)
    targets = re.findall(r"^\$ make(?: -\S+)* ([a-z-]+)", "".join(found), re.M)
    parser = command_line._parser()
    for words in commands:
        parser.parse_args(words.replace("'", "").split())
    makefile = (ROOT / "Makefile").read_text("utf-8")
    for target in targets:
        assert re.search(rf"^{target}:", makefile, re.M), target


@pytest.mark.parametrize(("page", "found"), blocks("toml"))
def test_toml_examples_are_valid(page: Path, found: list[str], tmp_path: Path) -> None:
    for block in found:
        tables = tomllib.loads(block)
        if "source" in tables:
            (tmp_path / "source.toml").write_text(block)
            kind = KINDS[tables["source"]["kind"]]
            assert load_source(tmp_path / "source.toml", kind).source.licence
        else:
            product = parse_params(ProductTables, tables, where=page)
            assert (product.anomaly or product.model).heights_m


def table_of(kind: type[Params]) -> str:
    """A Markdown table of the keys of a table, from its model."""
    lines = ["| key | unit | default | meaning |", "|---|---|---|---|"]
    for name, field in kind.model_fields.items():
        extra = field.json_schema_extra
        unit = str(extra["unit"]) if isinstance(extra, dict) else "1"
        unit = "" if unit == "1" else unit
        default = "required" if field.is_required() else ""
        if not field.is_required() and field.default not in (None, {}):
            default = f"`{json.dumps(field.default)}`"
        meaning = str(field.description).replace("|", r"\|")
        lines.append(f"| `{name}` | {unit} | {default} | {meaning} |")
    return "\n".join(lines)


@pytest.mark.parametrize("name", TABLES)
def test_tables_of_keys_are_those_of_the_models(name: str) -> None:
    page = (ROOT / "docs/toml.md").read_text("utf-8")
    assert table_of(TABLES[name]) in page


def test_format_names_every_variable_flag_and_contract() -> None:
    page = (ROOT / "docs/format.md").read_text("utf-8")
    for name, rule in TILE_VARIABLES.items():
        row = next(line for line in page.splitlines() if line.startswith(f"| `{name}`"))
        assert rule.dtype in row
        assert (rule.units or "-") in row
        assert ("(" + ", ".join(rule.dims) + ")" if rule.dims else "scalar") in row
    for name, stored in TEMPORAL_VARIABLES.items():
        kinds = " or ".join("text" if d == "str" else d for d in stored.dtypes)
        dims = ", ".join(stored.dims)
        row = f"| `{name}` | ({dims}) | {kinds} | {stored.units or '-'} | {stored.long_name} |"
        assert row in page
    for flag in QualityFlag:
        assert f"| {flag.value} | `{str(flag.name).lower()}` |" in page
    for name, versions in contracts.available().items():
        assert f"`{name}/{versions[-1]}`" in page


def test_observatories_names_every_flag_of_a_record() -> None:
    page = (ROOT / "docs/observatories.md").read_text("utf-8")
    for flag in RecordFlag:
        assert f"| {flag.value} `{str(flag.name).lower()}` |" in page


def test_make_help_and_readme_agree() -> None:
    targets = re.findall(r"^([a-z-]+):.*?## ", (ROOT / "Makefile").read_text("utf-8"), re.M)
    page = (ROOT / "docs/developing.md").read_text("utf-8")
    for target in targets:
        assert f"make {target}" in page, target


def test_links_lead_somewhere() -> None:
    for page in PAGES:
        for link in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text("utf-8")):
            assert (page.parent / link).exists(), f"{page.name}: {link}"
