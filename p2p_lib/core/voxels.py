"""The voxels of a TSDF volume, and what is done to all of them: an image fused, points asked for.

:class:`CpuGrid` does it in compiled loops, :class:`TorchGrid` on any device of torch; both give the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from p2p_lib.core.compiled import compiled
from p2p_lib.core.errors import MissingBackend
from p2p_lib.core.packages import load

if TYPE_CHECKING:
    import torch

#: A voxel nearer than this, m, is behind the camera.
_BEHIND_M = 1e-6
#: Voxels that torch handles at once: its temporaries take a hundred bytes of each.
_AT_ONCE = 1 << 22


@dataclass(frozen=True, eq=False)
class MaskedImage:
    """A masked RGB-D image, cut to the pixels that count, and the voxels that it may touch.

    depth_m   (h, w) float32, -inf on the border and wherever nothing is to be fused
    inside    (h, w) bool: measured on the object; depth elsewhere only carves
    rgbw      (4, h, w) uint8: colour and 1
    lo, hi    (3,) int: the box [lo, hi) of the lattice that may be touched
    """

    depth_m: np.ndarray
    inside: np.ndarray
    rgbw: np.ndarray
    lo: np.ndarray
    hi: np.ndarray


class CpuGrid:
    """Voxels (nx, ny, nz), float32: ``total`` and ``weight`` of the mean ``value``, NaN where nothing was observed.

    colour  (4, nx, ny, nz): sums of weighted red, green and blue, and of the weights
    """

    def __init__(self, size: tuple[int, ...]):
        self.total, self.weight = self.full(size, 0.0), self.full(size, 0.0)
        self.colour, self.value = self.full((4, *size), 0.0), self.full(size, np.nan)

    def full(self, size: tuple[int, ...], value: float) -> Any:
        """A new array."""
        return np.full(size, value, np.float32)

    def enlarge(self, size: tuple[int, ...], start: tuple[int, ...]) -> None:
        """Make room for more voxels; those there are begin at ``start`` then."""
        box = tuple(slice(a, a + n) for a, n in zip(start, self.weight.shape, strict=True))
        for name, empty in (("total", 0.0), ("weight", 0.0), ("colour", 0.0), ("value", np.nan)):
            old = getattr(self, name)
            new = self.full((*old.shape[:-3], *size), empty)
            new[..., *box] = old
            setattr(self, name, new)

    def put(self, index: np.ndarray, value: np.ndarray, weight: np.ndarray, rgbw: np.ndarray) -> None:
        """Set voxels (M,), counted in C order, to values (M,), weights (M,) and sums of colours (M, 4)."""
        arrays = (self.total, value * weight), (self.weight, weight), (self.value, value), (self.colour, rgbw.T)
        for array, new in arrays:
            host = self.host(array)
            host.reshape(*host.shape[:-3], -1)[..., index] = new
            array[...] = self.like(host)

    def like(self, array: np.ndarray) -> Any:
        """A NumPy array as one of the arrays."""
        return array

    def host(self, array: Any) -> np.ndarray:
        """A NumPy copy of one of the arrays."""
        return array.copy()

    def fuse(self, image: MaskedImage, A, b, first: np.ndarray, weight: float, tau_m: float, carve: bool) -> int:
        """Take an image into the means, or out with a negative weight; returns how many voxels it touched.

        A, b   (3, 3), (3,): u z, v z and z of lattice point (i, j, k) are A (i, j, k) + b
        first  (3,) int: lattice indices of the first voxel
        """
        arrays = self.total, self.weight, self.value, self.colour
        seen = image.depth_m, image.inside, image.rgbw, A, b, image.lo, image.hi
        return _fuse(*arrays, first, *seen, np.float32(weight), tau_m, carve)

    def at(self, index: np.ndarray, offsets: np.ndarray) -> np.ndarray:
        """(K, N) values between voxels, at indices (N, 3) moved by offsets (K, 3); NaN outside and beside NaN."""
        return _trilinear(self.value, np.ascontiguousarray(index), offsets)


@compiled("f4[:,:,::1], f8[:,::1], f8[:,::1]")
def _trilinear(value: np.ndarray, index: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    nx, ny, nz = value.shape
    out = np.full((len(offsets), len(index)), np.nan)
    for n in range(len(index)):
        for k in range(len(offsets)):
            x, y, z = index[n, 0] + offsets[k, 0], index[n, 1] + offsets[k, 1], index[n, 2] + offsets[k, 2]
            if x >= 0 and y >= 0 and z >= 0 and x <= nx - 1 and y <= ny - 1 and z <= nz - 1:
                i, j, h = min(int(x), nx - 2), min(int(y), ny - 2), min(int(z), nz - 2)
                a, b, c = x - i, y - j, z - h
                v = value[i : i + 2, j : j + 2, h : h + 2]
                low = (v[0, 0, 0] * (1 - c) + v[0, 0, 1] * c) * (1 - b) + (v[0, 1, 0] * (1 - c) + v[0, 1, 1] * c) * b
                high = (v[1, 0, 0] * (1 - c) + v[1, 0, 1] * c) * (1 - b) + (v[1, 1, 0] * (1 - c) + v[1, 1, 1] * c) * b
                out[k, n] = low * (1 - a) + high * a
    return out


@compiled(
    "f4[:,:,::1], f4[:,:,::1], f4[:,:,::1], f4[:,:,:,::1], i8[::1], f4[:,::1], b1[:,::1], u1[:,:,::1], f8[:,::1], "
    "f8[::1], i8[::1], i8[::1], f4, f8, b1"
)
def _fuse(total, count, value, colour, first, depth_m, inside, rgbw, A, b, lo, hi, weight, tau_m, carve):
    height, width = depth_m.shape
    touched = 0
    for i in range(lo[0], hi[0]):
        for j in range(lo[1], hi[1]):
            x0 = A[0, 0] * i + A[0, 1] * j + b[0]
            y0 = A[1, 0] * i + A[1, 1] * j + b[1]
            z0 = A[2, 0] * i + A[2, 1] * j + b[2]
            for k in range(lo[2], hi[2]):
                z = z0 + A[2, 2] * k
                if z <= _BEHIND_M:
                    continue
                # Half a pixel more, cut off, is the nearest pixel.
                u, v = (x0 + A[0, 2] * k) / z + 0.5, (y0 + A[1, 2] * k) / z + 0.5
                if u < 0 or v < 0 or u >= width or v >= height:
                    continue
                row, column = int(v), int(u)
                d = depth_m[row, column] - z
                if d < -tau_m or (carve and d < tau_m and not inside[row, column]):
                    continue
                touched += 1
                phi, at = min(d / tau_m, 1.0), (i - first[0], j - first[1], k - first[2])
                total[at] += weight * phi
                count[at] += weight
                if count[at] == 0:  # all were taken out again: what the total still holds is rounding
                    total[at], value[at] = 0.0, np.nan
                else:
                    value[at] = total[at] / count[at]
                if phi < 1:
                    for c in range(4):
                        colour[c][at] += weight * rgbw[c, row, column]
    return touched


def check_device(device: str) -> None:
    """:class:`MissingBackend` where the configuration's device, ``cpu`` or one of torch's, is not to be had."""
    if device == "cpu":
        return
    torch = load("torch", f"device {device}", "torch")
    if device.startswith("cuda") and not torch.cuda.is_available():
        fix = "Say --device cpu, or see environment.md for PyTorch with CUDA."
        raise MissingBackend(f"device {device}", "PyTorch finds no CUDA device here", fix)


class TorchGrid(CpuGrid):
    """The same as torch's tensors on one of its devices."""

    def __init__(self, size: tuple[int, ...], device: str):
        check_device(device)
        self.device = load("torch", f"device {device}", "torch").device(device)
        super().__init__(size)

    def full(self, size: tuple[int, ...], value: float) -> Any:
        """A new tensor."""
        import torch

        return torch.full(size, value, device=self.device)

    def like(self, array: np.ndarray) -> Any:
        """A NumPy array as a tensor."""
        import torch

        return torch.from_numpy(array).to(self.device)

    def host(self, array: Any) -> np.ndarray:
        """A NumPy copy of one of the tensors."""
        return array.cpu().numpy().copy()

    def fuse(self, image: MaskedImage, A, b, first: np.ndarray, weight: float, tau_m: float, carve: bool) -> int:
        """As on the CPU."""
        import torch

        def flat(array: np.ndarray) -> torch.Tensor:
            return torch.from_numpy(np.ascontiguousarray(array)).to(self.device).flatten(-2)

        depth, rgbw = flat(image.depth_m).double(), flat(image.rgbw.astype(np.float32))
        gate = flat(np.where(image.inside | (not carve), -tau_m, tau_m))
        sheet = max(1, _AT_ONCE // max(int(np.prod(image.hi[1:] - image.lo[1:])), 1))
        touched = 0
        for x in range(image.lo[0], image.hi[0], sheet):
            axes = ((x, min(x + sheet, image.hi[0])), (image.lo[1], image.hi[1]), (image.lo[2], image.hi[2]))
            voxels = [torch.arange(lo, hi, device=self.device) for lo, hi in axes]
            at, pixel, z = self._projected(image.depth_m.shape, A, b, first, voxels)
            d = depth[pixel] - z
            hit = (d >= gate[pixel]).nonzero().view(-1)
            phi = (d[hit] / tau_m).clamp_(max=1.0)
            self._accumulate(at[hit], phi, weight)
            near = hit[(phi < 1).nonzero().view(-1)]
            self.colour.view(4, -1).index_add_(1, at[near], rgbw[:, pixel[near]], alpha=weight)
            touched += len(hit)
        return touched

    def _projected(self, shape, A, b, first: np.ndarray, axes: list) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Of the voxels along these axes, flat: place in the grid, pixel in an image (h, w), and depth in metres.

        Whatever falls outside the image or behind the camera lands on its border, which holds no depth.
        """
        i, j, k = axes[0][:, None, None], axes[1][None, :, None], axes[2][None, None, :]
        rows = zip(A.tolist(), b.tolist(), strict=True)
        x, y, z = (a[0] * i.double() + a[1] * j.double() + c + a[2] * k.double() for a, c in rows)
        height, width = shape
        # Half a pixel more, cut off, is the nearest pixel.
        u, v = (x / z + 0.5).clamp_(0, width - 1).int(), (y / z + 0.5).clamp_(0, height - 1).int()
        pixel = v.mul_(width).add_(u).masked_fill_(z <= _BEHIND_M, 0)
        _, ny, nz = self.weight.shape
        at = ((i - int(first[0])) * ny + j - int(first[1])) * nz + k - int(first[2])
        return at.view(-1), pixel.view(-1), z.view(-1)

    def _accumulate(self, at: torch.Tensor, phi: torch.Tensor, weight: float) -> None:
        total, count = self.total.view(-1), self.weight.view(-1)
        new_total, new_count = total[at].add_(phi.float(), alpha=weight), count[at].add_(weight)
        if weight < 0:
            new_total.masked_fill_(new_count == 0, 0.0)
        total[at], count[at] = new_total, new_count
        # 0 / 0 is NaN, which is what an unobserved voxel holds.
        self.value.view(-1)[at] = new_total / new_count

    def at(self, index: np.ndarray, offsets: np.ndarray) -> np.ndarray:
        """As on the CPU."""
        import torch
        from torch.nn.functional import grid_sample

        last = np.array(self.value.shape) - 1.0
        at = index + offsets[:, None]
        # grid_sample wants the last axis first and indices scaled to [-1, 1].
        grid = torch.as_tensor((at * (2 / last) - 1)[..., ::-1].astype(np.float32), device=self.device)
        found = grid_sample(self.value[None, None], grid.view(1, 1, 1, -1, 3), align_corners=True)
        inside = ((at >= 0) & (at <= last)).all(-1)
        return np.where(inside, found.view(len(offsets), -1).cpu().numpy().astype(float), np.nan)
