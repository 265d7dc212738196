"""2D point trackers: Lucas-Kanade, the built-in one, and adapters of learned ones.

What a tracker promises is :class:`p2p_lib.core.interfaces.PointTracker`; names are listed in
:mod:`p2p_lib.core.backends`. Look first at :mod:`p2p_lib.trackers.lk`, the shortest, then at
:mod:`p2p_lib.trackers.builtin`, whose text says how a frame goes through it.
"""
