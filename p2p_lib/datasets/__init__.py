"""RGB-D sequences from disk and cameras, their truth and models, and the folders that runs are written to.

Sequences: look first at :mod:`~p2p_lib.datasets.sequence`, which opens any layout. A layout (``folder``,
``ycbineoat``, ``ycbmultitrack``, ``ho3d``, ``bop``, ``tum``, ``open3d``) says where files lie, in which units and axes;
``image_sequence``, ``images``, ``masks`` and ``truth`` read and check them for all. ``cameras`` and ``realsense`` are
live.
Runs: ``runs`` writes and reads them, ``exchange`` writes and reads poses of other tools.
On this machine: ``manifests`` say what a dataset or checkpoint is, ``inventory`` fetches and verifies it.
Own recordings: ``recording`` makes truth out of motion capture.
"""
