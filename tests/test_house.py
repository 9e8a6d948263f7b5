"""The rules of the house that no other tool checks: who may import whom, and what is listed."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
CHAIN = ("schemas", "catalog", "stages", "pipeline")
MODULES = sorted(path for folder in CHAIN for path in (ROOT / folder).rglob("*.py"))

READER_MAY_IMPORT = sys.stdlib_module_names | {"numpy", "netCDF4", "numba", "magtiles"}
HEAVY = {
    "cryptography", "dask", "h5py", "jsonschema", "matplotlib", "mcap", "numba", "pandas",
    "pydantic", "pyproj", "pystac", "rasterio", "rich", "scipy", "xarray",
}  # fmt: skip
INPUT_OUTPUT = {
    "fromfile", "imread", "imwrite", "load", "loadtxt", "mkdir", "open", "open_dataset",
    "open_mfdataset", "read_bytes", "read_text", "rename", "save", "savetxt", "savez",
    "to_netcdf", "to_zarr", "tofile", "unlink", "urlopen", "write_bytes", "write_text",
}  # fmt: skip


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def imports(source: str) -> Iterator[tuple[int, str]]:
    """Line and module of every import, wherever it stands; a relative one starts with a dot."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = "." * node.level + (node.module or "")
            # `from magtiles import stages` and `from . import x` name modules, too.
            names = (
                [f"{module}.{alias.name}" for alias in node.names]
                if module.strip(".") in ("", "magtiles")
                else [module]
            )
            yield from ((node.lineno, name) for name in names)


def breaches_of_chain(folder: str, source: str) -> list[str]:
    """Imports of `source`, a module in `folder`, that go up the chain or by the wrong name."""
    allowed = {f"magtiles.{name}" for name in CHAIN[: CHAIN.index(folder) + 1]}
    return [
        f"line {line}: {module}"
        for line, module in imports(source)
        if module.startswith(".")
        or module.split(".")[0] in CHAIN
        or (module.startswith("magtiles") and ".".join(module.split(".")[:2]) not in allowed)
    ]


def calls_of_io(source: str) -> list[str]:
    """Calls in `source` that by their name read or write files."""
    calls = (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call))
    named = (
        (call.lineno, getattr(call.func, "attr", getattr(call.func, "id", None))) for call in calls
    )
    return [f"line {line}: {name}" for line, name in named if name in INPUT_OUTPUT]


class Expect(NamedTuple):
    folder: str
    source: str
    allowed: bool


@pytest.mark.parametrize(
    "case",
    [
        Expect("schemas", "import json", True),
        Expect("schemas", "from magtiles.schemas.errors import FormatError", True),
        Expect("schemas", "import magtiles.catalog", False),
        Expect("catalog", "from magtiles.schemas import contracts", True),
        Expect("catalog", "from magtiles.stages.field import voids", False),
        Expect("catalog", "from magtiles import stages", False),
        Expect("stages", "def late():\n    from magtiles.pipeline.runner import run", False),
        Expect("stages", "from magtiles.catalog.kernels import bspline", True),
        Expect("stages", "from . import declare", False),
        Expect("pipeline", "from ..stages import declare", False),
        Expect("pipeline", "import stages.declare", False),
        Expect("pipeline", "import magtiles.stages", True),
    ],
    ids=lambda case: f"{case.folder}: {case.source}",
)
def test_the_check_of_imports_tells_right_from_wrong(case: Expect) -> None:
    assert (breaches_of_chain(case.folder, case.source) == []) is case.allowed


@pytest.mark.parametrize("path", MODULES, ids=relative)
def test_imports_follow_the_chain(path: Path) -> None:
    folder = path.relative_to(ROOT).parts[0]
    assert breaches_of_chain(folder, path.read_text(encoding="utf-8")) == []


SIGNATURES = "catalog/releases/signature.py"
"""The one module of the reader that may import more, when a public key is given."""

READER = [p for p in MODULES if p.is_relative_to(ROOT / "catalog") or p.name == "errors.py"]


@pytest.mark.parametrize("path", READER, ids=relative)
def test_the_reader_imports_only_what_a_bare_install_has(path: Path) -> None:
    found = {module.split(".")[0] for _, module in imports(path.read_text(encoding="utf-8"))}
    more = {"cryptography"} if relative(path) == SIGNATURES else set()
    assert found - READER_MAY_IMPORT - more == set()


def test_importing_the_reader_loads_nothing_heavy() -> None:
    program = "import sys, magtiles.catalog; print(*{m.split('.')[0] for m in sys.modules})"
    loaded = subprocess.run(
        [sys.executable, "-c", program], cwd="/", capture_output=True, text=True, check=True
    )
    assert set(loaded.stdout.split()) & HEAVY == set()
    assert "numpy" in loaded.stdout.split()  # it did import something


PURE = [
    path
    for path in MODULES
    if path.is_relative_to(ROOT / "stages")
    and path.relative_to(ROOT).parts[1] not in ("ingest", "release")
]


@pytest.mark.parametrize("path", PURE, ids=relative)
def test_stages_do_no_input_or_output(path: Path) -> None:
    assert calls_of_io(path.read_text(encoding="utf-8")) == []


def test_the_check_of_input_and_output_sees_both_kinds_of_call() -> None:
    assert calls_of_io("open('x')\nds.to_netcdf('y')\nabs(1)") == [
        "line 1: open",
        "line 2: to_netcdf",
    ]


def test_every_package_is_listed_and_every_listed_package_exists() -> None:
    found = {"magtiles." + ".".join(p.parent.relative_to(ROOT).parts) for p in MODULES}
    assert set(PROJECT["tool"]["setuptools"]["packages"]) == found


@pytest.mark.parametrize("folder", CHAIN)
def test_each_folder_of_the_namespace_is_mapped_and_typed(folder: str) -> None:
    assert PROJECT["tool"]["setuptools"]["package-dir"][f"magtiles.{folder}"] == folder
    assert "py.typed" in PROJECT["tool"]["setuptools"]["package-data"][f"magtiles.{folder}"]
    assert (ROOT / folder / "py.typed").is_file()


def make(*arguments: str) -> str:
    """What make prints, unmoved by the make that may run these tests."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("MAKE", "MFLAGS"))}
    return subprocess.run(
        ["make", *arguments], cwd=ROOT, capture_output=True, text=True, check=True, env=environment
    ).stdout


def test_each_make_target_that_a_person_may_type_is_explained() -> None:
    explained = {line.split()[0] for line in make("help").splitlines() if line.startswith("  ")}
    assert explained >= {"tiles", "test", "check", "validate", "bench", "clean", "help", "lock"}


def test_make_builds_each_product_it_is_given(tmp_path: Path) -> None:
    products = [tmp_path / "a.toml", tmp_path / "deeper" / "b.toml"]
    for product in products:
        product.parent.mkdir(exist_ok=True)
        product.touch()
    dry = make("--dry-run", f"PRODUCT={products[0]} {products[1]}", f"STORE={tmp_path}/store")
    built = [line for line in dry.splitlines() if line.startswith("built=")]
    assert len(built) == dry.count("/magtiles validate ") == 2
    for line, product in zip(built, products, strict=True):
        assert f"build {product} --store {tmp_path}/store" in line
