"""What is ours, composed around the paper's method, which imports nothing of it (not in the paper).

Look first at :mod:`~p2p_lib.extended.default`, the one list of mechanisms: deleting a line there takes one out. They
plug in at four places:

- before a frame: ``frame_guard`` checks that it is newer than the one before, that its depth is in metres, and that
  depth and colour are of one moment;
- around an object: ``two_maps`` takes the place of one object's tracker, and holds two while the object shows a side
  that its map does not have;
- around track and segment: ``reacquisition`` looks for absent objects where motion, scene, shape and colour say;
  ``outlook`` says where an object should show, ``scene`` how the camera moved, ``shape_search`` and
  ``image_search`` whether a surface shows;
- inside an object's step: ``policy`` replaces the paper's. ``gates`` judge a pose, ``agreement`` says whether depth and
  masks are consistent over time, ``contour`` where something flat ends, ``motion`` where an object goes, ``confidence``
  how well a pose is known, ``lifecycle`` is an object's state; ``model``, ``graph`` and ``views`` are its map.

Beside them is what outlasts a video: ``remembered`` is an object that began with a memory, ``remembering`` what is
known of one as a memory, ``saving`` a tracker as a file.
"""
