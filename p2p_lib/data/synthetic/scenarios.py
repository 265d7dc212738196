"""Every scenario by name."""

from __future__ import annotations

from collections.abc import Callable

from p2p_lib.data.synthetic import ablations, absences
from p2p_lib.data.synthetic.crossing import crossing
from p2p_lib.data.synthetic.scene import Scenario

#: Each takes the seed first and its own keyword parameters.
SCENARIOS: dict[str, Callable[..., Scenario]] = {
    make.__name__: make
    for make in (
        crossing,
        ablations.mug,
        ablations.weak_texture,
        ablations.long_turning,
        absences.occlusion,
        absences.exit_reentry,
        absences.look_alikes,
        absences.late_object,
        absences.three_objects,
        absences.moving_camera,
    )
}
