"""The paper's method, one file per box of its overview figure; it imports nothing but :mod:`p2p_lib.core`.

Look first at :mod:`~p2p_lib.method.pipeline` (all objects, one frame) and :mod:`~p2p_lib.method.object_tracker` (one
object: find, then accept or absent), then at the parts of a step in its order:

- track, segment, observe: ``frontend`` does it for all objects, ``observation`` lifts one object's 2D points and takes
  its dense cloud;
- propose: ``registration`` gives pose hypotheses against the keypoints of ``keypoint_map``;
- choose: ``selection``, then ``refinement`` moves the pose onto the surface of ``tsdf``;
- judge, admit, request: ``policy`` has the paper's answers to these questions and to the two before;
- extend: ``object_model`` holds map, surface (``tsdf``), graph (``factor_graph``) and views (``keyframe_views``);
  ``sampling`` chooses new points.

What is ours is composed around these parts by :mod:`p2p_lib.extended`, which this package knows nothing of.
README.md beside this file lists where the paper's preset departs from the paper and its release.

The 2D tracker, the detector of candidates and the segmenter are given to it; :mod:`p2p_lib.core.interfaces` says
what it asks of them.
"""
