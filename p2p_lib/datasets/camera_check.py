"""Whether a camera matrix can belong to the images that it came with."""

from __future__ import annotations

import numpy as np

from p2p_lib.core.camera import Camera

#: Of the image's width: a principal point off centre.
CENTRE_SHARE = 0.1
#: Horizontal and vertical angles of view of any RGB-D camera.
VIEW_DEG = (20.0, 130.0)


def sees(camera: Camera) -> str:
    """Its field of view and its centre, in words."""
    across, down = _view_deg(camera)
    return f"sees {across:.0f} x {down:.0f} degrees, centre at ({camera.cx:.0f}, {camera.cy:.0f})"


def odd_camera(camera: Camera) -> tuple[str, str] | None:
    """What to say of a camera whose centre is not about the images' middle, or that sees as none does; what to do."""
    size, centre = np.array([camera.width, camera.height]), np.array([camera.cx, camera.cy]) + 0.5
    if (np.abs(centre / size - 0.5) > CENTRE_SHARE).any():
        of = "x".join(f"{round(2 * c, -1):.0f}" for c in centre)
        text = f"K has its centre at ({camera.cx:.0f}, {camera.cy:.0f}): that of images of about {of}"
        factors = size / (2 * centre)
        fix = f"Take K at {camera.width}x{camera.height}"
        if abs(factors[0] / factors[1] - 1) < 0.03:
            fix += f": for images scaled as a whole, its first two rows times {factors.mean():.3g}"
        return text, f"{fix}."
    view_deg = _view_deg(camera)
    if (view_deg < VIEW_DEG[0]).any() or (view_deg > VIEW_DEG[1]).any():
        fix = "fx and fy are in pixels, at the size that the images have here."
        return f"{sees(camera)}: no RGB-D camera does", fix
    return None


def _view_deg(camera: Camera) -> np.ndarray:
    return 2 * np.degrees(np.arctan([camera.width / 2 / camera.fx, camera.height / 2 / camera.fy]))
