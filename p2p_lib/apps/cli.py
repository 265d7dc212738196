"""The command ``p2p``: every command, in the order in which ``p2p --help`` lists them.

Each is declared where it is carried out, by one call into the library.
"""

import sys

from p2p_lib.apps import tracking_commands, scoring_commands, result_commands, data_commands  # isort: skip  # noqa: F401
from p2p_lib.apps.command_line import main

if __name__ == "__main__":
    sys.exit(main())
