"""One study per notebook: its experiment and its plots.

The first line of each module says which notebooks it is for; look first at the one beside the notebook that you read.
All of them have their place in ``course``; ``runner`` runs them (``p2p notebooks``), ``paper_figures`` draws the
paper's figures (``p2p figures``). Nothing here is part of the installed package, which never imports it; drawing that
commands share is in :mod:`p2p_lib.figures`.
"""

from pathlib import Path

#: The clone of the repository that the notebooks are in.
CLONE = Path(__file__).resolve().parents[2]
#: The tables that come with it.
SHIPPED = CLONE / "figures" / "tables"
