"""What one starts: the command ``p2p``, clicking, live cameras, checks, notebooks.

Look first at :mod:`p2p_lib.apps.cli`: it names the four modules that declare the commands, ``tracking_commands``,
``scoring_commands``, ``result_commands`` and ``data_commands``; ``command_line`` is how they work. ``check`` looks at
one's own data, ``click`` collects clicks in the browser, ``live`` tracks in front of a camera, ``doctor`` checks the
installation. Tracking a whole sequence is :mod:`p2p_lib.run`.
"""
