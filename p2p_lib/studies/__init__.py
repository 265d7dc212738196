"""One study per notebook: its experiment and its plots.

The first line of each module says which notebooks it is for; look first at the one beside the notebook that you read.
``final_tables`` serves ``p2p benchmark``, too. Drawing that several share is in :mod:`p2p_lib.figures`.
"""
