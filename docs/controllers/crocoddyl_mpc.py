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
        residual = c.ResidualModelFramePlacement(self.state, self.frame, pinocchio.SE3(now.goal))
        costs.addCost("goal", c.CostModelResidual(self.state, residual), 10.0)
        costs.addCost("still", c.CostModelResidual(self.state, c.ResidualModelState(self.state, x)), 0.1)
        dynamics = c.DifferentialActionModelFreeFwdDynamics(self.state, c.ActuationModelFull(self.state), costs)
        solver = c.SolverFDDP(c.ShootingProblem(x, [c.IntegratedActionModelEuler(dynamics, STEP)] * NODES,
                                                c.IntegratedActionModelEuler(dynamics, STEP)))  # fmt: skip
        solver.solve([x] * (NODES + 1), solver.problem.quasiStatic([x] * NODES), 5)
        return np.array(solver.xs[1][self.model.nq :])[np.argsort(self.order)]
