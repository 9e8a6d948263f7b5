"""The report: one page that stands alone, true to the release it is about."""

from __future__ import annotations

import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from magtiles.catalog.releases.manifest import read_manifest
from magtiles.pipeline.main import main
from magtiles.pipeline.report import _caption
from magtiles.pipeline.report_figures import radial_power


class Page(HTMLParser):
    """Collects text, image sources, links, and whether tags close."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.sources: list[str] = []
        self.words = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in ("meta", "img"):
            self.open.append(tag)
        self.sources += [value or "" for name, value in attrs if name in ("src", "href")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words += data


@pytest.fixture
def page(exact_release: Path, tmp_path: Path) -> Page:
    out = tmp_path / "page.html"
    assert main(["report", str(exact_release), "--out", str(out)]) == 0
    return Page(out.read_text(encoding="utf-8"))


def test_the_page_stands_alone(page: Page) -> None:
    assert page.open == []  # every tag is closed
    assert len(page.sources) >= 2
    assert all(source.startswith("data:image/png;base64,") for source in page.sources)
    assert "<script" not in page.rawdata


def test_the_page_says_what_the_release_is(page: Page, exact_release: Path) -> None:
    manifest = read_manifest(exact_release)
    for text in ("exact 1.2.3", manifest.manifest_digest, "overlaps", "void filled", "CC0-1.0"):
        assert text in page.words
    assert re.search(r"\d+ checks passed", page.words)


def test_the_same_release_gives_the_same_bytes(exact_release: Path, tmp_path: Path) -> None:
    pages = []
    for name in ("a.html", "b.html"):
        assert main(["report", str(exact_release), "--out", str(tmp_path / name)]) == 0
        pages.append((tmp_path / name).read_bytes())
    assert pages[0] == pages[1]


def test_a_failed_check_is_shown(release_copy: Path, tmp_path: Path) -> None:
    tile = next((release_copy / "tiles").glob("*.nc"))
    data = bytearray(tile.read_bytes())
    data[len(data) // 2] ^= 1
    tile.write_bytes(data)
    out = tmp_path / "page.html"
    assert main(["report", str(release_copy), "--out", str(out)]) == 1
    words = Page(out.read_text(encoding="utf-8")).words
    assert re.search(r"\d of \d+ checks FAILED", words)
    assert words.count("sha256") > 2  # in the check, and where the figures would be


def test_no_release(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.rmtree(tmp_path / "none", ignore_errors=True)
    assert main(["report", str(tmp_path / "none"), "--out", str(tmp_path / "page.html")]) == 1
    assert "is no release" in capsys.readouterr().err
    assert not (tmp_path / "page.html").exists()


class TestRadialPower:
    """Parseval and a single wave, both known in closed form."""

    def test_white_noise_has_the_density_of_its_variance(self) -> None:
        noise = 3.0 * np.random.default_rng(1).standard_normal((256, 300))
        _, power = radial_power(noise, (400.0, 250.0))
        # s^2 dy dx = 9 x 0.4 x 0.25 nT^2 km^2; over all rings known to about 1 %.
        assert np.median(power) == pytest.approx(0.9, rel=0.1)

    def test_a_wave_peaks_at_its_wavelength(self) -> None:
        y = 500.0 * np.arange(256)[:, None] * np.ones(256)
        wavelength, power = radial_power(np.sin(2 * np.pi * y / 16_000.0), (500.0, 500.0))
        assert wavelength[np.argmax(power)] == pytest.approx(16_000.0, rel=0.07)


@pytest.mark.parametrize(
    ("stem", "caption"),
    [
        ("1500m", "Level 1500 m: total-field anomaly, its uncertainty and flags"),
        ("temporal-BOU-sigma-tau", "Observatory BOU: sigma and tau"),
        ("road-high-street-backward-field", "Road high-street-backward: field"),
    ],
)
def test_captions_are_words(stem: str, caption: str) -> None:
    assert _caption(stem) == caption
