"""Objects and patches of every shape: what native code does with them must not end the process."""

import subprocess
import sys

import pytest

HEAD = """
import sys
import numpy as np
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import preset
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin.cut import warped
from p2p_lib.segmenters.builtin.patch import Box, Patch
from p2p_lib.segmenters.builtin.segmenter import BuiltinSegmenter

camera, config = Camera(300.0, 300.0, 160.0, 120.0, 320, 240), preset().segmentation
rng = np.random.default_rng(0)

def frame(k, box, roll=0):
    rgb, depth = np.full((240, 320, 3), 90, np.uint8), np.full((240, 320), 1.0)
    rgb[box], depth[box] = (200, 40, 60), 0.7
    rgb = np.clip(rgb + rng.normal(0, 8, rgb.shape), 0, 255).astype(np.uint8)
    return Frame(k, k / 30, np.roll(rgb, roll, 1), depth.astype(np.float32))
"""

PATCHES = """
for h, w in eval(sys.argv[1]):
    print(h, w, flush=True)
    one, two = (Patch.of(frame(k, np.s_[:h, :w // 2], k), Box(0, 0, w, h), camera, config) for k in range(2))
    mask, depth_m = warped(np.ones(one.shape), one, two)
    assert mask.shape == depth_m.shape == two.shape and np.isfinite(mask).all()
"""

OBJECTS = """
for left, top, w, h in eval(sys.argv[1]):
    print(left, top, w, h, flush=True)
    segmenter = BuiltinSegmenter(camera, config)
    box = np.s_[max(top, 0) : top + h, max(left, 0) : left + w]
    u, v = np.clip([left + w // 2, top + h // 2], 0, [319, 239])
    for k in range(4):
        labels = segmenter.segment(frame(k, box), () if k else [Prompt("it", 0, np.array([[u, v]], float))])
        assert labels.shape == (240, 320) and set(np.unique(labels)) <= {0, 1}
"""


def ends_well(script: str, shapes: list[tuple[int, ...]]) -> None:
    """A process of its own goes through the shapes; the last that it names is the one that ended it."""
    done = subprocess.run([sys.executable, "-c", HEAD + script, repr(shapes)], capture_output=True, text=True)
    assert done.returncode == 0, (done.stdout.splitlines()[-1:], done.stderr[-500:])


def test_the_flow_of_a_patch_of_any_shape():
    """OpenCV's own call ends the process at 31 x 112 pixels and at every smaller height."""
    sizes = [2, 3, 7, 11, 12, 16, 24, 31, 32, 33, 63, 112]
    ends_well(PATCHES, [(h, w) for h in sizes for w in sizes])


@pytest.mark.parametrize(
    "shapes",
    [
        [(160, 120, 1, 1), (0, 0, 1, 1), (319, 239, 1, 1), (160, 0, 2, 2)],
        [(0, 100, 320, 30), (0, 118, 320, 4), (150, 0, 30, 240), (159, 0, 3, 240), (20, 100, 280, 60)],
        [(-20, 80, 50, 60), (300, 80, 60, 40), (100, -30, 60, 40), (100, 225, 100, 40), (0, 0, 320, 240)],
    ],
    ids=["pixels", "stripes", "border"],
)
def test_an_object_of_any_shape(shapes):
    ends_well(OBJECTS, shapes)
