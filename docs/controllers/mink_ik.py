"""mink for `splatctrl replay --controller mink_ik:MinkIk`; MJCF=robot.xml, whose joints are named as the log's."""

import os

import mink
import mujoco
import numpy as np

from splatctrl_cli import ControllerInput, ControllerStart


class MinkIk:
    def __init__(self, start: ControllerStart) -> None:
        self.model = mujoco.MjModel.from_xml_path(os.environ["MJCF"])
        self.at, self.period = mink.Configuration(self.model), start.period
        self.columns = [self.model.joint(name).dofadr[0] for name in start.joints]
        self.task = mink.FrameTask(start.frame, "body", position_cost=1.0, orientation_cost=0.5, gain=0.02)
        self.limits = [mink.ConfigurationLimit(self.model)]

    def step(self, now: ControllerInput) -> np.ndarray:
        q = np.zeros(self.model.nq)
        q[[self.model.jnt_qposadr[self.model.dof_jntid[k]] for k in self.columns]] = now.q
        self.at.update(q)
        self.task.set_target(mink.SE3.from_matrix(now.goal))
        return mink.solve_ik(self.at, [self.task], self.period, "daqp", limits=self.limits)[self.columns]
