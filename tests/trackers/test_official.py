"""The adapters against the official classes with random weights; skipped where a package is not installed.

What the weights would say is not looked at: shapes, coordinates, memory and lateness are, and they do not depend on it.
"""

import numpy as np
import pytest

from p2p_lib.core import packages
from p2p_lib.core.backends import make_tracker
from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.errors import BadInput, MissingBackend
from p2p_lib.datasets.manifests import manifest
from p2p_lib.trackers import cotracker, tapir, tapnextpp

UV = np.array([[100.0, 80], [320, 240], [600.5, 33.25], [17, 460], [411, 199]])


def built(make):
    """A model with the same random weights each time; skips with the reason where its package is not there."""
    import torch

    torch.manual_seed(0)
    try:
        return make()
    except MissingBackend as error:
        pytest.skip(str(error))


def followed(tracker, frames, uv=UV, later=None, at=2):
    """Positions, visibility, uncertainty (T, N, ...) of queries in the first frame; ``later`` ones come at ``at``."""
    tracker.start(frames[0])
    ids, rows = tracker.add(uv), []
    for k, frame in enumerate(frames[1:], 1):
        rows.append(tracker.track(frame).select(ids))
        if later is not None and k == at:
            tracker.add(later)
    return tuple(np.array([getattr(row, name) for row in rows]) for name in ("uv_px", "visible", "uncertainty"))


def check_values(told, frames):
    uv, visible, uncertainty = told
    assert uv.shape == (len(frames) - 1, len(UV), 2) and visible.dtype == bool
    assert ((uncertainty >= 0) & (uncertainty <= 1)).all()
    inside = ((uv >= -0.5) & (uv <= np.array([639.5, 479.5]))).all(-1)
    assert not visible[~inside].any()


# --- TAPIR ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tapir_model():
    return built(tapir.new_model)


def offline_tapir(model, frames, uv, size):
    """The official model over the whole clip at once: its causal convolutions see the past alone."""
    import torch

    clip = np.stack([frame.rgb for frame in frames])
    video = torch.from_numpy(clip).float().permute(0, 3, 1, 2)
    video = torch.nn.functional.interpolate(video, (size, size), mode="bilinear", align_corners=False)
    video = (video / 255 * 2 - 1).permute(0, 2, 3, 1)[None]
    xy = (uv + 0.5) * size / np.array([640, 480])
    queries = torch.tensor(np.stack([np.zeros(len(uv)), xy[:, 1], xy[:, 0]], 1), dtype=torch.float32)[None]
    with torch.inference_mode():
        features = model.get_query_features(video[:, :1], is_training=False, query_points=queries)
        grids = model.get_feature_grids(video[:, 1:], is_training=False)
        out = model.estimate_trajectories((size, size), False, grids, features, None, query_chunk_size=64)
    p = model.num_pips_iter
    mean = {key: torch.stack(out[key][p::p]).mean(0)[0].numpy() for key in ("tracks", "occlusion", "expected_dist")}
    sigmoid = {key: 1 / (1 + np.exp(-mean[key].astype(float))) for key in ("occlusion", "expected_dist")}
    visible = (1 - sigmoid["occlusion"]) * (1 - sigmoid["expected_dist"]) > 0.5
    uv_px = mean["tracks"] * np.array([640, 480]) / size - 0.5
    return np.swapaxes(uv_px, 0, 1), visible.T, sigmoid["expected_dist"].T


@pytest.mark.parametrize("size", [256, 480])
def test_tapir_streams_what_the_official_model_says_of_the_clip(tapir_model, frames, size):
    frames = frames[: 5 if size == 256 else 3]
    told = followed(tapir.TapirTracker(tapir_model, size_px=size), frames)
    check_values(told, frames)
    uv, visible, uncertainty = offline_tapir(tapir_model, frames, UV, size)
    np.testing.assert_allclose(told[0], uv, atol=0.02)
    np.testing.assert_allclose(told[2], uncertainty, atol=1e-4)
    inside = ((uv >= -0.5) & (uv <= np.array([639.5, 479.5]))).all(-1)
    np.testing.assert_array_equal(told[1], visible & inside)


def test_tapir_later_queries_and_drops_leave_the_others_alone(tapir_model, frames):
    frames = frames[:5]
    alone = followed(tapir.TapirTracker(tapir_model, size_px=256), frames)
    tracker = tapir.TapirTracker(tapir_model, size_px=256)
    crowd = followed(tracker, frames, later=UV[:2] + 7.0)
    np.testing.assert_allclose(crowd[0], alone[0], atol=0.02)
    # The two that came in frame 2 are what a stream that begins there says of them.
    fresh = tapir.TapirTracker(tapir_model, size_px=256)
    fresh.start(frames[2])
    fresh.add(UV[:2] + 7.0)
    fresh.track(frames[3]), fresh.track(frames[4])
    tracker.drop(np.arange(4))
    after, expected = tracker.track(frames[0]), fresh.track(frames[0])
    assert after.ids.tolist() == [4, 5, 6]
    np.testing.assert_allclose(after.uv_px[1:], expected.uv_px, atol=0.02)


def test_tapir_finds_a_still_point_where_it_is(tapir_model, frames):
    """With the learned parts made neutral only the comparison of features is left: x, y, scale and pixel centres."""
    import copy

    import torch

    model = copy.deepcopy(tapir_model)
    with torch.no_grad():
        for name in ("hid1", "hid2"):
            conv = model.torch_cost_volume_track_mods[name]
            conv.weight.zero_(), conv.bias.zero_()
            conv.weight[0, 0, 1, 1] = 1.0
        model.torch_pips_mixer.linear_1.weight.zero_(), model.torch_pips_mixer.linear_1.bias.zero_()
    model.softmax_temperature = 2000.0
    tracker = tapir.TapirTracker(model, size_px=256)
    # Queries at the centres of the feature grid's cells: there the best cell is exact.
    cells = np.stack(np.meshgrid(np.arange(2, 30, 3), np.arange(2, 30, 3)), -1).reshape(-1, 2)
    uv = (cells + 0.5) * [20, 15] - 0.5
    tracker.start(frames[0])
    tracker.add(uv)
    off_px = tracker.track(frames[0]).uv_px - uv
    assert np.median(np.linalg.norm(off_px, axis=1)) < 0.1


# --- TAPNext++ -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tapnext_model():
    """Two narrow layers of it. The class leaves its weights unset: drawn here so that points differ in what they do."""
    import torch

    def small():
        packages.load("torchvision", "tapnextpp", "torchvision")
        module = packages.load("tapnet.tapnext.tapnext_torch", "tapnextpp", "tapnet")
        return module.TAPNext(image_size=(256, 256), width=96, num_heads=4, lru_width=96, depth=2)

    model = built(small)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.normal_(0, 0.3 if parameter.ndim > 1 else 0.1)
    return model


def test_tapnext_is_the_official_wrapper(tapnext_model, frames):
    module = pytest.importorskip("tapnet.tapnextpp.votsp2026.model")
    import torch

    frames = frames[:4]
    told = followed(tapnextpp.tracker(tapnext_model), frames)
    check_values(told, frames)
    wrapper = module.TAPNextPP(tapnext_model.eval(), torch.device("cpu"))
    # The wrapper counts pixels from the picture's edge, as its raster does. 64 more around each, as it is submitted
    # to VOTSp2026: in a square of an eighth of the picture's sides.
    share = (np.stack(np.meshgrid(np.arange(8), np.arange(8)), -1).reshape(-1, 2) + 0.5) / 8 - 0.5
    around = (UV[:, None] + 0.5 + share * np.array([640, 480]) / 8).reshape(-1, 2)
    queries = np.concatenate([UV + 0.5, around.clip([1.25, 0.9375], [638.75, 479.0625])])
    _, _, state = wrapper.track_frame(frames[0].rgb[..., ::-1], queries.astype(np.float32))
    spread = []
    for k, frame in enumerate(frames[1:]):
        xy, visible, state = wrapper.track_frame(frame.rgb[..., ::-1], state=state)
        xy, visible = xy[: len(UV)], visible[: len(UV)]
        np.testing.assert_allclose(told[0][k], xy - 0.5, atol=0.02)
        inside = ((told[0][k] >= -0.5) & (told[0][k] <= np.array([639.5, 479.5]))).all(-1)
        np.testing.assert_array_equal(told[1][k], visible & inside)
        spread.append(np.ptp(xy, axis=0))
    assert np.max(spread) > 5, "the points must differ for the comparison to mean anything"


def test_tapnext_uncertainty_is_the_official_certainty_but_for_the_shape_of_the_window(tapnext_model, frames):
    utils = pytest.importorskip("tapnet.tapnext.tapnext_torch_utils")
    import torch

    rollout = tapnextpp.TapNextRollout(tapnext_model.eval(), "cpu", [frames[0].rgb], UV)
    state = rollout._state
    _, _, uncertainty = rollout.step(frames[1].rgb)
    with torch.inference_mode():
        yx, logits, _, _ = tapnext_model(video=tapnextpp.square(frames[1].rgb, 256, "cpu"), state=state)
        certain = utils.tracker_certainty(yx, logits)[0, 0, : len(UV), 0].numpy()
    # Theirs is a disc of 8 px, ours the square around it: never less, and the same at both ends.
    assert (1 - uncertainty >= certain - 1e-4).all()
    assert np.corrcoef(1 - uncertainty, certain)[0, 1] > 0.9


def test_tapnext_later_queries_run_in_a_rollout_of_their_own(tapnext_model, frames):
    frames = frames[:4]
    alone = followed(tapnextpp.tracker(tapnext_model), frames)
    tracker = tapnextpp.tracker(tapnext_model)
    crowd = followed(tracker, frames, later=UV[:2] + 7.0)
    np.testing.assert_array_equal(crowd[0], alone[0])
    fresh = tapnextpp.tracker(tapnext_model)
    fresh.start(frames[2])
    fresh.add(UV[:2] + 7.0)
    fresh.track(frames[3])
    expected, after = fresh.track(frames[0]), tracker.track(frames[0])
    np.testing.assert_array_equal(after.uv_px[-2:], expected.uv_px)


# --- CoTracker3 ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cotracker_predictor():
    """On pictures a quarter as wide as the model's own: sixteen times less work."""
    predictor = built(cotracker.new_predictor)
    predictor.interp_shape = predictor.model.model_resolution = (96, 128)
    return predictor


def official_cotracker(predictor, pictures, uv):
    """As the official online demo feeds it, window by window; yields (last picture, tracks, visible)."""
    import torch

    video = torch.from_numpy(np.stack(pictures)).permute(0, 3, 1, 2)[None].float()
    queries = torch.tensor(np.concatenate([np.zeros((len(uv), 1)), uv], 1), dtype=torch.float32)[None]
    predictor(video_chunk=video[:, :16], is_first_step=True, queries=queries)
    for start in range(0, len(pictures) - 15, 8):
        tracks, visible = predictor(video_chunk=video[:, start : start + 16])
        yield start + 15, tracks[0].numpy(), visible[0].numpy()


def test_cotracker_is_the_official_predictor_seven_frames_late(cotracker_predictor, frames):
    tracker = cotracker.tracker(cotracker_predictor)
    assert tracker.latency_frames == 7
    told = followed(tracker, frames)
    check_values(told, frames)
    # The first picture stands for the eight before it.
    pictures = [frames[0].rgb] * 8 + [frame.rgb for frame in frames]
    compared = 0
    for last, tracks, visible in official_cotracker(cotracker_predictor, pictures, UV):
        now = last - 8  # the frame at hand when this window is full, and until the next one is
        for newest in range(now, min(now + 8, len(frames))):
            answered = newest - 7
            if newest < 1 or answered < 0:
                continue
            row = told[0][newest - 1]
            np.testing.assert_allclose(row, tracks[answered + 8], atol=0.02)
            inside = ((row >= -0.5) & (row <= np.array([639.5, 479.5]))).all(-1)
            np.testing.assert_array_equal(told[1][newest - 1], visible[answered + 8] & inside)
            compared += 1
    assert compared == len(frames) - 7
    assert np.isnan(told[0][:6]).all() and not told[1][:6].any()


def test_cotracker_queries_are_in_the_frame_answered(cotracker_predictor, frames):
    """Queries that come at frame 9 lie in frame 2, and are what a stream from frame 2 says of them."""
    tracker = cotracker.tracker(cotracker_predictor)
    tracker.start(frames[0])
    tracker.add(UV)
    for frame in frames[1:10]:
        tracker.track(frame)
    late = tracker.add(UV[:2] + 5.0)
    fresh = cotracker.tracker(cotracker_predictor)
    fresh.start(frames[2])
    ids = fresh.add(UV[:2] + 5.0)
    for frame in frames[3:10]:
        fresh.track(frame)
    for frame in frames[10:20]:
        np.testing.assert_array_equal(tracker.track(frame).select(late).uv_px, fresh.track(frame).select(ids).uv_px)


# --- on a GPU -----------------------------------------------------------------------------------


ON = {
    "tapir_model": lambda model, device: tapir.TapirTracker(model, device, size_px=256),
    "tapnext_model": tapnextpp.tracker,
    "cotracker_predictor": cotracker.tracker,
}


@pytest.mark.parametrize("model", ON)
def test_it_answers_on_a_gpu_as_on_the_cpu(model, frames, request, exact_cuda):
    make, network = ON[model], request.getfixturevalue(model)
    told = {device: followed(make(network, device), frames[:10], later=UV[:2] + 7.0) for device in ("cuda", "cpu")}
    check_values(told["cuda"], frames[:10])
    for here, there in zip(told["cuda"], told["cpu"], strict=True):
        np.testing.assert_allclose(here.astype(float), there.astype(float), atol=0.05)


# --- from file to tracker ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "make", "file"),
    [
        ("tapir", tapir.new_model, "causal_bootstapir_checkpoint.pt"),
        ("tapnextpp", tapnextpp.new_model, "tapnextpp_ckpt.pt"),
        ("cotracker3", lambda: cotracker.new_predictor().model, "scaled_online.pth"),
    ],
)
def test_a_checkpoint_of_the_official_class_is_loaded_by_name(name, make, file, tmp_path, monkeypatch):
    import torch

    model = built(make)
    monkeypatch.setenv("P2P_DATA", str(tmp_path))
    place = tmp_path / manifest(name).folder / file
    place.parent.mkdir(parents=True)
    prefix = "tapnext." if name == "tapnextpp" else ""  # as its trainer writes it
    torch.save({"state_dict": {prefix + key: value for key, value in model.state_dict().items()}}, place)
    tracker = make_tracker(name, TrackingConfig())
    assert tracker.name == name and tracker.latency_frames == (7 if name == "cotracker3" else 0)
    loaded = tracker._model if name == "tapir" else tracker._make.args[0]
    loaded = loaded.model if name == "cotracker3" else loaded
    for (key, own), (other, theirs) in zip(loaded.state_dict().items(), model.state_dict().items(), strict=True):
        assert key == other and own.cpu().numpy().tobytes() == theirs.numpy().tobytes()  # unset weights may be NaN
    place.write_bytes(place.read_bytes()[:-1] + b"\0\0")
    with pytest.raises(BadInput, match="sha256"):
        make_tracker(name, TrackingConfig())
