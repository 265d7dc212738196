"""SuperPoint: crops, pixels and scores of known probabilities; against the official class; with the real weights."""

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
H, W = 200, 304


@pytest.fixture
def bright(monkeypatch):
    """Every pixel's grey value is its probability; what the detector looked at is kept."""
    seen = []

    def grey(net, gray):
        seen.append(tuple(gray.shape))
        return gray

    monkeypatch.setattr(superpoint, "probabilities", grey)
    return seen


def detector(**config):
    return superpoint.SuperPointDetector(superpoint.network(), SamplingConfig(**config))


def dots(*uv):
    rgb = np.zeros((H, W, 3), np.uint8)
    for k, (u, v) in enumerate(uv):
        rgb[v, u] = 250 - 20 * k
    return Frame(0, 0.0, rgb, np.ones((H, W), np.float32))


def box(rows, columns):
    mask = np.zeros((H, W), bool)
    mask[slice(*rows), slice(*columns)] = True
    return mask


def test_keypoints_are_pixels_of_the_whole_picture_in_the_mask(bright):
    mask = box((120, 140), (200, 240))
    found = detector().detect(dots((20, 20), (201, 121), (239, 139), (220, 130), (199, 130)), mask)
    np.testing.assert_allclose(found.uv_px, [(201, 121), (239, 139), (220, 130)], atol=1e-4)
    np.testing.assert_allclose(found.score, np.array([230, 210, 190]) / 255, atol=1e-6)
    assert bright[0][0] < H and bright[0][1] < W  # looked at the mask's surroundings alone
    assert len(detector(candidates=2).detect(dots((201, 121), (220, 130), (210, 135)), mask).score) == 2
    assert len(detector().detect(dots((20, 20)), np.zeros((H, W), bool)).score) == 0
    assert len(detector().detect(dots((20, 20)), mask).score) == 0


def test_neighbours_of_a_better_one_and_the_border_give_none(bright):
    found = detector().detect(dots((100, 100), (104, 104), (109, 100), (2, 90), (90, H - 3)), box((0, H), (0, W)))
    assert found.uv_px.tolist() == [[100, 100], [109, 100]]


def weights(seed=0):
    """Random, firing often."""
    torch.manual_seed(seed)
    net = superpoint.network()
    with torch.no_grad():
        net["convPb"].weight.mul_(50)
    return net


def noise(seed=0):
    rng = np.random.default_rng(seed)
    return Frame(0, 0.0, rng.integers(0, 256, (H, W, 3)).astype(np.uint8), np.ones((H, W), np.float32))


def grey(frame):
    return torch.from_numpy(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)).float() / 255


def test_a_crop_gives_the_same_as_the_whole_picture():
    net, mask = weights(), box((100, 130), (160, 220))
    found = superpoint.SuperPointDetector(net, SamplingConfig(candidates=4000)).detect(noise(), mask)
    u, v = found.uv_px.astype(int).T
    assert len(u) > 10 and mask[v, u].all()
    with torch.inference_mode():
        whole = superpoint.probabilities(net, grey(noise())).numpy()
    np.testing.assert_allclose(found.score, whole[v, u], rtol=1e-4)
    assert ((found.uv_px[:, None] - found.uv_px) ** 2).max(-1)[~np.eye(len(u), dtype=bool)].min() > 16


def test_the_official_class_with_these_weights_has_the_same_keypoints_and_scores():
    try:
        module = superpoint.packages.load("transformers", "superpoint", "transformers")
    except MissingBackend as error:
        pytest.skip(str(error))
    model = module.SuperPointForKeypointDetection(module.SuperPointConfig(keypoint_threshold=0.0)).eval()
    net = weights()
    parts = {f"conv{k}{ab}": f"encoder.conv_blocks.{k - 1}.conv_{ab}" for k in range(1, 5) for ab in "ab"}
    parts |= {f"convP{ab}": f"keypoint_decoder.conv_score_{ab}" for ab in "ab"}
    named = {f"{parts[ours]}.{kind}": w for ours in parts for kind, w in net[ours].state_dict().items()}
    left = model.load_state_dict(named, strict=False)
    assert not left.unexpected_keys and all("descriptor" in key for key in left.missing_keys)
    with torch.inference_mode():
        theirs = model(pixel_values=grey(noise()).expand(1, 3, H, W))
    at = np.rint(theirs.keypoints[0].numpy() * [W, H]).astype(int)
    score = {tuple(uv): s for uv, s in zip(at.tolist(), theirs.scores[0].tolist(), strict=True)}
    ours = superpoint.SuperPointDetector(net, SamplingConfig(candidates=9999)).detect(noise(), np.ones((H, W), bool))
    px = ours.uv_px.astype(int).tolist()
    assert len(px) > 100 and ours.score == pytest.approx([score[tuple(uv)] for uv in px], rel=1e-4)
    # Theirs gives a place to what only a suppressed neighbour surpasses, besides.
    assert len(px) > 0.7 * len(score)


def test_the_checkpoint_has_its_checksum(tmp_path, monkeypatch):
    monkeypatch.setenv("P2P_DATA", str(tmp_path))
    with pytest.raises(MissingBackend, match=r"Run: p2p data fetch superpoint$"):
        make_detector("superpoint", SamplingConfig())
    (file,) = manifest("superpoint").files
    folder = tmp_path / manifest("superpoint").folder
    folder.mkdir(parents=True)
    torch.save(weights().state_dict(), folder / file.path)
    with pytest.raises(BadInput, match=rf"got .*, expected {file.bytes} bytes|expected sha256 {file.sha256}"):
        make_detector("superpoint", SamplingConfig())


@pytest.fixture
def real_weights(shared_data, tmp_path, monkeypatch):
    """The official file in its place; skips where it is not at hand."""
    (file,) = manifest("superpoint").files
    path = shared_data.parent / "weights" / file.path
    if not path.is_file():
        pytest.skip(f"no weights at {path}. Run: p2p data fetch superpoint")
    folder = tmp_path / manifest("superpoint").folder
    folder.mkdir(parents=True)
    (folder / file.path).symlink_to(path)
    monkeypatch.setenv("P2P_DATA", str(tmp_path))


def test_real_weights_find_corners_and_find_them_again(real_weights):
    """On a chequered board: its corners, to a pixel; and the same ones when it is turned and enlarged."""
    found = make_detector("superpoint", SamplingConfig())
    squares = np.kron(np.indices((6, 8)).sum(0) % 2, np.ones((25, 25)))
    image = np.full((H, W), 128, np.float32)
    image[25:175, 50:250] = 60 + 140 * squares
    image = cv2.GaussianBlur(image, (0, 0), 1)

    def detect(gray):
        frame = Frame(0, 0.0, np.repeat(gray.round().astype(np.uint8)[..., None], 3, 2), np.ones((H, W), np.float32))
        return found.detect(frame, np.ones((H, W), bool)).uv_px

    inner = np.stack(np.meshgrid(np.arange(75, 250, 25), np.arange(50, 175, 25)), -1).reshape(-1, 2) - 0.5
    near = np.linalg.norm(detect(image)[:, None] - inner, axis=2).min(0)
    assert (near < 1.5).mean() > 0.95
    A = cv2.getRotationMatrix2D((W / 2, H / 2), 17, 1.1)
    moved = inner @ A[:, :2].T + A[:, 2]
    moved = moved[((moved > 10) & (moved < [W - 10, H - 10])).all(1)]
    again = np.linalg.norm(detect(cv2.warpAffine(image, A, (W, H), borderValue=128))[:, None] - moved, axis=2).min(0)
    assert (again < 2).mean() > 0.9
