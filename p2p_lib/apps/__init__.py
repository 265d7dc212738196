"""What one starts: the command ``p2p``, clicking, live cameras, checks, notebooks.

Look first at :mod:`p2p_lib.apps.cli`.
"""
