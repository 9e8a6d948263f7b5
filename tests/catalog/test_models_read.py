"""Files of models: every format read back exactly, and every way to be wrong told with its line."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from gauss import RADIUS_KM, cof_rows, random_crust, shc_text

from magtiles.catalog.kernels.harmonics import count
from magtiles.catalog.models import FieldModel, load_igrf, parse_model, read_model
from magtiles.schemas.errors import FormatError, QueryError

NINES = "9" * 48


def written(path: Path, text: str) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    return path


def wmm(gauss: np.ndarray, rates: np.ndarray) -> str:
    rows = cof_rows(gauss, 1, 10_000, rates)
    return "\n".join(["    2025.0            WMM-2025     11/13/2024", *rows, NINES, NINES, ""])


def test_igrf_from_its_package() -> None:
    model = load_igrf()
    assert (model.name, model.n_min, model.n_max) == ("IGRF14", 1, 13)
    assert model.valid == (1900.0, 2030.0)
    assert model.coefficients.shape == (27, 195)
    assert model.at(2020.0)[:3].tolist() == [-29403.41, -1451.37, 4653.35]  # g10 g11 h11
    with pytest.raises(QueryError, match="no IGRF of generation 12; expected 13 or 14"):
        load_igrf(12)


@pytest.mark.parametrize(
    ("file", "n_max", "valid", "varies"),
    [
        ("IGRF13.shc", 13, (1900.0, 2025.0), False),
        ("LCS-1.shc", 185, (-math.inf, math.inf), False),
        ("WMM_2010.COF", 12, (2010.0, 2015.0), True),
        ("WMM2015v2.COF", 12, (2015.0, 2020.0), True),
    ],
)
def test_published_files(
    real_data: Path, file: str, n_max: int, valid: tuple[float, float], varies: bool
) -> None:
    model = read_model(real_data / "harmonics" / file)
    assert (model.n_max, model.valid) == (n_max, valid)
    assert (model.secular_variation is not None) is varies


def test_shc_read_back(tmp_path: Path) -> None:
    epochs = np.array([2000.0, 2005.0, 2012.5])
    values = np.stack([random_crust(3, 20, 100.0, seed) for seed in range(3)])
    model = FieldModel("x", 3, 20, RADIUS_KM, epochs, values, None, (2000.0, 2012.5))
    read = read_model(written(tmp_path / "x.shc", shc_text(model)))
    np.testing.assert_array_equal(read.coefficients, values)
    np.testing.assert_array_equal(read.epochs, epochs)
    assert (read.name, read.n_min, read.n_max, read.valid) == ("x", 3, 20, (2000.0, 2012.5))


def test_shc_of_a_spline_of_order_six() -> None:
    """As CHAOS is distributed: five samples a piece, and the next piece's first."""
    pieces, rng = 4, np.random.default_rng(5)
    knots = 2000.0 + 0.5 * np.arange(pieces + 1)
    # In powers of the time in a piece; bent by some 20 nT a year squared.
    curves = rng.normal(size=(pieces, 3, 6)) * [1e4, 20.0, 5.0, 1.0, 0.2, 0.05]
    for p in range(1, pieces):
        curves[p, :, 0] = curves[p - 1].sum(axis=-1)

    def truth(year: float) -> np.ndarray:
        p = min(int((year - 2000.0) / 0.5), pieces - 1)
        return curves[p] @ ((year - knots[p]) / 0.5) ** np.arange(6)

    times = np.linspace(2000.0, knots[-1], 5 * pieces + 1)
    rows = np.array([truth(t) for t in times]).T
    text = [f"1 1 {len(times)} 6 5", " ".join(map(repr, times.tolist()))]
    for m, row in zip((0, 1, -1), rows, strict=True):
        text.append(f"1 {m} " + " ".join(map(repr, row.tolist())))
    model = parse_model("\n".join(text), "chaos.shc")
    assert model.valid == (2000.0, 2002.0)
    years = rng.uniform(2000.0, 2002.0, 200)
    apart = [np.abs(model.at(y) - truth(y)).max() for y in years]
    assert max(apart) < 1.2e-3  # nT; straight lines between the samples themselves: 0.05


def test_wmm_read_back(tmp_path: Path) -> None:
    gauss, rates = random_crust(1, 133, 100.0), random_crust(1, 133, 1.0, seed=2)
    model = read_model(written(tmp_path / "WMMHR.COF", wmm(gauss, rates)))
    np.testing.assert_array_equal(model.coefficients[0], gauss)
    np.testing.assert_array_equal(model.secular_variation, rates)
    assert (model.name, model.n_max, model.valid) == ("WMM-2025", 133, (2025.0, 2030.0))


@pytest.mark.parametrize(
    ("n_min", "valid"), [(16, (-math.inf, math.inf)), (1, (2015.0, 2015.0))], ids=["crust", "main"]
)
def test_cof_without_secular_variation(n_min: int, valid: tuple[float, float]) -> None:
    gauss = random_crust(n_min, 29, 100.0)
    text = "\n".join(["2015.0 SAMPLE", *cof_rows(gauss, n_min, order=18)])
    model = parse_model(text, "sample.cof")
    assert (model.n_min, model.n_max, model.valid) == (n_min, 29, valid)
    stops = np.array([abs(m) <= 18 for n in range(1, 30) for m in orders(n)])
    np.testing.assert_array_equal(model.coefficients[0], np.where(stops, gauss, 0.0))


def orders(n: int) -> list[int]:
    return [0] + [sign * m for m in range(1, n + 1) for sign in (1, -1)]


def emm_set(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """EMM2000 to 2002 as published: low degrees yearly, all in the last, rates in SV files."""
    yearly = np.stack([random_crust(1, 5, 1000.0, seed) for seed in range(3)])
    full = random_crust(1, 40, 100.0, seed=9)
    full[: count(5)] = yearly[2]
    rates = random_crust(1, 5, 10.0, seed=10)
    for i, gauss in enumerate((yearly[0], yearly[1], full)):
        head = f"{2000 + i}.0 EMM-{2000 + i} 07/01/2017"
        written(folder / f"EMM{2000 + i}.COF", "\n".join([head, *cof_rows(gauss, 1, 36)]))
        written(folder / f"EMM{2000 + i}SV.COF", "\n".join(cof_rows(rates)))
    return np.stack([np.concatenate([y, full[count(5) :]]) for y in yearly]), rates


def test_emm_set(tmp_path: Path, real_data: Path) -> None:
    coefficients, rates = emm_set(tmp_path)
    limited = np.array([abs(m) <= 36 for n in range(1, 41) for m in orders(n)])
    model = read_model(tmp_path)
    np.testing.assert_array_equal(model.coefficients, np.where(limited, coefficients, 0.0))
    np.testing.assert_array_equal(model.secular_variation[: count(5)], rates)
    assert not model.secular_variation[count(5) :].any()
    assert (model.name, model.valid) == ("EMM2002", (2000.0, 2007.0))
    # A published file of secular variation, with lines of text before its rows.
    sv = (real_data / "harmonics" / "EMM-720_V3p0_secvar.cof").read_text()
    written(tmp_path / "EMM2002SV.COF", sv)
    found = read_model(tmp_path).secular_variation
    assert found[:3].tolist() == [10.9262, 19.1350, -29.5848]
    assert found[count(16) - 2 : count(16)].tolist() == [-0.0167, 0.0033]  # g16,16 h16,16


def geographiclib(
    path: Path, sets: list[tuple[int, int, np.ndarray]], full: bool, **more: object
) -> Path:
    """Write a model as GeographicLib has it: text, and binary sets (degree, order, gauss)."""
    meta = {
        "Name": "wmm2010", "Radius": 6371200, "NumModels": 2, "NumConstants": 1, "Epoch": 2010,
        "DeltaEpoch": 2.5, "MinTime": 2010, "MaxTime": 2015, "ID": "WMM2010A",
        "Normalization": "full" if full else "schmidt", **more,
    }  # fmt: skip
    lines = ["WMMF-2", "# a comment", *(f"{k} {v} # another" for k, v in meta.items())]
    written(path, "\n".join(lines))
    data = b"WMM2010A"
    for degree, order, gauss in sets:
        data += struct.pack("<ii", degree, order)
        for sine in (0, 1):
            for m in range(sine, order + 1):
                for n in range(m, degree + 1):
                    g = gauss[n * n - 1 + (2 * m - 1 + sine if m else 0)] if n else 0.0
                    data += struct.pack("<d", g / math.sqrt(2 * n + 1) if full else g)
    path.with_name(path.name + ".cof").write_bytes(data)
    return path


def make_geographiclib(folder: Path, full: bool = False, **more: object) -> Path:
    sets = [(5, 5, 1.0), (5, 5, 2.0), (4, 4, 0.1), (12, 9, 3.0)]
    made = [(n, m, random_crust(1, n, rms)) for n, m, rms in sets]
    return geographiclib(folder / "wmm2010.wmm", made, full, **more)


@pytest.mark.parametrize("full", [False, True], ids=["schmidt", "full"])
def test_geographiclib_read_back(tmp_path: Path, full: bool) -> None:
    path = make_geographiclib(tmp_path, full)
    model = read_model(path)
    constant = np.array([abs(m) <= 9 for n in range(1, 13) for m in orders(n)])
    constant = np.where(constant, random_crust(1, 12, 3.0), 0.0)
    for row, rms in zip(model.coefficients, (1.0, 2.0), strict=True):
        expected = constant.copy()
        expected[: count(5)] += random_crust(1, 5, rms)
        np.testing.assert_allclose(row, expected, rtol=1e-14, atol=1e-15)
    np.testing.assert_allclose(
        model.secular_variation[: count(4)], random_crust(1, 4, 0.1), rtol=1e-14
    )
    assert model.epochs.tolist() == [2010.0, 2012.5]
    assert (model.name, model.n_max, model.valid) == ("wmm2010", 12, (2010.0, 2015.0))
    by_binary = read_model(tmp_path / "wmm2010.wmm.cof")
    np.testing.assert_array_equal(by_binary.coefficients, model.coefficients)


SHC = shc_text(
    FieldModel(
        "x", 1, 3, RADIUS_KM, np.array([2000.0]), random_crust(1, 3, 1.0)[None], None, (0.0, 1.0)
    )
)
WMM = wmm(random_crust(1, 4, 1.0), random_crust(1, 4, 0.1))
COF = "\n".join(["2015.0 SAMPLE", *cof_rows(random_crust(1, 6, 1.0), 1, 4)])


class Expect(NamedTuple):
    text: str
    message: str
    id: str


def without(text: str, number: int) -> str:
    return "\n".join(line for i, line in enumerate(text.splitlines(), 1) if i != number)


def replaced(text: str, number: int, new: str) -> str:
    return "\n".join(new if i == number else line for i, line in enumerate(text.splitlines(), 1))


@pytest.mark.parametrize(
    "case",
    [
        Expect("", "bad: is empty", "empty"),
        Expect("some words\n", "bad line 1: is no model of a known format", "foreign"),
        Expect("<html><p>404</p>\n", "bad line 1: is an HTML page; expected SHC", "page"),
        Expect(SHC[: SHC.rindex("3 -3")], "line 17: degree 3, order -3 is missing", "shc-cut"),
        Expect(SHC[: SHC.rindex("3 -3") + 4], "line 18: 2 columns", "shc-cut-in-line"),
        Expect(without(SHC, 8), "degree 2, order 1 is missing", "shc-order-missing"),
        Expect(SHC.replace("1 3 1 2 1", "1 4 1 2 1"), "degree 4, order 0 is missing", "few"),
        Expect(SHC.replace("1 3 1 2 1", "1 2 1 2 1"), "line 12: degree 3; expected", "many"),
        Expect(SHC.replace("1 3 1 2 1", "2 3 1 2 1"), "line 4: degree 1; expected 2", "degree-low"),
        Expect(SHC.replace("1 3 1 2 1", "3 1 1 2 1"), "line 2: no header of SHC", "shc-header"),
        Expect(SHC.replace("1 3 1 2 1", "1 3 2 2 1"), "line 3: 1 times; expected 2", "shc-times"),
        Expect(replaced(SHC, 3, "2000 x"), "line 3: could not convert", "shc-time-word"),
        Expect(replaced(SHC, 5, "1 1 nan"), "line 5: a coefficient is not finite", "shc-nan"),
        Expect(replaced(SHC, 5, "1 1 1e5x"), "line 5: could not convert", "shc-word"),
        Expect(replaced(SHC, 6, "1 1 3.0"), "line 6: degree 1, order 1 comes twice", "shc-twice"),
        Expect(replaced(SHC, 6, "1 2 3.0"), "line 6: degree 1, order 2; expected", "order-high"),
        Expect("\n".join(SHC.splitlines()[:3]), "line 3: ends after its header", "shc-header-only"),
        Expect("1 1 7 6 4\n1 2 3 4 5 6 7\n1 0 1 2 3 4 5 6 7\n1 1 1 2 3 4 5 6 7\n"
               "1 -1 1 2 3 4 5 6 7", "line 1: 7 times in 4 steps", "spline-steps"),
        Expect("1 1 2 1 1\n2000 2001\n", "line 1: a spline of order 1 over 2", "spline-order"),
        Expect(WMM.replace(NINES, ""), "line 15: no line of nines at the end", "wmm-cut"),
        Expect(WMM[: len(WMM) // 2], "line 9: no line of nines", "wmm-cut-in-line"),
        Expect(without(WMM, 9), "degree 3, order 2 is missing", "wmm-order-missing"),
        Expect(WMM.splitlines()[0], "line 1: ends after its header", "wmm-header-only"),
        Expect(f"2025.0 WMM\n{NINES}", "line 2: 1 columns", "wmm-nothing"),
        Expect(replaced(WMM, 5, "2 2 1.0 2.0"), "line 5: 4 columns", "wmm-columns"),
        Expect(replaced(COF, 5, "2 -1 1.0 2.0"), "line 5: degree 2, order -1", "cof-negative"),
        Expect(COF[: COF.rindex("6   4")], "degree 6, order 4 is missing", "cof-cut"),
        Expect(without(COF, 5), "degree 2, order 1 is missing", "cof-order-missing"),
    ],
    ids=lambda case: case.id,
)  # fmt: skip
def test_text_that_is_no_model(case: Expect, tmp_path: Path) -> None:
    with pytest.raises(FormatError) as caught:
        read_model(written(tmp_path / "bad", case.text))
    assert case.message in str(caught.value)


def drop(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def write(name: str, text: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_text(text) and None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (drop("EMM2001.COF"), "EMM2001.COF is missing"),
        (drop("EMM2002SV.COF"), "EMM2002SV.COF is missing"),
        (write("EMM2001.COF", "2003.0 EMM\n1 0 1 0\n1 1 1 1"), "EMM2001.COF line 1: epoch 2003"),
        (write("EMM2001.COF", ""), "EMM2001.COF: is empty"),
        (write("EMM2001.COF", "1 0 1 0\n1 1 1 1"), "EMM2001.COF line 1: no header of COF"),
        (write("EMM2002.COF", "2002 EMM\n1 0 1 0\n1 1 1 1"), "EMM2000.COF: degrees 1 to 5"),
        (write("EMM2002SV.COF", "no rows"), "EMM2002SV.COF: no coefficients"),
        (write("EMM2002SV.COF", "1 0 1 0\n1 1 1 x"), "EMM2002SV.COF line 2: could not convert"),
    ],
)
def test_damaged_emm_set(change: Callable[[Path], None], message: str, tmp_path: Path) -> None:
    emm_set(tmp_path)
    change(tmp_path)
    with pytest.raises(FormatError) as caught:
        read_model(tmp_path)
    assert message in str(caught.value)


def test_folder_without_models(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"no files of the EMM; expected EMM2000\.COF"):
        read_model(tmp_path)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"ID": "OTHER"}, "byte 0: id is b'WMM2010A'; expected OTHER"),
        ({"Epoch": "soon"}, "line 7: Epoch is 'soon'; expected a number"),
        ({"NumModels": 0.5}, "line 5: NumModels is '0.5'"),
        ({"NumModels": 9}, "ends before a set of coefficients"),
        ({"NumConstants": 0}, "bytes too many"),
        ({"Type": "cubic"}, "Type is 'cubic'; expected linear"),
        ({"ByteOrder": "big"}, "ByteOrder is 'big'"),
        ({"Normalization": "odd"}, "Normalization is 'odd'"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_damaged_geographiclib(more: dict[str, object], message: str, tmp_path: Path) -> None:
    path = make_geographiclib(tmp_path, **more)
    with pytest.raises(FormatError) as caught:
        read_model(path)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("end", "message"),
    [(4, "byte 0: id is"), (12, "byte 8: ends before"), (300, "byte 8: ends within"), (-1, "ends")],
)
def test_truncated_geographiclib(end: int, message: str, tmp_path: Path) -> None:
    path = make_geographiclib(tmp_path)
    binary = tmp_path / "wmm2010.wmm.cof"
    binary.write_bytes(binary.read_bytes()[:end])
    with pytest.raises(FormatError) as caught:
        read_model(path)
    assert message in str(caught.value)
    binary.unlink()
    with pytest.raises(FormatError, match=r"wmm2010\.wmm\.cof: is missing"):
        read_model(path)


def test_binary_alone(tmp_path: Path) -> None:
    (tmp_path / "x.cof").write_bytes(b"WMM2010A\0\0\0")
    with pytest.raises(FormatError, match=r"x\.cof: is no text"):
        read_model(tmp_path / "x.cof")
