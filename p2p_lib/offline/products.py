"""What ``p2p export`` writes besides files of poses, by format."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from p2p_lib.core.errors import BadInput
from p2p_lib.core.files import replace_text
from p2p_lib.core.types import DOUBTED
from p2p_lib.offline import OFFLINE_COMMENT, PRODUCTS
from p2p_lib.offline.dataset import write_bop, write_foundationpose
from p2p_lib.offline.finished import check_confidence


def write_product(
    run: str | Path,
    format: str,
    out: str | Path,
    min_confidence: float | None = None,
    faces: int = 5000,
    progress: bool = False,
) -> str:
    """Write the run in a folder in one of :data:`~p2p_lib.offline.PRODUCTS` into a new one; what it holds, in words.

    min_confidence  only poses of more confidence are used; None: all but the doubted
    faces           most faces of a textured model

    Raises :class:`BadInput` and :class:`MissingData` where that cannot be; nothing is left of ``out`` then.
    """
    least = DOUBTED if min_confidence is None else min_confidence
    if format not in PRODUCTS:
        raise BadInput("format", repr(format), "one of " + ", ".join(PRODUCTS))
    check_confidence(least)
    if format == "bop-dataset":
        return f"{write_bop(run, out, least, progress)}. Written: {out}"
    from p2p_lib.offline.model import write_models

    if format == "model":
        return f"{write_models(run, out, faces, least, progress)}. Written: {out}"
    with TemporaryDirectory() as folder:
        write_models(run, models := Path(folder) / "models", faces, least, progress)
        meshes = {path.name: path for path in models.iterdir() if path.is_dir()}
        return f"{write_foundationpose(run, out, meshes, least)}. Written: {out}"


def marked(path: Path) -> Path:
    """Where a file of poses, or a folder of them, lies now that it says to be offline.

    BOP's files say so by their name, METHOD_DATASET-SPLIT; text by a comment, which its readers pass over.
    """
    if path.suffix in (".csv", ".json"):
        return path.rename(path.with_name(path.name.replace("p2p_", "p2p-offline_", 1)))
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        if text := file.read_text(encoding="utf-8"):
            replace_text(file, OFFLINE_COMMENT + text)
    return path
