"""The SAM 2 adapter against the official classes with random weights; skipped where ``transformers`` is not there.

What the weights would say is not looked at: coordinates, memory and absence are, and they do not depend on it.
"""

import importlib.util
from types import SimpleNamespace

import numpy as np
import pytest

from p2p_lib.core import packages
from p2p_lib.core.backends import make_segmenter
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import preset
from p2p_lib.core.errors import BadInput, MissingBackend
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import Frame
from p2p_lib.datasets.manifests import manifest
from p2p_lib.extended.default import Point2Pose
from p2p_lib.segmenters import sam2_video

CAMERA = Camera(150.0, 150.0, 80, 60, 160, 120)
SIDE = 128
CLICKS = np.array([[80.0, 60], [70, 50]])
CUP = Prompt("cup", points_px=CLICKS)

needs_transformers = pytest.mark.skipif(
    importlib.util.find_spec("transformers") is None,
    reason=f"transformers is not installed: {packages.command(packages.INSTALL['transformers'])}",
)


def film(count: int) -> list[Frame]:
    rng = np.random.default_rng(0)
    depth = np.full((120, 160), 0.7, np.float32)
    return [Frame(k, k / 30, rng.integers(0, 256, (120, 160, 3), np.uint8), depth) for k in range(count)]


@pytest.fixture(scope="module")
def model():
    """The official class, small, with random weights."""
    import torch
    from transformers import Sam2VideoConfig, Sam2VideoModel

    hiera = {
        "model_type": "sam2_hiera_det_model",
        "hidden_size": 12,
        "num_attention_heads": 1,
        "image_size": [SIDE, SIDE],
        "blocks_per_stage": [1, 1, 2, 1],
        "embed_dim_per_stage": [12, 24, 48, 96],
        "num_attention_heads_per_stage": [1, 1, 2, 2],
        "window_size_per_stage": [8, 4, 4, 4],
        "global_attention_blocks": [3],
        "window_positional_embedding_background_size": [7, 7],
    }
    vision = {
        "model_type": "sam2_vision_model",
        "backbone_config": hiera,
        "backbone_channel_list": [96, 48, 24, 12],
        "backbone_feature_sizes": [[32, 32], [16, 16], [8, 8]],
        "fpn_hidden_size": 128,
    }
    small = {"mlp_dim": 32, "num_attention_heads": 2, "iou_head_hidden_dim": 32}
    torch.manual_seed(0)
    config = Sam2VideoConfig(
        vision_config=vision,
        prompt_encoder_config={"hidden_size": 128, "image_size": SIDE},
        mask_decoder_config={"hidden_size": 128, **small},
        image_size=SIDE,
        memory_attention_hidden_size=128,
        memory_attention_num_layers=1,
        memory_attention_feed_forward_hidden_size=32,
        memory_attention_rope_feat_sizes=[8, 8],
        memory_encoder_hidden_size=128,
        memory_encoder_output_channels=64,
        mask_downsampler_embed_dim=128,
        memory_fuser_embed_dim=128,
        memory_fuser_intermediate_dim=32,
        memory_fuser_num_layers=1,
        # Few enough for a short film to outlast them.
        num_maskmem=3,
        max_object_pointers_in_encoder=4,
    )
    return Sam2VideoModel(config).eval()


class Watched(sam2_video.Sam2VideoSegmenter):
    """Keeps the logits that the model gave."""

    def __init__(self, model):
        super().__init__(model, CAMERA)
        self.logits = []
        model.register_forward_hook(self._note)

    def _note(self, _module, _inputs, output):
        if hasattr(output, "object_score_logits") and hasattr(output, "frame_idx"):
            self.logits.append((output.pred_masks.cpu().numpy().copy(), float(output.object_score_logits)))


@needs_transformers
def test_trimmed_memory_changes_nothing(model):
    """Frame by frame the same as an official session that keeps everything."""
    import torch
    from transformers import Sam2VideoInferenceSession

    ours, frames = Watched(model), film(10)
    for k, frame in enumerate(frames):
        ours.segment(frame, () if k else [CUP])
    told, ours.logits = ours.logits, []
    session = Sam2VideoInferenceSession(video_height=120, video_width=160, dtype=torch.float32)
    at = session.obj_id_to_idx(1)
    points = torch.tensor((CLICKS + 0.5) * SIDE / [160, 120] - 0.5).float()[None, None]
    labels = torch.ones(1, 1, 2, dtype=torch.int32)
    session.add_point_inputs(at, 0, {"point_coords": points, "point_labels": labels})
    session.obj_with_new_inputs = [1]
    for k, frame in enumerate(frames):
        output = model(inference_session=session, frame=ours._pixels(frame.rgb))
        np.testing.assert_allclose(told[k][0], output.pred_masks.numpy(), atol=1e-5)
    assert len(session.processed_frames) == 10  # what it would keep by itself
    (kept,) = ours._sessions.values()
    assert not kept.processed_frames
    assert len(kept.output_dict_per_obj[0]["non_cond_frame_outputs"]) <= 4


@needs_transformers
def test_memory_stays_bounded(model):
    def megabytes(segmenter) -> float:
        (session,) = segmenter._sessions.values()
        outputs = session.output_dict_per_obj[0]
        tensors = [t for kind in outputs.values() for o in kind.values() for t in o.values() if hasattr(t, "nbytes")]
        return sum(t.nbytes for t in tensors) / 1e6

    ours, sizes = sam2_video.Sam2VideoSegmenter(model, CAMERA), []
    for k, frame in enumerate(film(14)):
        ours.segment(frame, () if k else [CUP])
        sizes.append(megabytes(ours))
    assert sizes[13] == sizes[9] > 0


@needs_transformers
def test_points_and_pictures_are_the_official_processors(model):
    """Points to half a pixel of the network, whose processor takes a pixel's corner for its centre."""
    import torch
    from transformers import Sam2VideoProcessor

    official = Sam2VideoProcessor._normalize_coordinates(None, SIDE, torch.tensor(CLICKS), (120, 160)).numpy()
    ours = sam2_video.Sam2VideoSegmenter(model, CAMERA)._points(CUP)["point_coords"].numpy()[0, 0]
    assert np.abs(ours - official).max() <= 0.5
    grey = np.full((120, 160, 3), 128, np.uint8)
    pixels = sam2_video.Sam2VideoSegmenter(model, CAMERA)._pixels(grey).numpy()
    assert pixels.shape == (1, 3, SIDE, SIDE)
    expected = (128 / 255 - np.array(sam2_video.MEAN)) / np.array(sam2_video.DEVIATION)
    np.testing.assert_allclose(pixels[0].mean((1, 2)), expected, atol=1e-5)


class Says:
    """Stands in for the model: masks and scores as told, on the network's quarter grid."""

    class config:
        image_size, num_maskmem, max_object_pointers_in_encoder = SIDE, 3, 4

    def __init__(self, answers):
        self.answers = list(answers)

    def to(self, _device):
        return self

    def eval(self):
        return self

    def get_image_features(self, pixels, return_dict):
        from types import SimpleNamespace

        return SimpleNamespace(fpn_hidden_states=[pixels], fpn_position_encoding=[pixels])

    def __call__(self, inference_session, frame, frame_idx):
        from types import SimpleNamespace

        import torch

        logits, score = self.answers.pop(0)
        masks, scores = torch.tensor(logits)[None, None].float(), torch.tensor([[score]]).float()
        return SimpleNamespace(pred_masks=masks, object_score_logits=scores)


def half(left: bool) -> np.ndarray:
    logits = np.full((32, 32), -5.0)
    logits[:, :16] = 5.0
    return logits if left else logits[:, ::-1].copy()


@needs_transformers
def test_labels_are_the_likelier_objects_and_absent_ones_have_none():
    answers = [(half(True), 3.0), (half(False), 3.0), (half(True), -1.0), (half(False) + 9, 2.0), (half(True) * 2, 2.0)]
    ours, frames = sam2_video.Sam2VideoSegmenter(Says(answers), CAMERA), film(3)
    both = ours.segment(frames[0], [Prompt("a", points_px=CLICKS), Prompt("b", points_px=CLICKS + 10)])
    assert both.shape == (120, 160) and both.dtype == np.int32 and ours.names == ("a", "b")
    assert (both[:, :78] == 1).all() and (both[:, 82:] == 2).all()
    # "a" is absent now, and "b" everywhere.
    assert (ours.segment(frames[1]) == 2).all()
    ours.remove("a")
    assert ours.names == ("b",)
    assert set(np.unique(ours.segment(frames[2])[:, :78])) == {1}


def mask_of(left: int, top: int, right: int, bottom: int) -> np.ndarray:
    mask = np.zeros((120, 160), bool)
    mask[top:bottom, left:right] = True
    return mask


@needs_transformers
def test_what_is_said_reaches_the_network_as_the_official_processor_says_it(model):
    """A box is two clicks, its corners; clicks beside the object have another label; a mask is what it is."""
    import torch
    from transformers import Sam2VideoInferenceSession, Sam2VideoProcessor

    class Processor(Sam2VideoProcessor):
        def __init__(self):  # without an image processor, which wants torchvision
            self.target_size, self.point_pad_value = SIDE, -10

    ours = sam2_video.Sam2VideoSegmenter(model, CAMERA)
    said = Prompt("cup", points_px=CLICKS, negative_px=[[10, 20]], box_px=(60, 40, 100, 90))
    official = Sam2VideoInferenceSession(video_height=120, video_width=160, dtype=torch.float32)
    clicks = [[[*CLICKS.tolist(), [10.0, 20.0]]]]
    box = [[[60.0, 40.0, 100.0, 90.0]]]
    Processor().process_new_points_or_boxes_for_video_frame(
        official, 0, [1], input_points=clicks, input_labels=[[[1, 1, 0]]], input_boxes=box, original_size=(120, 160)
    )
    expected, got = official.point_inputs_per_obj[0][0], ours._points(said)
    assert got["point_labels"].flatten().tolist() == expected["point_labels"].flatten().tolist() == [2, 3, 1, 1, 0]
    apart = got["point_coords"].numpy().reshape(-1, 2) - expected["point_coords"].numpy().reshape(-1, 2)
    assert np.abs(apart).max() <= 0.5
    mask = mask_of(60, 40, 100, 90)
    Processor().process_new_mask_for_video_frame(official, 0, [1], [mask])
    np.testing.assert_array_equal(ours._mask(mask).numpy(), official.mask_inputs_per_obj[0][0].numpy())


@needs_transformers
def test_a_mask_is_taken_as_it_is_and_the_network_goes_on_from_the_newest(model):
    """As an official session that is given the mask in its frame."""
    import torch
    from transformers import Sam2VideoInferenceSession

    ours, frames = Watched(model), film(4)
    first, newest = mask_of(20, 20, 60, 60), mask_of(60, 40, 100, 90)
    for frame, mask in zip(frames, (first, newest)):
        np.testing.assert_array_equal(ours.segment(frame, [Prompt("cup", mask=mask)]) == 1, mask)
    assert not ours.logits  # it has not been needed yet
    ours.segment(frames[2])
    ours.segment(frames[3], [Prompt("cup", negative_px=[[10, 20]])])
    told, ours.logits = ours.logits, []
    session = Sam2VideoInferenceSession(video_height=120, video_width=160, dtype=torch.float32)
    at = session.obj_id_to_idx(1)
    session.add_mask_inputs(at, 0, ours._mask(newest))
    session.obj_with_new_inputs = [1]
    for k, frame in enumerate(frames[1:]):
        if k == 2:
            session.frames_tracked_per_obj[at][k] = {"reverse": False}
            session.add_point_inputs(at, k, ours._points(Prompt("cup", negative_px=[[10, 20]])))
            session.obj_with_new_inputs = [1]
        output = model(inference_session=session, frame=ours._pixels(frame.rgb), frame_idx=k)
        np.testing.assert_allclose(told[k][0], output.pred_masks.numpy(), atol=1e-5)
    # Nothing has been seen of an object whose first mask is empty.
    assert not (ours.segment(frames[3], [Prompt("late", mask=np.zeros_like(first))]) == 2).any()
    assert not (ours.segment(frames[3]) == 2).any() and ours.names == ("cup", "late")


@needs_transformers
def test_it_answers_on_a_gpu_as_on_the_cpu(model, exact_cuda):
    """Clicks, memory, and a mask that is given later."""
    labels = []
    for device in ("cuda", "cpu"):
        segmenter = sam2_video.Sam2VideoSegmenter(model, CAMERA, device)
        prompts = {0: [CUP], 3: [Prompt("pen", mask=mask_of(60, 40, 100, 90))]}
        labels.append([segmenter.segment(frame, prompts.get(k, ())) for k, frame in enumerate(film(6))])
    assert np.mean(np.array(labels[0]) == np.array(labels[1])) > 0.999


@needs_transformers
def test_the_pipeline_takes_it(model):
    method = Point2Pose(CAMERA, preset(), segmenter=sam2_video.Sam2VideoSegmenter(model, CAMERA))
    frames = film(4)
    method.add_object("cup", clicks=CLICKS)
    for k, frame in enumerate(frames):
        if k == 2:
            method.add_object("late", clicks=CLICKS - 5)
        assert set(method.step(frame)) == ({"cup"} if k < 2 else {"cup", "late"})
    method.remove_object("cup")
    assert set(method.step(frames[3])) == {"late"}


@needs_transformers
def test_clicks_without_depth_are_refused(model):
    frame = film(1)[0]
    hole = Frame(0, 0.0, frame.rgb, np.zeros_like(frame.depth_m))
    with pytest.raises(BadInput, match=r"\(80, 60\) has no depth"):
        sam2_video.Sam2VideoSegmenter(model, CAMERA).segment(hole, [CUP])


# --- without the package or the weights --------------------------------------------------------


def test_it_says_what_to_install_or_fetch(monkeypatch):
    monkeypatch.delenv("P2P_DATA", raising=False)
    with pytest.raises(MissingBackend) as error:
        make_segmenter("sam2_video", CAMERA, preset().segmentation)
    if importlib.util.find_spec("transformers") is None:
        assert "pip install" in str(error.value) and "transformers" in str(error.value)
    else:
        assert "p2p data fetch sam2_video" in str(error.value)


SIZES = {"sam2_video": "tiny", "sam2_video_small": "small"}
SIZES |= {"sam2_video_base_plus": "base-plus", "sam2_video_large": "large"}


@pytest.mark.parametrize("name", SIZES)
def test_the_manifest_names_its_licence_and_option(name):
    of = manifest(name)
    assert "Apache" in of.licence and of.used_by == f"--masks {name}"
    assert {file.path for file in of.files} == {"model.safetensors", "config.json"}
    assert {file.url.split("/resolve/")[0] for file in of.files} == {of.page}
    assert of.page.endswith(f"/sam2.1-hiera-{SIZES[name]}")


@pytest.mark.parametrize("name", SIZES)
def test_a_size_is_chosen_by_name_and_has_weights_of_its_own(name, tmp_path, monkeypatch):
    import torch

    class Network(torch.nn.Module):
        """Knows the folder that it was read from."""

        config = SimpleNamespace(image_size=SIDE)

        @classmethod
        def from_pretrained(cls, folder, **how):
            assert how == {"local_files_only": True, "use_safetensors": True}
            network = cls()
            network.weights = (folder / "model.safetensors").read_text()
            return network

    monkeypatch.setattr(packages, "load", lambda *of: SimpleNamespace(Sam2VideoModel=Network))
    monkeypatch.setenv("P2P_DATA", str(tmp_path))
    for other in SIZES:
        for file in manifest(other).files:
            path = tmp_path / manifest(other).folder / file.path
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(other)
    segmenter = make_segmenter(name, CAMERA, preset().segmentation)
    assert segmenter.name == name and segmenter._model.weights == name
    (tmp_path / manifest(name).folder / "config.json").unlink()
    with pytest.raises(MissingBackend, match=f"p2p data fetch {name}$"):
        make_segmenter(name, CAMERA, preset().segmentation)
