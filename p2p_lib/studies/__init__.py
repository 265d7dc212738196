"""One study per notebook: its experiment and its plots.

The first line of each module says which notebook it is for; look first at the one beside the notebook that you read.
``turntable`` serves the two on the surface, ``final_tables`` also ``p2p benchmark``. Drawing that several share is in
:mod:`p2p_lib.figures`.
"""
