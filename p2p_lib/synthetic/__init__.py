"""Bundled synthetic sequences: procedural packages on a table, an RGB-D camera, exact truth.

``scenario_dir("crossing", seed=0)`` gives a folder in the YCBMultiTrack layout, rendered at the first call. Look first
at :mod:`~p2p_lib.synthetic.scenarios`: every scenario by name. One is made in ``absences``, ``ablations`` or
``paper_subset`` of ``scene`` (bodies, room, camera), ``shapes``, ``solids`` and ``labels`` (meshes and their print) and
``motion`` (paths). ``render`` draws it with ``texture`` and ``environment``, ``noise`` is what a real sensor makes of
that, ``generate`` writes the folder. ``faults`` are what goes wrong in any sequence, recorded or not.
"""

from p2p_lib.synthetic.generate import scenario_dir, write_sequence
from p2p_lib.synthetic.scenarios import SCENARIOS, describe

__all__ = ["SCENARIOS", "describe", "scenario_dir", "write_sequence"]
