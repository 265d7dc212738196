"""The built-in segmenter: colour, depth, motion and the reconstructed surface, cut by a random walker.

Look first at :mod:`p2p_lib.segmenters.builtin.segmenter`.
"""
