"""Points on true surfaces and where they are seen, by exact geometry: the oracle for what scenarios promise."""

import numpy as np

from p2p_lib.core import se3


def see(camera, T_cam_model, points, depth_m, mask, slack_m=0.0005):
    """Pixels (P, 2) and visibility (P,) of points (p_model, normals) in an image of this depth and this object's mask.

    slack_m  by how much depth may be off the exact surface
    """
    p_model, normals = points
    p_cam = se3.transform(T_cam_model, p_model)
    uv = camera.project(p_cam)
    inside = camera.inside(uv)
    u, v = np.where(inside, uv.T, 0).round().astype(int)
    cosine = -np.einsum("pc,pc->p", normals @ T_cam_model[:3, :3].T, p_cam) / np.linalg.norm(p_cam, axis=1)
    # The depth is that of the pixel's centre, up to 0.71 px away: a slanted surface differs by its slope.
    slope = np.sqrt(1 - np.minimum(cosine, 1) ** 2) / np.maximum(cosine, 1e-3)
    agrees = np.abs(depth_m[v, u] - p_cam[:, 2]) < slack_m + 0.75 * p_cam[:, 2] / camera.fx * slope
    return uv, inside & (cosine > 0.05) & mask[v, u] & agrees


def watch(scenario, frames, points_per_object=256):
    """Per labelled object: its pixels (T,) and which points on its surface show (T, P) at these frames."""
    still = (scenario.T_world_cam == scenario.T_world_cam[0]).all()
    room = scenario.empty(0) if still else None
    labelled = [(k, body) for k, body in enumerate(scenario.bodies, 1) if body.labelled]
    points = {k: body.mesh.sample(points_per_object, np.random.default_rng(k)) for k, body in labelled}
    T_cam_world = se3.inverse(scenario.T_world_cam)
    seen = {body.name: ([], []) for _, body in labelled}
    for t in frames:
        exact = scenario.rendered(t, room)
        for k, body in labelled:
            mask, T = exact.label == k, T_cam_world[t] @ body.T_world_model[t]
            seen[body.name][0].append(np.count_nonzero(mask))
            seen[body.name][1].append(see(scenario.camera, T, points[k], exact.depth_m, mask)[1])
    return {name: (np.array(px), np.array(shown)) for name, (px, shown) in seen.items()}
