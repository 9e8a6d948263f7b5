"""The catalog's sources are all readable, and fetching keeps only files that are what they should.

The publishers' servers are stood in for by one on this machine.
"""

from __future__ import annotations

import functools
import hashlib
import http.server
import io
import json
import tarfile
import threading
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from magtiles.pipeline.fetching import cache_folder, catalog_sources
from magtiles.pipeline.main import main
from magtiles.pipeline.source_paths import find_source
from magtiles.stages.ingest.field_model import FIELD_MODEL
from magtiles.stages.ingest.index import ACTIVITY_INDEX
from magtiles.stages.ingest.observatory.stage import OBSERVATORY_SERIES
from magtiles.stages.ingest.source import ANOMALY_GRID, SourceKind, load_source

KINDS: dict[str, SourceKind] = {
    kind.name: kind for kind in (ANOMALY_GRID, FIELD_MODEL, ACTIVITY_INDEX, OBSERVATORY_SERIES)
}
DATA = b"37.0 -120.0 5.0\n" * 40


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *arguments: object) -> None:
        pass


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[Path, str]]:
    """A folder, and the address that serves it."""
    folder = tmp_path / "served"
    folder.mkdir()
    handler = functools.partial(Quiet, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield folder, f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()
        thread.join()


def source(folder: Path, url: str, sha256: str | None = None, files: str = '"a.xyz"') -> Path:
    toml = folder / "here.toml"
    digest = "" if sha256 is None else f'sha256 = {{"a.xyz" = "{sha256}"}}\n'
    toml.write_text(
        f'[source]\nid = "here"\nkind = "anomaly-grid"\nfiles = [{files}]\n'
        f'licence = "CC0-1.0"\nurls = ["{url}"]\n{digest}'
    )
    return toml


def as_zip(data: bytes) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr("folder/a.xyz", data)
        archive.writestr("folder/readme.txt", "about it")
    return out.getvalue()


def as_tar(data: bytes) -> bytes:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w:gz") as archive:
        entry = tarfile.TarInfo("folder/a.xyz")
        entry.size = len(data)
        archive.addfile(entry, io.BytesIO(data))
    return out.getvalue()


@pytest.mark.parametrize("name", catalog_sources())
def test_every_source_of_the_catalog_is_whole(name: str) -> None:
    toml = catalog_sources()[name]
    tables = load_source(toml, KINDS[load_kind(toml)])
    assert tables.source.id == name
    assert tables.source.url
    assert tables.source.title


def load_kind(toml: Path) -> str:
    return next(
        line.split('"')[1] for line in toml.read_text().splitlines() if line.startswith("kind")
    )


def test_sources_lists_the_catalog(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sources", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert [one["id"] for one in listed] == list(catalog_sources())
    assert main(["sources"]) == 0
    assert "emag2-v3" in capsys.readouterr().out


def test_the_cache_is_where_it_is_said_to_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MAGTILES_CACHE", str(tmp_path))
    assert cache_folder() == tmp_path


@pytest.mark.parametrize(
    ("name", "pack"), [("a.xyz", bytes), ("all.zip", as_zip), ("all.tar.gz", as_tar)]
)
def test_fetch(
    served: tuple[Path, str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    name: str,
    pack: Callable[[bytes], bytes],
) -> None:
    folder, address = served
    (folder / name).write_bytes(pack(DATA))
    digest = hashlib.sha256(DATA).hexdigest()
    toml, to = source(tmp_path, f"{address}/{name}", digest), tmp_path / "to"
    assert main(["fetch", str(toml), "--to", str(to)]) == 0
    assert f"a.xyz  fetched  sha256 {digest}" in capsys.readouterr().out
    assert [p.name for p in to.iterdir()] == ["a.xyz"]
    assert (to / "a.xyz").read_bytes() == DATA
    (folder / name).unlink()
    assert main(["fetch", str(toml), "--to", str(to)]) == 0  # nothing is fetched twice
    assert "was there" in capsys.readouterr().out


def test_a_file_without_a_stated_digest_is_said_to_be_so(
    served: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (served[0] / "a.xyz").write_bytes(DATA)
    toml = source(tmp_path, f"{served[1]}/a.xyz")
    assert main(["fetch", str(toml), "--to", str(tmp_path / "to")]) == 0
    assert "no digest stated: note this one" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("a.xyz", b"other", "sha256 is"),
        ("none.xyz", None, "cannot be fetched: 404"),
        ("all.zip", as_zip(DATA)[:-30], "is not a whole archive"),
        ("all.zip", as_zip(b"other"), "sha256 is"),
    ],
)
def test_what_is_not_the_file_is_not_kept(
    served: tuple[Path, str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    name: str,
    data: bytes | None,
    message: str,
) -> None:
    if data is not None:
        (served[0] / name).write_bytes(data)
    named = '"none.xyz"' if data is None else '"a.xyz"'
    toml = source(tmp_path, f"{served[1]}/{name}", hashlib.sha256(DATA).hexdigest(), named)
    to = tmp_path / "to"
    assert main(["fetch", str(toml), "--to", str(to)]) == 1
    assert message in capsys.readouterr().err
    assert list(to.iterdir()) == []


def test_an_archive_without_the_file(
    served: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (served[0] / "all.zip").write_bytes(as_zip(DATA))
    toml = source(tmp_path, f"{served[1]}/all.zip", files='"b.xyz"')
    assert main(["fetch", str(toml), "--to", str(tmp_path / "to")]) == 1
    assert "'b.xyz' was in nothing that was fetched" in capsys.readouterr().err


def test_what_no_program_can_fetch(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["fetch", "namad-hp500", "--to", str(tmp_path)]) == 1
    error = capsys.readouterr().err
    assert "get NAmag_hp500.grd by hand from https://" in error
    assert main(["fetch", "nothing", "--to", str(tmp_path)]) == 1
    assert "the catalog has no source 'nothing'" in capsys.readouterr().err


@pytest.mark.parametrize("name", catalog_sources())
def test_a_product_finds_every_source_by_its_id(name: str, tmp_path: Path) -> None:
    """Whatever the source's file is called."""
    assert find_source(name, tmp_path / "product.toml", "anomaly.source") == catalog_sources()[name]
