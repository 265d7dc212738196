"""The doctor finds what is missing and names the remedy that really mends it."""

import sys
from importlib import metadata

import pytest

from p2p_lib.apps import doctor
from p2p_lib.apps.doctor import run_doctor
from p2p_lib.core import native
from p2p_lib.core.errors import MissingBackend
from p2p_lib.core.findings import Finding, Level, as_lines
from p2p_lib.core.packages import EXTRAS


@pytest.fixture(scope="module")
def checks() -> dict[str, Finding]:
    return {check.name: check for check in run_doctor()}


def test_every_required_package_is_imported_for_real(checks):
    light, extras = doctor.packages_of(), [doctor.packages_of(name) for name in EXTRAS]
    assert {"numpy", "gtsam", "opencv-python-headless"} <= set(light) and not {"torch", "pytest"} & set(light)
    assert {"torch", "open3d", "papermill"} <= set().union(*extras)
    required = [name for of in (light, *extras) for name in of if doctor._installed(name)]
    missing = [library for library in native.SYSTEM_LIBRARIES if not checks[library].fine]
    for name in set(required) - {"libusb-package"}:
        if name == "open3d" and missing:
            assert not checks[name].fine and checks[name].fix == native.install_command(missing)
        else:
            assert checks[name].fine and checks[name].text == metadata.version(name), checks[name]


def test_looks_at_everything_promised(checks):
    promised = {
        *native.SYSTEM_LIBRARIES,
        *doctor.OPTIONAL,
        *(f"extra {name}" for name in EXTRAS),
        "Python",
        "GPU",
        "cotracker",
        "$P2P_DATA",
        "cache folder",
        "disk",
    }
    assert promised <= checks.keys()
    assert all(check.fine or check.fix for check in checks.values())


def test_no_optional_part_is_called_required(checks):
    names = (*doctor.OPTIONAL, *(f"extra {name}" for name in EXTRAS), "cotracker", "GPU", "$P2P_DATA")
    assert Level.WRONG not in {checks[name].level for name in names}


def test_what_was_left_out_on_purpose_is_not_wrong(monkeypatch, checks):
    """A light install, for which all else is out of reach; a full disk is as wrong as before."""
    light = set(doctor.packages_of())
    monkeypatch.setattr(doctor, "_installed", lambda name: name in light)
    monkeypatch.setattr(native, "loads", lambda library: False)
    found = {finding.name: finding for finding in run_doctor()}
    wrong = {finding.name for finding in found.values() if finding.level is Level.WRONG}
    assert wrong <= {check.name for check in checks.values() if check.level is Level.WRONG}
    assert not {"torch", "Jupyter kernel", *native.SYSTEM_LIBRARIES} & found.keys()
    view = found["extra view"]
    assert view.fix.endswith('pip install "p2p_lib[view]"') and "not installed: av, " in view.text


def test_a_broken_package_is_found_with_its_last_words(monkeypatch):
    monkeypatch.setitem(doctor.MODULES, "torch", "no_such_module")
    check = doctor._package("torch")
    assert check.level is Level.WRONG
    assert check.text == "ModuleNotFoundError: No module named 'no_such_module'" and check.fix == "make setup"


def test_a_crash_while_importing_is_survived(monkeypatch):
    assert doctor._fails("import os; os.kill(os.getpid(), 4)").startswith("ended by signal 4")
    assert doctor._fails("import sys; sys.exit(3)") == "no message"
    assert doctor._fails("pass") == ""


def test_a_missing_library_names_its_package(monkeypatch):
    monkeypatch.setattr(native, "loads", lambda library: False)
    monkeypatch.setattr(native.shutil, "which", lambda name: "apt-get")
    check = doctor._library("libEGL.so.1", "libegl1")
    assert not check.fine and check.fix.endswith("apt-get install -y libegl1")


def test_libusb_of_the_wheel_stands_in_for_the_systems(monkeypatch):
    pytest.importorskip("libusb_package")
    real = native.loads
    monkeypatch.setattr(native, "loads", lambda library: library != "libusb-1.0.so.0" and real(library))
    check = doctor._library("libusb-1.0.so.0", "libusb-1.0-0")
    assert check.fine and "libusb-package" in check.text


def test_open3d_without_its_libraries_is_a_missing_backend(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)  # any import of it fails now
    monkeypatch.setattr(native, "missing_libraries", lambda: ["libEGL.so.1", "libX11.so.6"])
    monkeypatch.setattr(native.shutil, "which", lambda name: "apt-get")
    with pytest.raises(MissingBackend, match=r"libEGL.so.1, libX11.so.6\. Run: .*apt-get install -y libegl1 libx11-6$"):
        native.load_open3d()


def test_without_apt_the_libraries_are_named(monkeypatch):
    monkeypatch.setattr(native.shutil, "which", lambda name: None)
    assert native.install_command(["libGL.so.1"]) == "install libGL.so.1 with your system's package manager"


def test_folders_are_looked_at(monkeypatch, tmp_path):
    monkeypatch.setenv("P2P_DATA", str(tmp_path / "gone"))
    assert not doctor._data().fine and "does not exist" in doctor._data().text
    monkeypatch.setenv("P2P_DATA", str(tmp_path))
    assert doctor._data().fine
    monkeypatch.setenv("P2P_CACHE", str(tmp_path / "cache"))
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache" / "x").write_bytes(bytes(3_000_000))
    assert doctor._cache().fine and doctor._cache().text.endswith("cache, 3 MB used")


def test_report_for_people():
    findings = [
        Finding("torch", Level.OK, "2.13"),
        Finding("dask", Level.OPTIONAL, "not installed", "install dask"),
        Finding("open3d", Level.WRONG, "ImportError", "make setup"),
    ]
    lines = as_lines(findings, "all there").splitlines()
    assert [line.split()[0] for line in lines] == ["ok", "-", "->", "WRONG", "->", "To"]
    assert lines[-1] == "To mend first: open3d" and lines[1].index("not") == lines[2].index("->")
    assert as_lines(findings[:2], "all there").splitlines()[-1] == "all there"
