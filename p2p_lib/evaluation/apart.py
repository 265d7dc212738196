"""How far the poses of two runs of one video are apart: for that nobody needs the truth."""

from __future__ import annotations

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput
from p2p_lib.datasets.runs import ObjectRun, Run


def apart(one: Run, other: Run) -> dict[str, str]:
    """Object to how far its poses in two runs are apart, in words; :class:`BadInput` if they have nothing in common.

    Medians of the frames that both have a pose in; object frames are aligned at the first of these.
    """
    both = [name for name in one.objects if name in other.objects]
    if one.info["sequence"] != other.info["sequence"] or not both:
        got, expected = (f"{', '.join(run.objects)} in {run.info['sequence']}" for run in (other, one))
        fix = "Others are scored one by one."
        raise BadInput(str(other.path), got, f"objects and sequence of {one.path}: {expected}", fix)
    return {name: _apart(one.objects[name], other.objects[name]) for name in both}


def _apart(a: ObjectRun, b: ObjectRun) -> str:
    _, at_a, at_b = np.intersect1d(a.frame_index, b.frame_index, return_indices=True)
    has_a, has_b = a.has_pose[at_a], b.has_pose[at_b]
    both = has_a & has_b
    alone = f"only one has a pose: {np.count_nonzero(has_a & ~both)} and {np.count_nonzero(has_b & ~both)} frames"
    if not both.any():
        return f"no frame in which both have a pose; {alone}"
    T_a, T_b = a.T_cam_obj[at_a][both], b.T_cam_obj[at_b][both]
    deg, mm = se3.error_deg_mm(T_b @ (se3.inverse(T_b[0]) @ T_a[0]), T_a)
    off = (
        f"{np.median(deg):.1f}° and {np.median(mm):.1f} mm apart (medians of {both.sum()} frames, aligned at the first"
    )
    return f"{off}; at most {deg.max():.0f}° and {mm.max():.0f} mm); {alone}"
