"""Finding again what was left lying (not in the paper; ours): hypotheses, which the method confirms or not.

Look first at :mod:`~p2p_lib.recovery.scene`, which says how the camera moved and so where an object lies that was left;
:mod:`~p2p_lib.recovery.search` says whether its surface shows there by shape and colour. The switch of both is
``method.scene``.
"""
