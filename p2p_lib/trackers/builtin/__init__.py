"""The built-in tracker: more than a 2D point tracker, because it uses depth and rigid motion.

Look first at :mod:`p2p_lib.trackers.builtin.tracker`.
"""
