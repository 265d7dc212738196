"""The paper's method, one file per box of its overview figure, and what preset "default" adds to these boxes.

Look first at :mod:`~p2p_lib.method.pipeline` (all objects, one frame) and :mod:`~p2p_lib.method.object_tracker` (one
object's step; ``pose_finder`` has its first half, up to the pose), then at the parts of that step in its order:

- observe: ``observation`` lifts the object's 2D points and takes its dense cloud;
- register: ``registration`` gives pose hypotheses against the keypoints of ``keypoint_map``;
- refine: ``refinement`` moves poses onto the surface of ``tsdf``; ``observability`` says which motions its shape
  determines;
- select: ``selection``;
- judge: ``lifecycle`` holds an object's state, every gate and every doubt; ``agreement`` says whether camera and masks
  agree with themselves;
- extend: ``object_model`` holds map, surface (``tsdf``, ``tsdf_grid``, ``mesh``) and graph (``factor_graph``,
  ``keyframes``, ``keyframe_views``); ``sampling`` chooses new points; ``confidence`` says how well the pose is known.

What follows is ours. ``outlook`` answers what the pipeline asks around this step: where the object should show, which
tracks are elsewhere. An object that shows a side never seen has two maps for a while: ``two_maps`` says when they are
one. ``motion`` says where an absent object was going, ``shape_search`` looks for it by its surface.

The 2D tracker, the detector of candidates and the segmenter are parts that it is given; what it asks of them is in
:mod:`p2p_lib.core.interfaces`. Where an absent object may lie it is told by :mod:`p2p_lib.recovery`.
"""
