"""The fused volume on each device: near the exact surface, and on CUDA the same as on the CPU."""

from dataclasses import replace

import numpy as np
import pytest

from p2p_lib.core.config import TsdfConfig, preset
from p2p_lib.core.errors import MissingBackend
from p2p_lib.core.voxels import TorchGrid
from p2p_lib.extended.default import Point2Pose
from p2p_lib.method import tsdf
from p2p_lib.method.tsdf import TsdfVolume
from tests.method.analytic_scene import CAMERA, LUMP, around, render

CONFIG = TsdfConfig(voxel_m=0.004)


def fused(device):
    volume = TsdfVolume(CONFIG, device=device)
    rgb = np.random.default_rng(0).integers(0, 256, (CAMERA.height, CAMERA.width, 3), np.uint8)
    for key, T_cam_obj in enumerate([*around(6), *around(6, height=-0.7)]):
        depth_m, mask = render(LUMP, T_cam_obj)
        depth_m = np.where(mask, depth_m, np.float32(1.0))  # the background carves
        assert volume.integrate(depth_m, rgb, mask, CAMERA, T_cam_obj, key=key) > 0
    return volume


@pytest.fixture(params=["cpu", "torch on the cpu", "cuda"])
def volume(request, monkeypatch):
    torch = pytest.importorskip("torch")
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("torch finds no CUDA device")
    with monkeypatch.context() as patch:
        if request.param == "torch on the cpu":
            patch.setattr(tsdf, "CpuGrid", lambda size: TorchGrid(size, "cpu"))
        return fused(request.param.split()[-1])


def test_the_device_of_the_configuration_is_that_of_every_objects_surface():
    torch = pytest.importorskip("torch")
    method = Point2Pose(CAMERA, replace(preset(), device="cuda"))
    if not torch.cuda.is_available():
        with pytest.raises(MissingBackend, match="cuda"):
            method.add_object("lump")
    else:
        method.add_object("lump")
        assert method.objects["lump"].model.surface._grid.device.type == "cuda"


def test_the_surface_lies_on_the_shape(volume):
    vertices = volume.mesh().vertices
    assert len(vertices) > 1000
    assert np.abs(LUMP(vertices)).mean() < CONFIG.voxel_m / 2
    value, valid = volume.query(vertices)
    assert valid.mean() > 0.9 and np.abs(value[valid]).max() < 0.1 * CONFIG.voxel_m


def test_every_device_agrees_with_the_cpu(volume):
    cpu = fused("cpu")
    assert volume.shape == cpu.shape
    np.testing.assert_allclose(volume.weights(), cpu.weights(), atol=1e-5)
    np.testing.assert_allclose(volume.values(), cpu.values(), atol=1e-5)
    p_obj = cpu.mesh().vertices[::7] + np.random.default_rng(1).normal(0, 0.002, (len(cpu.mesh().vertices[::7]), 3))
    for here, there in zip(volume.query_with_gradient(p_obj), cpu.query_with_gradient(p_obj), strict=True):
        np.testing.assert_allclose(here, there, atol=5e-5)  # torch's coordinates are float32
    np.testing.assert_array_equal(volume.mesh().faces, cpu.mesh().faces)
    np.testing.assert_allclose(volume.mesh().vertices, cpu.mesh().vertices, atol=1e-5)


def test_a_device_that_is_not_there_is_refused():
    torch = pytest.importorskip("torch")
    if torch.cuda.is_available():
        pytest.skip("torch finds a CUDA device")
    with pytest.raises(MissingBackend, match="device cuda: PyTorch finds no CUDA device here"):
        TsdfVolume(CONFIG, device="cuda")
