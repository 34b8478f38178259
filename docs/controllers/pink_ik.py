"""pink for `splatctrl replay --controller pink_ik:PinkIk`; URDF=robot.urdf."""

import os

import numpy as np
import pink
import pinocchio

from splatctrl_cli import ControllerInput, ControllerStart


class PinkIk:
    def __init__(self, start: ControllerStart) -> None:
        whole = pinocchio.buildModelFromUrdf(os.environ["URDF"])
        held = [whole.getJointId(name) for name in list(whole.names)[1:] if name not in start.joints]
        self.model = pinocchio.buildReducedModel(whole, held, pinocchio.neutral(whole))
        self.order = [start.joints.index(name) for name in list(self.model.names)[1:]]
        self.task = pink.tasks.FrameTask(start.frame, position_cost=1.0, orientation_cost=0.5, gain=0.02)
        self.period = start.period

    def step(self, now: ControllerInput) -> np.ndarray:
        at = pink.Configuration(self.model, self.model.createData(), now.q[self.order])
        self.task.set_target(pinocchio.SE3(now.goal))
        return pink.solve_ik(at, [self.task], self.period, solver="daqp")[np.argsort(self.order)]
