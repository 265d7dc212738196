"""Weights of third-party models: found below ``$P2P_DATA``, checked against their manifest, then loaded.

A file whose manifest knows no checksum is held to the one in ``.p2p-NAME.json`` beside it, where ``p2p data fetch``
records what it downloaded. A file that was put there by hand is recorded at its first use.
"""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING

from p2p_lib.core.errors import BadInput, MissingBackend, MissingData
from p2p_lib.core.paths import data_dir
from p2p_lib.data.manifests import Manifest, folder_of, manifest

if TYPE_CHECKING:
    import torch


def checked_files(name: str) -> list[Path]:
    """The files of the checkpoint ``name``, each with the sha256 that it must have.

    Raises :class:`MissingBackend` with the commands that fetch it, :class:`BadInput` for a file that differs.
    """
    of = manifest(name)
    if data_dir() is None:
        fix = f"Run: export P2P_DATA=DIR; p2p data fetch {name}"
        raise MissingBackend(name, "its checkpoint is looked for below $P2P_DATA, which is not set", fix)
    return [_checked(of, file.path, file.sha256) for file in of.files]


def load_weights(name: str) -> dict[str, torch.Tensor]:
    """The state dict of a PyTorch checkpoint of one file, on the CPU. Nothing but tensors is read."""
    import pickle

    import torch

    (path,) = checked_files(name)
    try:
        read = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        reason = " ".join(str(error).split())[:120]
        raise BadInput(str(path), f"more than tensors ({reason})", "a checkpoint of tensors", _fetch(name)) from None
    except (RuntimeError, EOFError, ValueError, KeyError) as error:
        reason = " ".join(str(error).split())[:120]
        raise BadInput(str(path), f"an unreadable file ({reason})", "a PyTorch checkpoint", _fetch(name)) from None
    weights = read.get("state_dict", read.get("model", read)) if isinstance(read, dict) else read
    if not isinstance(weights, dict) or not all(isinstance(value, torch.Tensor) for value in weights.values()):
        raise BadInput(str(path), f"a {type(weights).__name__} of other values", "a dictionary of tensors")
    return weights


def fill(model: torch.nn.Module, name: str, weights: dict[str, torch.Tensor]) -> None:
    """Put weights into a model; :class:`BadInput` names the first that does not fit."""
    try:
        model.load_state_dict(weights)
    except RuntimeError as error:
        reason = " ".join(str(error).split())[:200]
        raise BadInput(f"checkpoint {name}", reason, f"the weights of {type(model).__name__}", _fetch(name)) from None


def device_of(device: str | None) -> str:
    """The device asked for; by default CUDA where torch has it, else the CPU."""
    import torch

    return device or ("cuda" if torch.cuda.is_available() else "cpu")


def _checked(of: Manifest, name: str, sha256: str | None) -> Path:
    path = folder_of(of) / name
    if not path.is_file():
        raise MissingBackend(of.name, f"its checkpoint is not there, expected {path}", _fetch(of.name))
    record = path.parent / f".p2p-{of.name}.json"
    known = _recorded(record)
    digest = _digest(path)
    expected = sha256 or known.get(name, {}).get("sha256")
    if expected is None:
        known[name] = {"sha256": digest, "bytes": path.stat().st_size}
        _write(record, known)
    elif digest != expected:
        fix = f"Delete it and run: p2p data fetch {of.name}"
        raise BadInput(str(path), f"sha256 {digest}", f"sha256 {expected}", fix)
    return path


def _recorded(path: Path) -> dict[str, dict]:
    try:
        return dict(json.loads(path.read_text())["files"])
    except FileNotFoundError:
        return {}
    except (ValueError, KeyError, TypeError) as error:
        fix = "Delete it; checksums are then recorded anew."
        raise BadInput(str(path), f"unreadable ({error})", "a record of what was fetched", fix) from None


def _write(path: Path, files: dict[str, dict]) -> None:
    partial = path.with_name(path.name + ".partial")
    try:
        partial.write_text(json.dumps({"files": files}, indent=1) + "\n")
        os.replace(partial, path)
    except OSError as error:
        fix = "Let the folder be written to once, or put the sha256 into the manifest."
        raise MissingData(str(path), f"the checksum cannot be recorded ({error.strerror})", fix) from None


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _fetch(name: str) -> str:
    return f"Run: p2p data fetch {name}"
