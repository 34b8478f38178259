"""crocoddyl's MPC for `splatctrl replay --controller crocoddyl_mpc:Mpc`; URDF=robot.urdf, with inertias."""

import os

import crocoddyl as c
import numpy as np
import pinocchio

from splatctrl_cli import ControllerInput, ControllerStart

NODES, STEP = 20, 0.05  # of the horizon, and [s] between them


class Mpc:
    def __init__(self, start: ControllerStart) -> None:
        whole = pinocchio.buildModelFromUrdf(os.environ["URDF"])
        held = [whole.getJointId(name) for name in list(whole.names)[1:] if name not in start.joints]
        self.model = pinocchio.buildReducedModel(whole, held, pinocchio.neutral(whole))
        self.order = [start.joints.index(name) for name in list(self.model.names)[1:]]
        self.state, self.frame = c.StateMultibody(self.model), self.model.getFrameId(start.frame)

    def step(self, now: ControllerInput) -> np.ndarray:
        x, costs = np.concatenate([now.q[self.order], now.dq[self.order]]), c.CostModelSum(self.state)
        at_goal = c.ResidualModelFramePlacement(self.state, self.frame, pinocchio.SE3(now.goal))
        costs.addCost("goal", c.CostModelResidual(self.state, at_goal), 10.0)
        at_rest = c.ResidualModelState(self.state, np.concatenate([x[: self.model.nq], np.zeros(self.model.nv)]))
        costs.addCost("rest", c.CostModelResidual(self.state, at_rest), 0.1)
        dynamics = c.DifferentialActionModelFreeFwdDynamics(self.state, c.ActuationModelFull(self.state), costs)
        node = c.IntegratedActionModelEuler(dynamics, STEP)
        solver = c.SolverFDDP(c.ShootingProblem(x, [node] * NODES, node))
        solver.solve([x] * (NODES + 1), solver.problem.quasiStatic([x] * NODES), 5)
        return np.array(solver.xs[1][self.model.nq :])[np.argsort(self.order)]
