"""A script that builds as it is imported: its workers would build again, and wait for ever."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

from magtiles.pipeline.sample import DEMO, synthesize, write_survey

_SCRIPT = """
from pathlib import Path
from magtiles.pipeline.build import build_product
build_product(Path("product.toml"), store=Path("store"), work=Path("work"))
"""


def test_its_error_tells_what_the_script_lacks(tmp_path: Path) -> None:
    small = replace(DEMO, width_m=60e3, length_m=60e3, dipoles=5, levels_m=(2500.0,))
    text = write_survey(tmp_path, synthesize(small))[-1].read_text()
    (tmp_path / "product.toml").write_text(text + "block_nodes = 128\n")
    (tmp_path / "script.py").write_text(_SCRIPT)
    run = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert run.returncode == 1
    assert "no local cluster can be started" in run.stderr.splitlines()[-1]
    assert "below if __name__ == '__main__':" in run.stderr.splitlines()[-1]
    assert not list((tmp_path / "store").rglob("manifest.json"))
