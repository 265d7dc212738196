"""The one list of what is ours: each name leaves one mechanism out, and each is used somewhere."""

from pathlib import Path

import pytest

import p2p_lib.extended
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import preset
from p2p_lib.core.errors import BadInput
from p2p_lib.extended.default import MECHANISMS, Point2Pose, chosen, compose
from p2p_lib.method.pipeline import Parts

CAMERA = Camera(300.0, 300.0, 160.0, 120.0, 320, 240)
FOLDER = Path(p2p_lib.extended.__file__).parent


def on(said: str) -> frozenset[str]:
    return chosen(preset().with_values({"method.mechanisms": said}))


@pytest.mark.parametrize("name", MECHANISMS)
def test_each_mechanism_is_left_out_by_its_name(name):
    assert on(f"all but {name}") == set(MECHANISMS) - {name} and on(name) == {name}


@pytest.mark.parametrize("name", MECHANISMS)
def test_each_mechanism_is_asked_for_by_its_name(name):
    """In one place of the package beside the list, or in the list of gates or of doubts."""
    asked = [f'"{name}" in ', f'"{name}" not in ', f'    "{name}": _']
    files = [path for path in FOLDER.glob("*.py") if any(text in path.read_text() for text in asked)]
    assert files, f"nothing asks for {name}"


def test_all_and_none():
    assert on("all") == set(MECHANISMS) and on("none") == frozenset()
    assert compose(CAMERA, preset("paper")) == Parts()
    assert on(" scale ,  outline") == {"scale", "outline"}


@pytest.mark.parametrize("said", ["scales", "all but scales", "scale outline", "scene;scale", ""])
def test_an_unknown_mechanism_is_refused_before_anything_is_tracked(said):
    with pytest.raises(BadInput, match=r"config method\.mechanisms: got '.*', expected all, none"):
        Point2Pose(CAMERA, preset().with_values({"method.mechanisms": said}))
    if said == "scales":
        with pytest.raises(BadInput, match=r"Did you mean scale\?"):
            on(said)
