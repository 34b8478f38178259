"""The Universal Robots UR10e from its published Denavit-Hartenberg parameters, without meshes.

a2, a3 = -0.6127, -0.57155 m; d1, d4, d5, d6 = 0.1807, 0.17415, 0.11985, 0.11655 m; alpha1, alpha4, alpha5 = pi/2,
pi/2, -pi/2 (Universal Robots, "DH parameters for calculations of kinematics and dynamics"). The link frames are those
that `ur_description` calls shoulder_link to wrist_3_link and tool0, in which sphere files for it are written.
"""

import numpy as np

from splatctrl_cli.records import Float64

A = (0.0, -0.6127, -0.57155, 0.0, 0.0, 0.0)
D = (0.1807, 0.0, 0.0, 0.17415, 0.11985, 0.11655)
ALPHA = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)
HALF = repr(np.pi / 2)
JOINTS = (  # joint, child, origin xyz, rpy, position and velocity limit
    ("shoulder_pan_joint", "shoulder_link", f"0 0 {D[0]}", "0 0 0", 6.2832, 2.0944),
    ("shoulder_lift_joint", "upper_arm_link", "0 0 0", f"{HALF} 0 0", 6.2832, 2.0944),
    ("elbow_joint", "forearm_link", f"{A[1]} 0 0", "0 0 0", 3.1416, 3.1416),
    ("wrist_1_joint", "wrist_1_link", f"{A[2]} 0 {D[3]}", "0 0 0", 6.2832, 3.1416),
    ("wrist_2_joint", "wrist_2_link", f"0 {-D[4]} 0", f"{HALF} 0 0", 6.2832, 3.1416),
    ("wrist_3_joint", "wrist_3_link", f"0 {D[5]} 0", f"{-np.pi / 2!r} 0 0", 6.2832, 3.1416),
)


def ur10e_urdf() -> str:
    """A URDF of links, joints and limits."""
    links = ["base_link", *(joint[1] for joint in JOINTS), "tool0"]
    lines = [f'<link name="{link}"/>' for link in links]
    for (name, child, xyz, rpy, limit, velocity), parent in zip(JOINTS, links, strict=False):
        lines.append(
            f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="0 0 1"/>'
            f'<limit lower="{-limit}" upper="{limit}" velocity="{velocity}" effort="100"/></joint>'
        )
    lines.append('<joint name="flange" type="fixed"><parent link="wrist_3_link"/><child link="tool0"/></joint>')
    return f'<robot name="ur10e">{"".join(lines)}</robot>'


def flange(q: Float64) -> Float64:
    """T_base_flange (4, 4) as the product of the six Denavit-Hartenberg matrices, in UR's base frame."""
    T = np.eye(4)
    for theta, a, d, alpha in zip(q, A, D, ALPHA, strict=True):
        c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
        T = T @ np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]])
    return T
