"""Foreign netCDF and HDF5: what is refused before it is read, and what a child may do."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import netCDF4
import numpy as np
import pytest
import xarray as xr

from magtiles.schemas.errors import FormatError
from magtiles.stages.ingest import foreign
from magtiles.stages.ingest.foreign import read_foreign
from magtiles.stages.ingest.hdf5_checks import check_hdf5


def dataset() -> xr.Dataset:
    """Kinds of arrays and attributes that formats have."""
    rng = np.random.default_rng(7)
    packed = {"scale_factor": 0.1, "valid_range": np.array([-5, 5], "i2"), "units": "nT"}
    variables: dict[str, Any] = {
        "grid": (("y", "x"), rng.normal(size=(30, 20)).astype("f4"), {"units": "nT"}),
        "packed": (("y", "x"), rng.integers(-9, 9, (30, 20)).astype("i2"), packed),
        "scalar": ((), np.float64(1.5)),
        "letters": (("x",), np.array([b"a"] * 20)),
    }
    axes = {"y": np.arange(30.0), "x": np.arange(20.0)}
    return xr.Dataset(variables, axes, {"title": "a file", "numbers": np.array([1.5, 2.0])})


@pytest.mark.parametrize(
    ("engine", "form"), [("netcdf4", "NETCDF4"), ("scipy", "NETCDF3_CLASSIC")], ids=["4", "3"]
)
def test_arrays_and_attributes_arrive_as_they_are_stored(
    engine: Any, form: Any, tmp_path: Path
) -> None:
    written, path = dataset(), tmp_path / "a.nc"
    encoding = {name: {"_FillValue": None} for name in written.variables}
    written.to_netcdf(path, engine=engine, format=form, encoding=encoding)
    found = read_foreign(path)
    assert set(found.variables) == set(written.variables)
    for name, variable in found.variables.items():
        stored = written[name]
        assert variable.values is not None
        assert variable.dims[: stored.ndim] == stored.dims
        np.testing.assert_array_equal(variable.values.reshape(stored.shape), stored.values)
        assert variable.values.dtype == stored.dtype
    limits = found.variables["packed"].attrs["valid_range"]
    assert (limits.dtype, limits.tolist()) == (np.dtype("i2"), [-5, 5])
    assert found.attrs["title"] == "a file"
    np.testing.assert_array_equal(found.attrs["numbers"], [1.5, 2.0])


def test_of_hdf5_only_what_is_asked_for_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["flux/x"] = np.arange(5.0)
        file["flux/x"].attrs["units"] = "nT"
        file["name"] = ["one", "zwölf"]
        file["again"] = file["name"]  # a second hard link
    found = read_foreign(path, ["flux/x", "name", "missing"]).variables
    assert {name: v.values is None for name, v in found.items()} == {
        "again": True, "flux/x": False, "name": False,
    }  # fmt: skip
    assert found["flux/x"].attrs == {"units": "nT"}
    assert found["name"].values.tolist() == ["one", "zwölf"]


class Hostile(NamedTuple):
    make: Callable[[h5py.File, Path], Any]
    message: str


def virtual(file: h5py.File, folder: Path) -> None:
    with h5py.File(folder / "other.nc", "w") as other:
        other["m"] = np.zeros(10)
    layout = h5py.VirtualLayout((10,), "f8")
    layout[:] = h5py.VirtualSource(str(folder / "other.nc"), "m", shape=(10,))
    file.create_virtual_dataset("m", layout)


def foreign_filter(file: h5py.File, _: Path) -> None:
    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_chunk((10,))
    plan.set_filter(32_333, h5py.h5z.FLAG_OPTIONAL, (1,))
    space = h5py.h5s.create_simple((100,))
    h5py.h5d.create(file.id, b"m", h5py.h5t.NATIVE_DOUBLE, space, plan)


def outside(file: h5py.File, folder: Path) -> None:
    (folder / "secret").write_bytes(b"secret! " * 100)
    file.create_dataset("g/m", (100,), "f8", external=[(str(folder / "secret"), 0, 800)])


def ring(file: h5py.File, _: Path) -> None:
    below = file.create_group("a/b")
    below["up"] = file["a"]


HOSTILE = [
    Hostile(outside, r"'/g/m' lies in other files: its values are in .*secret"),
    Hostile(virtual, "'/m' lies in other files: it is a virtual dataset"),
    Hostile(
        lambda f, _: f.create_dataset("m", (1 << 43,), "f8", chunks=(1 << 20,)),
        "declares 70368744177664 bytes of arrays, more than a file of its size can hold",
    ),
    Hostile(
        lambda f, _: f.__setitem__("m", h5py.ExternalLink("other.nc", "/m")),
        r"'/m' is a link to another file, other\.nc",
    ),
    Hostile(lambda f, _: f.__setitem__("m", h5py.SoftLink("/x")), "'/m' is a link and no object"),
    Hostile(foreign_filter, "'/m' is packed by filter 32333, which is not of HDF5"),
    Hostile(ring, "'/a/b/up' is a group that has another name, too"),
    Hostile(
        lambda f, _: [f.create_group(str(i)) for i in range(10_001)], "more than 10000 objects"
    ),
]


@pytest.mark.parametrize("case", HOSTILE, ids=lambda case: case.message)
def test_a_hostile_file_is_refused(case: Hostile, tmp_path: Path) -> None:
    path = tmp_path / "a.nc"
    with h5py.File(path, "w") as file:
        case.make(file, tmp_path)
    with pytest.raises(FormatError, match=case.message) as direct:
        check_hdf5(path)
    assert str(path) in str(direct.value)
    with pytest.raises(FormatError, match=case.message) as caught:
        read_foreign(path)
    assert str(caught.value) == str(direct.value)


def test_more_than_the_cap_is_refused_even_where_the_file_could_hold_it(tmp_path: Path) -> None:
    path = tmp_path / "a.nc"
    with netCDF4.Dataset(path, "w") as file:
        file.createDimension("x", 1 << 31)
        file.createVariable("m", "f8", ("x",), chunksizes=(1 << 20,))
    with path.open("ab") as data:
        data.truncate(64 << 20)  # sparse
    with pytest.raises(FormatError, match="declares 17179869184 bytes of arrays; expected at most"):
        read_foreign(path)


CUTS = [
    ("NETCDF4", 0.5, "is not a whole netCDF file"),
    ("NETCDF4", 0.01, "is not a whole netCDF file"),
    ("NETCDF3_CLASSIC", 0.9, "is not a whole netCDF file"),
]


@pytest.mark.parametrize(("form", "share", "message"), CUTS)
def test_a_cut_file_is_refused(form: Any, share: float, message: str, tmp_path: Path) -> None:
    path = tmp_path / "a.nc"
    engine: Any = "netcdf4" if form == "NETCDF4" else "scipy"
    dataset().to_netcdf(path, engine=engine, format=form)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(FormatError, match=message):
        read_foreign(path)


DEATHS = [
    ("import os; os.abort()", r"made its reader crash \(SIGABRT\)"),
    (
        "import os, signal; os.kill(os.getpid(), signal.SIGXCPU)",
        "took too long, or too much memory",
    ),
    ("raise ImportError('no h5py')", "could not be read: ImportError: no h5py"),
    ("import os; os.write(1, b'\\xff' * 99)", "could not be read"),
    ("import os; os.write(1, b'\\x00' * 7)", "could not be read"),
]


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
@pytest.mark.parametrize(("program", "message"), DEATHS, ids=[m for _, m in DEATHS])
def test_a_child_that_dies_is_an_error(
    program: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "dying.py").write_text(f"import sys; sys.stdin.read()\n{program}\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(foreign, "CHILD", "dying")
    (tmp_path / "a.nc").touch()
    with pytest.raises(FormatError, match=rf"a\.nc: {message}"):
        read_foreign(tmp_path / "a.nc")


MEANS = """
import resource, sys
import numpy as np
from magtiles.stages.ingest.foreign_child import limit_means
limit_means(1000)
try:
    np.ones(3 << 27)  # 3 GiB
except MemoryError:
    print("memory", end=" ")
try:
    with open(sys.argv[1], "wb") as file:
        file.write(b"x" * 100_000)
except OSError:
    print("files", end=" ")
print(resource.getrlimit(resource.RLIMIT_CORE)[0], resource.getrlimit(resource.RLIMIT_CPU)[0])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="macOS sets no limit of the address space")
def test_the_child_has_little_memory_and_time_and_no_files(tmp_path: Path) -> None:
    ended = subprocess.run(
        [sys.executable, "-c", MEANS, str(tmp_path / "out")],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert ended.stdout.split() == ["memory", "files", "0", "60"]
    assert (tmp_path / "out").stat().st_size == 0
