"""What is kept under version control: nothing of one machine, and no released contract changed."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

# Written in pieces, so that this file does not accuse itself.
_INDEXES = ("py" + "pi.org", "python" + "hosted.org", "--index" + "-url", "--find" + "-links")
_PLACES = ("home", "Users", "root", "opt", "work", "tmp", "mnt", "private")
MACHINE = re.compile(rf"(?<![\w.)}}/-])/(?:{'|'.join(_PLACES)})/\w|file:" + "//")


def git(*arguments: str, folder: Path = ROOT) -> str:
    identity = {
        "GIT_AUTHOR_NAME": "nobody", "GIT_AUTHOR_EMAIL": "nobody@example.invalid",
        "GIT_COMMITTER_NAME": "nobody", "GIT_COMMITTER_EMAIL": "nobody@example.invalid",
    }  # fmt: skip
    done = subprocess.run(
        ["git", "-C", str(folder), *arguments],
        capture_output=True, check=True, env=os.environ | identity,
    )  # fmt: skip
    return done.stdout.decode("utf-8", errors="replace")


@pytest.fixture
def tracked() -> list[Path]:
    if not (ROOT / ".git").exists():
        pytest.skip("not a git checkout")
    files = [ROOT / name for name in git("ls-files", "-z").split("\0") if name]
    return [path for path in files if path.is_file()]


def tied_to_a_machine(text: str) -> list[str]:
    """Places of one machine and hosts of package indexes named in `text`."""
    return [m[0] for m in MACHINE.finditer(text)] + [h for h in _INDEXES if h in text]


def test_tracked_files_name_no_machine_and_no_package_index(tracked: list[Path]) -> None:
    found = {}
    for path in tracked:
        text = path.read_bytes().decode("utf-8", errors="ignore")
        if "\0" not in text and (hits := tied_to_a_machine(text)):
            found[path.relative_to(ROOT).as_posix()] = hits
    assert found == {}


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("/" + "home/ada/survey.tif", 1),
        ("cache = '/" + "tmp/x'", 1),
        ("https://" + "py" + "pi.org/simple", 1),
        ("build/work/plane.nc", 0),
        ("../shared/work/x", 0),
        ("rms of home/away", 0),
    ],
)
def test_the_check_of_machine_paths_tells_right_from_wrong(text: str, count: int) -> None:
    assert len(tied_to_a_machine(text)) == count


def changed_schemas(repository: Path) -> list[str]:
    """Contracts that differ from what a tag of `repository` published, as ``tag:path``."""
    changed = []
    for tag in git("tag", folder=repository).split():
        for row in git("ls-tree", "-r", tag, "--", "schemas", folder=repository).splitlines():
            blob, path = row.split()[2], row.split("\t")[1]
            if not path.endswith(".schema.json"):
                continue
            now = repository / path
            if not now.is_file() or git("hash-object", str(now), folder=repository).strip() != blob:
                changed.append(f"{tag}:{path}")
    return changed


def test_contracts_of_tagged_versions_never_change() -> None:
    if not (ROOT / ".git").exists() or not git("tag"):
        pytest.skip("no tagged version yet")
    assert changed_schemas(ROOT) == []


def test_the_check_of_contracts_sees_a_change_and_a_loss(tmp_path: Path) -> None:
    git("init", "--quiet", folder=tmp_path)
    folder = tmp_path / "schemas"
    folder.mkdir()
    for name in ("a-1.0.0", "b-1.0.0", "c-1.0.0"):
        (folder / f"{name}.schema.json").write_text("{}")
    git("add", "schemas", folder=tmp_path)
    git("commit", "--quiet", "-m", "contracts", folder=tmp_path)
    git("tag", "v1", folder=tmp_path)
    assert changed_schemas(tmp_path) == []
    (folder / "a-1.0.0.schema.json").write_text('{"type": "object"}')
    (folder / "b-1.0.0.schema.json").unlink()
    (folder / "c-1.1.0.schema.json").write_text("{}")  # a new version is no change
    assert changed_schemas(tmp_path) == [
        "v1:schemas/a-1.0.0.schema.json",
        "v1:schemas/b-1.0.0.schema.json",
    ]
