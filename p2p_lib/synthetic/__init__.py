"""Embedded synthetic sequences: procedural packages on a table, an RGB-D camera, exact truth.

``scenario_dir("crossing", seed=0)`` gives a folder in the YCBMultiTrack layout, rendered at the first call.
"""

from p2p_lib.synthetic.generate import scenario_dir, write_sequence
from p2p_lib.synthetic.scenarios import SCENARIOS, describe

__all__ = ["SCENARIOS", "describe", "scenario_dir", "write_sequence"]
