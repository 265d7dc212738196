"""A short synthetic sequence and a run on it whose every error is known, written and read back like any run."""

from dataclasses import dataclass

import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.config import preset
from p2p_lib.core.types import PoseEstimate, Status
from p2p_lib.datasets.models import find_models
from p2p_lib.datasets.runs import RunWriter, load_run
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.evaluation.protocol import evaluate
from p2p_lib.synthetic import scenario_dir

#: The constant between the tracker's frame and the model's; unknown to whoever scores the run.
T_OBJ_MODEL = se3.exp(np.array([0.3, -0.2, 0.5, 0.02, -0.01, 0.03]))
#: What is wrong with the pose of the box in a frame: a turn of 5 degrees about y, and 2 cm along x.
TURN = se3.exp(np.array([0, np.radians(5), 0, 0, 0, 0]))
SHIFT = se3.exp(np.array([0, 0, 0, 0.02, 0, 0]))


@dataclass(frozen=True)
class Made:
    sequence: object
    run: object
    evaluation: object
    wrong: dict


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    """Truth as estimates wherever 300 pixels are visible, but for the box in four frames."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("P2P_CACHE", str(tmp_path_factory.mktemp("cache")))
        sequence = open_sequence(scenario_dir("crossing", 0, frames=40, shutter_share=0.0))
    wrong = {5: TURN, 6: SHIFT, 7: TURN @ SHIFT, 8: None}
    folder = tmp_path_factory.mktemp("run")
    with RunWriter(folder, sequence, preset("default"), "lk", "dataset", models=find_models(sequence)) as writer:
        for i in range(len(sequence)):
            frame, estimates = sequence.frame(i), {}
            for name, px in sequence.visible_px(i).items():
                T_cam_obj = sequence.truth[name].T_cam_model[i] @ se3.inverse(T_OBJ_MODEL)
                status = Status.TRACKED if px >= 300 else Status.OCCLUDED
                if name == "box" and i in wrong:
                    T_error = wrong[i]
                    status = Status.LOST if T_error is None else Status.DEGRADED
                    # The error is of the model's frame: T_cam_model @ T_error.
                    T_cam_obj = T_cam_obj @ T_OBJ_MODEL @ (np.eye(4) if T_error is None else T_error)
                    T_cam_obj = T_cam_obj @ se3.inverse(T_OBJ_MODEL)
                pose = T_cam_obj if status in (Status.TRACKED, Status.DEGRADED) else None
                estimates[name] = PoseEstimate(name, i, frame.time_s, status, pose, 0.0 if pose is None else 1.0)
            writer.add(frame, estimates, 20.0 + i % 3, {"tracking": 12.0, "map": 1.0 + i % 3})
    run = load_run(folder)
    return Made(sequence, run, evaluate(run), wrong)
