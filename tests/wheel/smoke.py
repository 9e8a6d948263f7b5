"""Use the one wheel in FOLDER from outside the checkout, in two fresh environments.

``[pipeline]`` makes the sample and builds its release; the reader alone opens that release and
must answer the same. Dependencies are those of the lock.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LOCK = ROOT / "requirements" / "dev.lock"

EXTRA_IS_ABSENT = """
import importlib.util, sys
sys.exit(any(importlib.util.find_spec(name) for name in ("pydantic", "scipy", "xarray")))
"""
ASK = """
import sys, magtiles.catalog
release = magtiles.catalog.open_release(sys.argv[1])
latitude, longitude, height = map(float, sys.argv[2:])
total, gradient = release.anomaly.total_with_gradient(latitude, longitude, height)
print(float(total), *map(float, gradient))
"""


class Environment:
    """A fresh virtual environment with the wheel, used from an empty folder."""

    def __init__(self, folder: Path, requirement: str, constraints: Path) -> None:
        self.folder = folder
        venv.create(folder / "venv", with_pip=True)
        pip = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-input"]
        # Most modules are never imported: to compile them all takes as long as all the rest.
        options = ["--no-compile", "--constraint", str(constraints)]
        self.run("python", *pip, *options, requirement)

    def run(self, program: str, *arguments: str, expect: int = 0) -> str:
        """Standard output of a program of the environment; both outputs are shown on a surprise."""
        done = subprocess.run(
            [self.folder / "venv" / "bin" / program, *arguments],
            cwd=self.folder,
            env={k: v for k, v in os.environ.items() if not k.startswith("PYTHON")},
            capture_output=True,
            text=True,
        )
        if done.returncode != expect or "Traceback" in done.stderr:
            sys.exit(
                f"{program} {' '.join(arguments)}: exit {done.returncode}, expected {expect}\n"
                f"{done.stdout}{done.stderr}"
            )
        return done.stdout if expect == 0 else done.stderr


def constraints_of(lock: Path) -> str:
    """The pins of a lock without its hashes, which pip would then want of our wheel, too."""
    return "\n".join(re.findall(r"^([A-Za-z0-9][^\\\n]*?) \\$", lock.read_text("utf-8"), re.M))


def use_pipeline(environment: Environment) -> Path:
    """Make the sample, build and validate its release; returns the folder of the release."""
    environment.run("magtiles", "sample", "sample")
    built = environment.run("magtiles", "build", "sample/demo.toml", "--store", "store", "--json")
    release = environment.folder / json.loads(built)["path"]
    environment.run("magtiles", "validate", str(release))
    return release


def refuse_without_pipeline(environment: Environment) -> None:
    """The reader alone says what to install for the rest."""
    environment.run("python", "-c", EXTRA_IS_ABSENT)
    said = environment.run("magtiles", "build", "x.toml", "--store", "store", expect=2)
    if 'pip install "magtiles[pipeline]"' not in said:
        sys.exit(f"magtiles build does not say what to install: {said}")


def position_in(release: Path) -> list[str]:
    """Latitude, longitude and height of a place in the middle of a release."""
    manifest = json.loads((release / "manifest.json").read_text("utf-8"))
    tiles = [file for file in manifest["files"] if file["role"] == "tile"]
    tile = tiles[len(tiles) // 2]
    levels = manifest["heights_m"]
    middle = [sum(tile["bounds"][axis]) / 2 for axis in ("latitude", "longitude")]
    return [repr(value) for value in (*middle, (levels[0] + levels[-1]) / 2)]


def ask(environment: Environment, release: Path) -> tuple[list[float], dict[str, object]]:
    """What the library and the command line of an environment say at one position."""
    latitude, longitude, height = place = position_in(release)
    numbers = environment.run("python", "-c", ASK, str(release), *place).split()
    options = [f"--lat={latitude}", f"--lon={longitude}", f"--height={height}", "--json"]
    answer = json.loads(environment.run("magtiles", "query", str(release), *options))
    return [float(number) for number in numbers], answer


def main() -> None:
    """Run both; any surprise ends the program with a message."""
    (wheel,) = Path(sys.argv[1]).resolve().glob("*.whl")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        constraints = folder / "constraints.txt"
        constraints.write_text(constraints_of(LOCK), encoding="utf-8")
        reader = Environment(folder / "reader", str(wheel), constraints)
        refuse_without_pipeline(reader)
        print(f"reader only: {reader.run('magtiles', '--version').strip()} refuses to build")
        pipeline = Environment(folder / "pipeline", f"{wheel}[pipeline]", constraints)
        release = use_pipeline(pipeline)
        print(f"[pipeline]: built and validated {release.name} of {release.parent.name}")
        numbers, answer = ask(pipeline, release)
        if ask(reader, release) != (numbers, answer) or numbers[0] != answer["anomaly"]:
            sys.exit(f"the reader alone answers otherwise than {numbers}, {answer}")
        print(f"reader only: opens it and answers the same, {numbers[0]:.3f} nT")


if __name__ == "__main__":
    main()
