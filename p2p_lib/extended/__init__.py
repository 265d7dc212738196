"""What is ours, composed around the paper's method, which imports nothing of it (not in the paper).

Look first at :mod:`~p2p_lib.extended.default`, the one list of mechanisms: taking one out is deleting its line. They
are composed in three ways:

- before a frame: ``frame_guard`` looks whether it is newer than the one before, and whether depth and colour are of
  one moment;
- around an object: ``two_maps`` stands in the place of one object's tracker, and has two behind it while the object
  shows a side that nobody knows;
- around track and segment: ``reacquisition`` looks for absent objects where motion, scene, shape and colour say;
  ``outlook`` answers where an object should show, ``scene`` how the camera moved, ``shape_search`` and
  ``image_search`` whether a surface shows;
- inside an object's step: ``policy`` answers what the paper's policy answers. ``gates`` judge a pose, ``agreement``
  says whether camera and masks agree with themselves, ``contour`` where something flat ends, ``motion`` where an object
  goes, ``confidence`` how well a pose is known, ``lifecycle`` what an object has been through; ``model``, ``graph`` and
  ``views`` are what it is known by.
"""
