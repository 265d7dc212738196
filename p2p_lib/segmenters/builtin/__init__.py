"""The built-in segmenter: colour, depth, motion and the reconstructed surface, cut by a random walker.

Look first at :mod:`p2p_lib.segmenters.builtin.segmenter` (follow, find again) and ``prompted`` (start, correct), then
at ``cut`` (the evidence), ``motion`` (parts), ``patch`` (the small grid), ``colours`` and ``random_walk``.
"""
