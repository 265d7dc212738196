"""The built-in segmenter: colour, depth, motion and the reconstructed surface, cut by a random walker.

Look first at :mod:`p2p_lib.segmenters.builtin.segmenter` (start, follow, find again), then at ``cut`` (the evidence), ``motion`` (parts),
``patch`` (the small grid and its geometry), ``colours`` and ``random_walk``.
"""
