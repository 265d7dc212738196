"""Every scenario by name."""

from __future__ import annotations

from collections.abc import Callable

from p2p_lib.data.synthetic.ablations import long_turning, mug, weak_texture
from p2p_lib.data.synthetic.crossing import crossing
from p2p_lib.data.synthetic.scene import Scenario

#: Each takes the seed first and its own keyword parameters.
SCENARIOS: dict[str, Callable[..., Scenario]] = {s.__name__: s for s in (crossing, mug, weak_texture, long_turning)}
