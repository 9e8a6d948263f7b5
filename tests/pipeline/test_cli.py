"""The command line: exit statuses, one clear line for an error, JSON, what it imports."""

from __future__ import annotations

import json
import logging
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from magtiles.pipeline import build
from magtiles.pipeline import main as command_line
from magtiles.pipeline.commands import run as run_command
from magtiles.pipeline.commands import stages as stages_command
from magtiles.pipeline.main import main
from magtiles.pipeline.output import plain
from magtiles.pipeline.progress import progress_bar
from magtiles.schemas import contracts
from magtiles.schemas.errors import IntegrityError, UsageError
from magtiles.stages import registry
from magtiles.stages.declare import FILES, OPTIONAL_FILE, Many, Params, Stage, quantity
from magtiles.stages.release.publish import PublishResult


class OffsetParams(Params):
    offset_nt: float = quantity("nT", default=0.0, doc="What to add.")
    label: str = quantity("1", doc="A text.")


def offset(grid: xr.Dataset, *, params: OffsetParams) -> xr.Dataset:
    """Never run here; listed only."""
    return grid + params.offset_nt


OFFSET = Stage(
    "offset",
    3,
    OffsetParams,
    {"grid": "anomaly-grid/1", "more": Many("component-grid/1")},
    "anomaly-grid/1",
    offset,
)


@pytest.fixture
def with_offset(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "STAGES", (OFFSET,))


def test_stages_are_told_apart_and_have_known_contracts() -> None:
    # Those of one name by their first role, as remove-core-field of a grid and of a track.
    names = [(stage.name, next(iter(stage.inputs))) for stage in registry.STAGES]
    assert len(names) == len(set(names))
    for stage in registry.STAGES:
        assert stage.version >= 1
        assert stage.run.__doc__, stage.name
        kinds = [k if isinstance(k, str) else k.contract for k in stage.inputs.values()]
        for contract in [stage.output, *(k for k in kinds if k not in (FILES, OPTIONAL_FILE))]:
            contracts.resolve(contract)
        for name, field in stage.params.model_fields.items():
            assert field.description, f"{stage.name}.{name} says nothing of itself"


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("magtiles 0.")


@pytest.mark.parametrize(
    "argv",
    [
        pytest.param([], id="no command"),
        pytest.param(["frobnicate"], id="unknown command"),
        pytest.param(["stages", "--jsn"], id="unknown option"),
        pytest.param(["build"], id="no product"),
        pytest.param(["run", "offset"], id="no output"),
        pytest.param(["run", "no-such-stage", "--out", "o.nc"], id="unknown stage"),
        pytest.param(["run", "offset", "--out", "o.nc", "--in", "grid"], id="no equals sign"),
        pytest.param(["run", "offset", "--out", "o.nc", "--param", "x=bare"], id="no TOML"),
        pytest.param(["run", "offset", "--out", "o.nc", "--param", "z=1"], id="unknown parameter"),
        pytest.param(["run", "offset", "--out", "o.nc", "--param", 'label="a"'], id="no input"),
    ],
)
@pytest.mark.usefixtures("with_offset")
def test_bad_use_is_status_2_and_says_so_on_stderr(
    argv: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(argv) == 2
    streams = capsys.readouterr()
    assert streams.out == ""
    assert "error:" in streams.err
    assert "Traceback" not in streams.err


def raising(error: BaseException) -> Callable[[object], int]:
    def run(arguments: object) -> int:
        raise error

    return run


@pytest.mark.parametrize(
    ("error", "status", "message"),
    [
        pytest.param(IntegrityError("changed", where="a.nc"), 1, "a.nc: changed", id="ours"),
        pytest.param(UsageError("wrong", remedy="do right"), 2, "wrong; do right", id="usage"),
        pytest.param(PermissionError(13, "Permission denied", "/x"), 1, "/x: Perm", id="system"),
        pytest.param(MemoryError(), 1, "not enough memory", id="memory"),
        pytest.param(ZeroDivisionError("oops"), 1, "internal error", id="fault"),
        pytest.param(KeyboardInterrupt(), 130, "", id="interrupt"),
    ],
)
def test_errors_are_one_line_and_a_status(
    error: BaseException,
    status: int,
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(stages_command, "run", raising(error))
    assert main(["stages"]) == status
    text = capsys.readouterr().err
    assert message in text
    assert len(text.splitlines()) == bool(message)
    if message:
        assert main(["-vv", "stages"]) == status
        assert "Traceback" in capsys.readouterr().err


def test_broken_pipe_is_quiet() -> None:
    script = (
        "import sys; from magtiles.pipeline import main as m;"
        "m.stages.run = lambda a: print('x' * 100_000) or 0;"
        "sys.exit(m.main(['stages']))"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait() == command_line.BROKEN_PIPE


def test_without_the_extra_a_command_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command_line.importlib.util, "find_spec", lambda name: None)
    assert main(["stages"]) == 2
    assert 'pip install "magtiles[pipeline]"' in capsys.readouterr().err
    assert main(["--version"]) == 0


def test_starting_imports_nothing_of_the_extra() -> None:
    script = (
        "import sys, magtiles.pipeline.main as m; m.main(['--version']);"
        "print(sorted({n.partition('.')[0] for n in sys.modules} & set(m._EXTRA)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[1] == "[]"


def test_reader_alone_can_say_what_a_release_is_and_answer(exact_release: Path) -> None:
    script = (
        "import sys, magtiles.pipeline.main as m\n"
        "for name in m._EXTRA: sys.modules[name] = None\n"
        f"release = {str(exact_release)!r}\n"
        "print(m.main(['info', release]))\n"
        "print(m.main(['query', release, '--lat=44.5', '--lon=-104.4', '--height=600']))\n"
        "print(m.main(['validate', release]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    statuses = [line for line in done.stdout.splitlines() if line in ("0", "1", "2")]
    assert statuses == ["0", "0", "2"]
    assert done.stderr.strip() == 'this command needs: pip install "magtiles[pipeline]"'


def test_build_passes_its_folders_on_and_says_what_it_did(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[tuple[Path, dict[str, object]]] = []

    def build_product(product: Path, **folders: object) -> PublishResult:
        asked.append((product, folders))
        return PublishResult(Path("store/p/1.0.0"), changed=len(asked) == 1)

    monkeypatch.setattr(build, "build_product", build_product)
    argv = ["build", "p.toml", "--store", "store", "--from", "data", "--scheduler", "tcp://h:1"]
    assert main(argv) == 0
    assert "store/p/1.0.0: published" in capsys.readouterr().out
    assert main(argv) == 0
    assert "unchanged" in capsys.readouterr().out
    assert main([*argv, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"path": "store/p/1.0.0", "changed": False}
    product, folders = asked[0]
    assert product == Path("p.toml")
    folders.pop("progress")
    assert folders == {
        "store": Path("store"),
        "work": Path("build/work"),
        "data": Path("data"),
        "scheduler": "tcp://h:1",
    }


def test_progress_is_for_terminals_only(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def advance(quiet: bool) -> str:
        with progress_bar(quiet=quiet) as progress:
            progress("cutting tiles", 1, 2)
        return capsys.readouterr().err

    assert advance(quiet=False) == ""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm")
    assert "cutting tiles" in advance(quiet=False)
    assert advance(quiet=True) == ""


@pytest.mark.usefixtures("with_offset")
def test_stages_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["stages", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == [
        {
            "name": "offset",
            "version": 3,
            "inputs": {"grid": "anomaly-grid/1", "more": "component-grid/1 (one or more)"},
            "output": "anomaly-grid/1",
            "params": [
                {"name": "offset_nt", "unit": "nT", "doc": "What to add.", "default": 0.0},
                {"name": "label", "unit": "1", "doc": "A text."},
            ],
        }
    ]
    assert main(["stages"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "offset (version 3): grid=anomaly-grid/1, more=component-grid/1 (one or more)"
        " -> anomaly-grid/1",
        "    offset_nt [nT] = 0.0: What to add.",
        "    label (required): A text.",
    ]


@pytest.mark.parametrize(
    ("word", "value"),
    [
        pytest.param("k=2000.0", 2000.0, id="float"),
        pytest.param("k=[1, 2]", [1, 2], id="array"),
        pytest.param('k="a=b"', "a=b", id="text with equals"),
        pytest.param("k={a = [1.5, 2]}", {"a": [1.5, 2]}, id="table"),
        pytest.param("k=true", True, id="bool"),
    ],
)
def test_parameter_values_are_toml(word: str, value: object) -> None:
    assert run_command.parse_assignments([word]) == {"k": value}


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        pytest.param(["k=terrain"], """quote it: --param 'k="terrain"'""", id="bare word"),
        pytest.param(["k=1\nj=2"], "no TOML value", id="smuggled key"),
        pytest.param(["k=1", "k=2"], "--param k: given twice", id="twice"),
        pytest.param(["k="], "expected KEY=VALUE", id="no value"),
    ],
)
def test_bad_parameter_words(words: list[str], expected: str) -> None:
    with pytest.raises(UsageError) as caught:
        run_command.parse_assignments(words)
    assert expected in str(caught.value)


def test_json_has_null_for_what_json_lacks() -> None:
    value = {"a": np.array([1.5, np.nan]), "b": (np.float32(2), np.inf), "c": Path("x"), 4: None}
    assert plain(value) == {"a": [1.5, None], "b": [2.0, None], "c": "x", "4": None}


def test_verbosity_may_stand_on_either_side_of_the_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(arguments: object) -> int:
        logging.getLogger("magtiles.test").info("said")
        return 0

    monkeypatch.setattr(stages_command, "run", run)
    for argv, says in ((["stages"], False), (["-v", "stages"], True), (["stages", "-v"], True)):
        assert main(argv) == 0
        assert ("said" in capsys.readouterr().err) is says
    assert logging.getLogger("magtiles").handlers == []
