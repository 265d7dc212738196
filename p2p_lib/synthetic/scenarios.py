"""Every scenario by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from p2p_lib.synthetic import ablations, absences, desk, in_hand, paper_subset, tools
from p2p_lib.synthetic.scene import Scenario

#: Each takes the seed first and its own keyword parameters.
SCENARIOS: dict[str, Callable[..., Scenario]] = {
    make.__name__: make
    for make in (
        absences.crossing,
        ablations.mug,
        ablations.weak_texture,
        ablations.plain,
        ablations.fading_label,
        ablations.long_turning,
        ablations.eight_objects,
        absences.occlusion,
        absences.exit_reentry,
        absences.look_alikes,
        absences.late_object,
        absences.three_objects,
        absences.moving_camera,
        absences.half_hidden_start,
        absences.other_side,
        absences.look_away,
        in_hand.in_hand,
        in_hand.in_hand_10fps,
        desk.cluttered_desk,
        tools.thin_tools,
    )
}
SCENARIOS |= {name: partial(paper_subset.paper_sequence, parts=parts) for name, parts in paper_subset.SEQUENCES.items()}

SCENARIOS |= tools.SCENARIOS


def describe(name: str) -> str:
    """What happens in a scenario, in one line."""
    if name in paper_subset.SEQUENCES:
        parts = " and ".join(f"{model} ({motion})" for model, motion in paper_subset.SEQUENCES[name].items())
        return f"as in the paper's synthetic subset: {parts}, {paper_subset.FRAMES} frames."
    if name in tools.SCENARIOS:
        return f"as thin_tools, the tool: {name.removeprefix('thin_')}."
    return (SCENARIOS[name].__doc__ or "").splitlines()[0]
