"""The doctor finds what is missing and names the remedy that really mends it."""

import sys
from importlib import metadata

import pytest

from p2p_lib.apps import doctor
from p2p_lib.apps.doctor import Check, format_checks, run_doctor
from p2p_lib.core import native
from p2p_lib.core.errors import MissingBackend


@pytest.fixture(scope="module")
def checks() -> dict[str, Check]:
    return {check.name: check for check in run_doctor()}


def test_every_required_package_is_imported_for_real(checks):
    required = doctor.required_packages()
    assert {"torch", "open3d", "gtsam", "opencv-python-headless", "papermill"} <= set(required)
    assert not {"pytest", "ruff"} & set(required)
    missing = [library for library in native.SYSTEM_LIBRARIES if not checks[library].ok]
    for name in set(required) - {"libusb-package"}:
        if name == "open3d" and missing:
            assert not checks[name].ok and checks[name].remedy == native.install_command(missing)
        else:
            assert checks[name].ok and checks[name].found == metadata.version(name), checks[name]


def test_looks_at_everything_promised(checks):
    promised = {
        *native.SYSTEM_LIBRARIES,
        *doctor.OPTIONAL,
        "Python",
        "GPU",
        "cotracker",
        "$P2P_DATA",
        "cache folder",
        "disk",
    }
    assert promised <= checks.keys()
    assert all(check.ok or check.remedy for check in checks.values())


def test_no_optional_part_is_called_required(checks):
    assert all(checks[name].optional for name in (*doctor.OPTIONAL, "cotracker", "GPU", "$P2P_DATA"))
    assert not any(checks[name].optional for name in ("torch", "open3d", "libEGL.so.1", "disk"))


def test_a_broken_package_is_found_with_its_last_words(monkeypatch):
    monkeypatch.setitem(doctor.MODULES, "torch", "no_such_module")
    check = doctor._package("torch")
    assert not check.ok and not check.optional
    assert check.found == "ModuleNotFoundError: No module named 'no_such_module'" and check.remedy == "make setup"


def test_a_crash_while_importing_is_survived(monkeypatch):
    assert doctor._fails("import os; os.kill(os.getpid(), 4)").startswith("ended by signal 4")
    assert doctor._fails("import sys; sys.exit(3)") == "no message"
    assert doctor._fails("pass") == ""


def test_a_missing_library_names_its_package(monkeypatch):
    monkeypatch.setattr(native, "loads", lambda library: False)
    monkeypatch.setattr(native.shutil, "which", lambda name: "apt-get")
    check = doctor._library("libEGL.so.1", "libegl1")
    assert not check.ok and check.remedy.endswith("apt-get install -y libegl1")


def test_libusb_of_the_wheel_stands_in_for_the_systems(monkeypatch):
    pytest.importorskip("libusb_package")
    real = native.loads
    monkeypatch.setattr(native, "loads", lambda library: library != "libusb-1.0.so.0" and real(library))
    check = doctor._library("libusb-1.0.so.0", "libusb-1.0-0")
    assert check.ok and "libusb-package" in check.found


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
    assert not doctor._data().ok and "does not exist" in doctor._data().found
    monkeypatch.setenv("P2P_DATA", str(tmp_path))
    assert doctor._data().ok
    monkeypatch.setenv("P2P_CACHE", str(tmp_path / "cache"))
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache" / "x").write_bytes(bytes(3_000_000))
    assert doctor._cache().ok and doctor._cache().found.endswith("cache, 3 MB used")


def test_report_for_people():
    checks = [
        Check("torch", True, False, "2.13"),
        Check("rerun", False, True, "not installed", "install rerun"),
        Check("open3d", False, False, "ImportError", "make setup"),
    ]
    lines = format_checks(checks).splitlines()
    assert [line.split()[0] for line in lines] == ["ok", "-", "->", "MISSING", "->", "To"]
    assert lines[-1] == "To mend: open3d"
    assert format_checks(checks[:2]).splitlines()[-1] == "All that is required is there. A dash is optional."
