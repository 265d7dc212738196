"""Bundled synthetic sequences: procedural packages on a table, an RGB-D camera, exact truth.

``scenario_dir("crossing", seed=0)`` gives a folder in the YCBMultiTrack layout, rendered at the first call. Look first
at :mod:`~p2p_lib.synthetic.scenarios`: every scenario by name. One is made in ``absences``, ``ablations``,
``paper_subset``, ``in_hand``, ``desk`` or ``tools`` of ``scene`` (bodies, room, camera), ``shapes``, ``solids``,
``gripping`` (a jointed hand) and ``labels`` (meshes and their print), ``motion`` (paths) and ``resting`` (how things
lie). ``render`` draws it with ``texture``, ``environment`` and ``shadows``, ``exposure`` is what a shutter makes of
motion and ``noise`` what a real sensor makes of all that, ``generate`` writes the folder. ``faults`` are what goes
wrong in any sequence, recorded or not.
"""

from p2p_lib.synthetic.generate import scenario_dir, write_sequence
from p2p_lib.synthetic.scenarios import SCENARIOS, describe

__all__ = ["SCENARIOS", "describe", "scenario_dir", "write_sequence"]
