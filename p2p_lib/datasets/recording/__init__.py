"""From a recording with motion capture to a sequence with truth, as the paper's real dataset was made.

A camera records frames on its clock, a motion-capture system the poses of marker bodies on another. What is needed:
the offset of the clocks and the camera in the world (:mod:`.synchronise`, :mod:`.hand_eye`, :mod:`.tags`), each
object's mesh in its marker body (:mod:`.alignment`), and the poses written where the loader expects them
(:mod:`.truth`).
"""
