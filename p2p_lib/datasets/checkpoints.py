"""Weights of third-party models: found below ``$P2P_DATA``, checked against their manifest, then loaded."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from p2p_lib.core import packages
from p2p_lib.core.errors import BadInput, MissingBackend, MissingData, in_a_line
from p2p_lib.core.paths import data_dir
from p2p_lib.datasets.inventory import require
from p2p_lib.datasets.manifests import folder_of, manifest

if TYPE_CHECKING:
    import torch


def checked_files(name: str) -> list[Path]:
    """The files of the checkpoint ``name``, each with the sha256 that it must have.

    Raises :class:`MissingBackend` with the commands that fetch it, :class:`BadInput` for a file that differs.
    """
    if data_dir() is None:
        fix = f"Run: export P2P_DATA=DIR; p2p data fetch {name}"
        raise MissingBackend(name, "its checkpoint is looked for below $P2P_DATA, which is not set", fix)
    try:
        return require(manifest(name))
    except MissingData as error:
        raise MissingBackend(name, f"its checkpoint is missing, {error.expected}", error.fix) from None


def are_there(name: str) -> bool:
    """Whether the files of the checkpoint ``name`` lie in their places; what is in them is not looked at."""
    if data_dir() is None:
        return False
    of = manifest(name)
    return all((folder_of(of) / file.path).is_file() for file in of.files)


def load_weights(name: str) -> dict[str, torch.Tensor]:
    """The state dict of a PyTorch checkpoint of one file, on the CPU. Nothing but tensors is read."""
    import pickle

    (path,) = checked_files(name)
    torch = packages.load("torch", name, "torch")
    try:
        read = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError, KeyError) as error:
        what = "more than tensors" if isinstance(error, pickle.UnpicklingError) else "an unreadable file"
        raise BadInput(str(path), f"{what} ({in_a_line(error)})", "a checkpoint of tensors", _fetch(name)) from None
    weights = read.get("state_dict", read.get("model", read)) if isinstance(read, dict) else read
    if not isinstance(weights, dict) or not all(isinstance(value, torch.Tensor) for value in weights.values()):
        raise BadInput(str(path), f"a {type(weights).__name__} of other values", "a dictionary of tensors")
    return weights


def fill(model: torch.nn.Module, name: str, weights: dict[str, torch.Tensor]) -> None:
    """Put weights into a model; :class:`BadInput` names the first that does not fit."""
    try:
        model.load_state_dict(weights)
    except RuntimeError as error:
        expected = f"the weights of {type(model).__name__}"
        raise BadInput(f"checkpoint {name}", in_a_line(error), expected, _fetch(name)) from None


def device() -> str:
    """Where networks run: CUDA where torch has it, else the CPU."""
    import torch

    return "cuda" if torch.cuda.is_available() else "cpu"


def _fetch(name: str) -> str:
    return f"Run: p2p data fetch {name}"
