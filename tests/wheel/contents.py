"""Build the wheel into FOLDER and compare what it holds with the tree.

A sub-package or data file that pyproject.toml does not list works in an editable install and
is missing from the wheel; a stale build folder puts deleted files into it. Both fail here.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("schemas", "catalog", "stages", "pipeline")


def build_wheel(folder: Path) -> Path:
    """Build the wheel of the checkout as the only one in `folder`."""
    for stale in (folder, ROOT / "build" / "lib"):
        shutil.rmtree(stale, ignore_errors=True)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    options = ["--no-deps", "--no-build-isolation", "--wheel-dir", str(folder)]
    subprocess.run([*pip, "wheel", *options, str(ROOT)], check=True)
    (wheel,) = folder.glob("*.whl")
    return wheel


def in_tree() -> set[str]:
    """What a wheel should hold: everything in the four folders but byte code."""
    return {
        f"magtiles/{path.relative_to(ROOT).as_posix()}"
        for folder in FOLDERS
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


def in_wheel(wheel: Path) -> set[str]:
    """What a wheel does hold, besides its own metadata."""
    with zipfile.ZipFile(wheel) as archive:
        return {name for name in archive.namelist() if ".dist-info/" not in name}


def main() -> int:
    """Print the differences; 1 if there are any."""
    wheel = build_wheel(Path(sys.argv[1]).resolve())
    expected, found = in_tree(), in_wheel(wheel)
    for name in sorted(expected - found):
        print(f"missing from the wheel: {name}; list it in pyproject.toml", file=sys.stderr)
    for name in sorted(found - expected):
        print(f"in the wheel, not in the tree: {name}", file=sys.stderr)
    print(f"{wheel.name}: {len(found)} files, {len(expected)} in the tree")
    return int(expected != found)


if __name__ == "__main__":
    sys.exit(main())
