"""How far a joint can move a sphere, whatever the posture: so a planner can trust the space between two samples."""

import numpy as np

from splatctrl_cli.kernels.chain import PRISMATIC, Chain
from splatctrl_cli.records import Float64


def lever_arms(chain: Chain, lower: Float64, upper: Float64) -> Float64:
    """(S, J) upper bounds, over every posture within lower, upper (J,), of a centre's travel per radian (or metre).

    From the sphere towards the base: about its own joint it keeps to a circle, which a ball about the circle's middle
    on the axis holds; carried by the next joint, the ball's middle keeps to a circle in turn, and the ball that holds
    it is as much larger as the middle is away from that axis. 0 where the joint does not move the sphere.
    """
    levers = np.zeros((len(chain.sphere_body), len(chain.parent) - 1))
    for s, (start, offset) in enumerate(zip(chain.sphere_body, chain.offset, strict=True)):
        middle, radius, body = np.asarray(offset, dtype=np.float64), 0.0, int(start)
        while body > 0:
            j, axis = body - 1, chain.axis[body]
            if chain.kind[body] == PRISMATIC:
                levers[s, j] = 1.0
                middle = middle + axis * (lower[j] + upper[j]) / 2
                radius += (upper[j] - lower[j]) / 2
            else:
                along = axis * float(axis @ middle)
                radius += float(np.linalg.norm(middle - along))
                levers[s, j], middle = radius, along
            middle = chain.placement[body, :, :3] @ middle + chain.placement[body, :, 3]
            body = int(chain.parent[body])
    return levers
