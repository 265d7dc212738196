"""SuperPoint's adapter: crops, pixels and scores with a stand-in, and with the official class and random weights."""

import json
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from p2p_lib.core.backends import make_detector
from p2p_lib.core.config import SamplingConfig
from p2p_lib.core.errors import BadInput, MissingBackend
from p2p_lib.core.types import Frame
from p2p_lib.datasets.manifests import manifest
from p2p_lib.detectors import superpoint

torch = pytest.importorskip("torch")
H, W = 200, 300


class Bright(torch.nn.Module):
    """Every pixel that is not black is a keypoint, scored by its grey value; output as transformers documents it."""

    def forward(self, pixel_values):
        assert pixel_values.shape[:2] == (1, 3) and pixel_values.max() <= 1
        self.shape = tuple(pixel_values.shape[2:])
        v, u = torch.nonzero(pixel_values[0, 0], as_tuple=True)
        score = pixel_values[0, 0, v, u]
        size = torch.tensor(self.shape[::-1])
        # One row of padding, as in a batch with a fuller picture.
        keypoints = torch.cat([torch.stack([u, v], 1) / size, torch.zeros(1, 2)])[None]
        scores = torch.cat([score, torch.ones(1)])[None]
        mask = torch.tensor([[1] * len(score) + [0]], dtype=torch.int32)
        return SimpleNamespace(keypoints=keypoints, scores=scores, mask=mask)


def dots(*uv):
    rgb = np.zeros((H, W, 3), np.uint8)
    for k, (u, v) in enumerate(uv):
        rgb[v, u] = 250 - 20 * k
    return Frame(0, 0.0, rgb, np.ones((H, W), np.float32))


def test_keypoints_are_pixels_of_the_whole_picture_in_the_mask():
    model = Bright()
    detector = superpoint.SuperPointDetector(model, SamplingConfig())
    mask = np.zeros((H, W), bool)
    mask[120:140, 200:240] = True
    found = detector.detect(dots((20, 20), (201, 121), (239, 139), (220, 130), (199, 130)), mask)
    np.testing.assert_allclose(found.uv_px, [(201, 121), (239, 139), (220, 130)], atol=1e-4)
    np.testing.assert_allclose(found.score, np.array([230, 210, 190]) / 255, atol=1e-6)
    assert model.shape[0] < H and model.shape[1] < W  # looked at the mask's surroundings alone
    few = superpoint.SuperPointDetector(model, SamplingConfig(candidates=2)).detect(dots((201, 121), (220, 130)), mask)
    assert len(few.score) == 2
    assert len(detector.detect(dots((20, 20)), np.zeros((H, W), bool)).score) == 0
    assert len(detector.detect(dots((20, 20)), mask).score) == 0


def official():
    """The class of transformers with random weights that fire often."""
    try:
        module = superpoint.packages.load("transformers", "superpoint", "transformers")
    except MissingBackend as error:
        pytest.skip(str(error))
    torch.manual_seed(0)
    model = module.SuperPointForKeypointDetection(module.SuperPointConfig(keypoint_threshold=0.0))
    with torch.no_grad():
        model.keypoint_decoder.conv_score_b.weight.mul_(50)
    return model


def noise(seed=0):
    rng = np.random.default_rng(seed)
    return Frame(0, 0.0, rng.integers(0, 256, (H, W, 3)).astype(np.uint8), np.ones((H, W), np.float32))


def test_official_class_gives_the_same_from_the_crop_as_from_the_whole_picture():
    model = official()
    mask = np.zeros((H, W), bool)
    mask[100:130, 160:220] = True
    found = superpoint.SuperPointDetector(model, SamplingConfig(candidates=4000)).detect(noise(), mask)
    px = np.rint(found.uv_px).astype(int)
    assert len(px) > 10 and mask[px[:, 1], px[:, 0]].all() and np.abs(found.uv_px - px).max() < 1e-3
    gray = torch.from_numpy(cv2.cvtColor(noise().rgb, cv2.COLOR_RGB2GRAY)).float() / 255
    with torch.inference_mode():
        whole = model(pixel_values=gray.expand(1, 3, H, W))
    uv = np.rint(whole.keypoints[0].numpy() * [W, H]).astype(int)
    own = uv[mask[uv[:, 1], uv[:, 0]]]
    # Beyond the crop's margin nothing of the picture matters to a keypoint.
    assert {tuple(p) for p in px.tolist()} == {tuple(p) for p in own.tolist()}


def test_official_checkpoint_is_loaded_from_the_checked_folder(tmp_path, monkeypatch):
    model = official()
    monkeypatch.setenv("P2P_DATA", str(tmp_path))
    with pytest.raises(MissingBackend, match=r"Run: p2p data fetch superpoint$"):
        make_detector("superpoint", SamplingConfig())
    folder = tmp_path / manifest("superpoint").folder
    model.save_pretrained(folder)
    detector = make_detector("superpoint", SamplingConfig())
    mask = np.ones((H, W), bool)
    expected = superpoint.SuperPointDetector(model, SamplingConfig()).detect(noise(), mask)
    np.testing.assert_allclose(detector.detect(noise(), mask).score, expected.score, atol=1e-6)
    record = json.loads((folder / ".p2p-superpoint.json").read_text())["files"]
    assert set(record) == {"model.safetensors", "config.json"}
    (folder / "config.json").write_text("{}")
    with pytest.raises(BadInput, match=r"config\.json: got sha256"):
        make_detector("superpoint", SamplingConfig())
