"""The built-in tracker: long-range, without learned weights, on the CPU.

It is more than a 2D point tracker: it reads depth, groups its points into rigid motion segments, and predicts points
from the poses of these segments. A frame goes through it in this order (:mod:`p2p_lib.trackers.builtin.tracker`):

1. Follow (``recognition``, ``appearance``): Lucas-Kanade predicts where each point moved, and alignment with the best
   of its templates decides. That removes drift, and a place of another appearance is refused. A point whose
   appearance changed coasts on Lucas-Kanade alone for a few frames.
2. Fit (``motion_segments``, ``rigid_motion``): each segment's pose is fitted to its points; points that disagree are
   not verified, and many that leave together become a segment of their own. A segment that few points were followed
   on, in a fast turn or blur, is matched with the frame in which it was seen last (``wide_baseline``). Points that
   slide agree with each other: the colours and the depth of all that shows of a segment overrule them where they say
   clearly otherwise (``direct_alignment``).
3. Search (``landmarks``, ``features``): a lost segment is searched for in the whole image by corners that were seen on
   it, described on its surface (``tangent_planes``); most matches that agree propose its pose.
4. Find: points that were not followed are searched for where their segment predicts them.
5. Reconcile: points and predictions are averaged; points that face away, lie behind a nearer surface or are not
   recognised and badly predicted are invisible.
6. Update, every few frames: new templates, points assigned to segments, landmarks of sides not seen before.

``tracked_points`` holds the arrays of all points, ``image`` what is computed once per frame, ``segment_view`` what is
kept of a segment from frame to frame. What the caller knows comes in by ``reject`` (these tracks contradict the rigid
motion: a look-alike) and ``suggest`` (guided re-detection).
"""
