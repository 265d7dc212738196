"""What is made of a finished run (ours): poses by the whole video, labelled datasets, textured models.

:mod:`p2p_lib.offline.finished` opens a run with its images, masks and surfaces, and says which poses are trusted; look
there first. ``adjustment.py``, ``loops.py`` and :mod:`p2p_lib.offline.refine` are ``p2p refine``; ``dataset.py``,
``model.py``, ``holes.py`` and ``texture.py`` are ``p2p export``.
"""

#: What ``p2p export`` writes besides files of poses.
PRODUCTS = ("bop-dataset", "foundationpose", "model")
#: What is said of a result of ``p2p refine``, wherever people read of it.
NOT_CAUSAL = "offline: poses by the whole video (p2p refine), not as they were said frame by frame"
#: The first line of its files of poses.
OFFLINE_COMMENT = "# offline\n"
